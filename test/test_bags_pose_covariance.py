"""Poses with their covariance: written next to the pose, read with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, RecordingWriter, messages
from rim_camera_ros.bags.topics import POSE_WITH_COVARIANCE
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose

from .helpers_bags import POSE_A, POSE_B, Line, exposure, flat, pose, stamp_at, write_bag

TOPIC = "/ground_truth/board/pose_with_covariance"
_ROOT = np.random.default_rng(5).normal(size=(6, 6)) * [1e-3, 1e-3, 4e-3, 2e-3, 1e-3, 5e-4]
COVARIANCE = tuple((_ROOT.T @ _ROOT).ravel().tolist())
CERTAIN = replace(POSE_A, covariance=COVARIANCE)


def line(stamp: int, value: Pose, *, covariance: object = None) -> Line:
    message = messages.pose_with_covariance_message(value, stamp)
    if covariance is not None:
        message.pose.covariance[:] = covariance
    return Line(TOPIC, POSE_WITH_COVARIANCE, stamp, message)


def test_written_and_read_again(tmp_path: Path) -> None:
    source = write_bag(
        tmp_path / "in", flat([[pose(stamp_at(0), POSE_A), line(stamp_at(0), CERTAIN)], exposure(0)])
    )
    with Recording(source) as recording:
        (frame,) = recording.frames()
    with RecordingWriter(tmp_path / "out") as writer:
        writer.write_raw(frame)
        writer.write_raw(replace(frame, stamp=frame.stamp + 1))
    with Recording(tmp_path / "out") as recording:
        summary = recording.summary()
        again = list(recording.frames())
    counts = {one.name: (one.count, one.role) for one in summary.topics}
    assert counts[TOPIC] == (1, "truth_with_covariance")
    assert counts["/ground_truth/board/pose"] == (1, "truth")
    assert summary.truth_surfaces == ("board",)
    assert len(again) == 2
    for one in again:
        assert one.truth["board"].position == POSE_A.position
        np.testing.assert_allclose(one.truth["board"].covariance, COVARIANCE, rtol=1e-12)


@pytest.mark.parametrize("order", ["pose first", "covariance first", "covariance alone"])
def test_belongs_to_the_pose_of_its_stamp(tmp_path: Path, order: str) -> None:
    both = [pose(stamp_at(0), POSE_A), line(stamp_at(0), CERTAIN)]
    first = {"pose first": both, "covariance first": both[::-1], "covariance alone": both[1:]}[order]
    # a later pose that comes without a covariance has none
    lines = flat([first, exposure(0), exposure(1), [pose(stamp_at(2), POSE_B)], exposure(2)])
    path = write_bag(tmp_path / "bag", lines)
    with Recording(path) as recording:
        frames = list(recording.frames())
    found = [one.truth["board"] for one in frames]
    np.testing.assert_allclose(found[0].covariance, COVARIANCE, rtol=1e-12)
    assert found[1] == found[0]
    assert found[2] == POSE_B
    assert [one.pose_stamps["board"] for one in frames] == [stamp_at(0), stamp_at(0), stamp_at(2)]


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.full(36, np.nan), r"pose_with_covariance at .* the covariance of the pose is not finite"),
        (-np.eye(6).ravel(), r"has a negative variance.* \(36 numbers row by row: x y z in m"),
        (np.ones((6, 6)).ravel() * 2 - 1.5 * np.eye(6).ravel(), "has a negative variance"),
    ],
)
def test_what_is_no_covariance(tmp_path: Path, covariance: object, match: str) -> None:
    path = write_bag(tmp_path / "bag", [line(stamp_at(0), CERTAIN, covariance=covariance), *exposure(0)])
    with Recording(path) as recording, pytest.raises(InputError, match=match):
        list(recording.frames())
