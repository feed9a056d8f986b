"""Effects put into frames by the forward chain, how visible they are, and what reports are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.frame import Pose, RawFrame, Settings

from .planted import half_of, judged, planted, summary, visible

CAMERA = """
format: rim_camera/1
device: test
sensor: {width: 12, height: 9, modulation_frequency: 30.0e6, distance_lsb: 3.0e-4}
optics: {fx: 14.0, fy: 14.0, cx: 5.7, cy: 4.2}
radiometry: {gain: 120.0}
noise: {floor: 0.003, shot: 0.0, amplitude: 6.0}
"""


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return load_camera(tmp_path / "camera.yaml")


def frame(number: int, amplitude: np.ndarray) -> RawFrame:
    distance = np.full((9, 12), 5000 + 40 * number, np.uint16)
    distance[2, 3] = 0
    return RawFrame(
        stamp=number * 10**9,
        distance=distance,
        amplitude=np.round(amplitude).astype(np.uint16),
        settings=Settings(integration_time=1.0, modulation_frequency=30e6),
        truth={"wall": Pose((0.0, 0.0, 1.5), (0.0, 0.0, 0.0, 1.0))},
        pose_stamps={"wall": number * 10**9},
    )


def pattern(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(200, 900, (9, 12))


def test_distances_move_by_the_term_and_missing_pixels_stay_missing(camera: Camera) -> None:
    before = frame(0, pattern(1))
    after = planted(before, AmplitudeOffset({1.0: Hyperbola(7.3, 0.0)}), camera)
    seen = before.distance > 0
    apart = after.distance[seen] - (before.distance * 3e-4 + 7.3 / before.amplitude)[seen] / 3e-4
    # dithered by half a count and rounded: a triangle of one count to either side
    assert np.abs(apart).max() <= 1.0
    assert np.std(apart) == pytest.approx(np.sqrt(1 / 6), rel=0.25)
    np.testing.assert_array_equal(after.amplitude[seen], before.amplitude[seen])
    assert after.distance[2, 3] == 0
    assert after.amplitude[2, 3] == 0
    assert after.truth == before.truth
    spread = planted(before, Scattering((Kernel(0.3, (2.0, 2.0)),)), camera)
    assert np.std(spread.amplitude[seen].astype(float)) < 0.85 * np.std(before.amplitude[seen].astype(float))


def test_what_offsets_and_tilts_take_on_is_not_visible(camera: Camera) -> None:
    even = [frame(k, np.full((9, 12), 500.0 + 30 * k)) for k in range(6)]
    assert visible(even, "amplitude_offset", camera) < 1e-6
    same = [frame(k, pattern(4)) for k in range(6)]
    assert visible(same, "amplitude_offset", camera) < 1e-6
    other = [frame(k, pattern(10 + k)) for k in range(6)]
    # all offsets and tilts at once
    level = np.median(np.concatenate([one.amplitude.ravel() for one in other]))
    rows, right = [], []
    for number, one in enumerate(other):
        for pixel in np.flatnonzero(one.distance):
            length = float(one.distance.flat[pixel]) * 3e-4
            row = np.zeros(9 * 12 + 3 * 6)
            row[pixel] = 1.0
            x, y, _ = length * camera.rays.reshape(-1, 3)[pixel]
            row[108 + 3 * number : 111 + 3 * number] = 1.0, x, y
            amplitude = float(one.amplitude.flat[pixel])
            sigma = np.hypot(0.003, 6.0 / amplitude)
            rows.append(row / sigma)
            right.append(0.001 * level / amplitude / sigma)
    design, seen = np.array(rows), np.array(right)
    left = seen - design @ np.linalg.lstsq(design, seen, rcond=None)[0]
    assert visible(other, "amplitude_offset", camera) == pytest.approx(np.mean(left**2), rel=0.02)


def test_halves_take_turns(camera: Camera, tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "recording") as writer:
        for number in range(7):
            writer.write_raw(frame(number, pattern(number)))
    odd = list(half_of(tmp_path, 1, 2, 1))
    assert [one.stamp for one in odd] == [10**9, 3 * 10**9, 5 * 10**9]
    assert odd[0].distance.shape == (4, 6)
    np.testing.assert_array_equal(odd[0].amplitude, np.round(pattern(1)).astype(np.uint16)[1::2, 1::2])
    assert [one.stamp for one in half_of(tmp_path, 0, 1, 2)] == [0, 4 * 10**9]


def test_names_are_held_against_what_was_put_in() -> None:
    null = {
        "name": "null",
        "verdict": "missing_physics",
        "missing": ["radiometry"],
        "adjusted": [],
        "tied": [],
    }
    said = {**null, "name": "scattering", "missing": ["radiometry", "scattering"], "size": 0.04}
    assert judged(said, null) == ("named", [])
    tied = {**said, "missing": ["amplitude_offset"], "tied": [["amplitude_offset", "scattering"]]}
    assert judged(tied, null) == ("tied", [])
    wrong = {**said, "missing": ["emitter_offset", "unknown"]}
    assert judged(wrong, null) == ("no", ["emitter_offset"])
    moved = {**said, "missing": [], "adjusted": ["scattering"]}
    assert judged(moved, null) == ("named", [])
    page = summary([null, said, wrong])
    assert "named 1 of 2, wrong names beside in 1" in page


def test_what_no_camera_has_is_not_judged() -> None:
    null = {"name": "null", "verdict": "consistent", "missing": [], "adjusted": [], "tied": []}
    hidden = {**null, "name": "distance_scale", "verdict": "not visible", "size": 0.8}
    named = {
        **null,
        "name": "scattering",
        "verdict": "missing_physics",
        "missing": ["scattering"],
        "size": 0.2,
    }
    table = summary([null, hidden, named])
    assert "| distance_scale | 0.8 | not visible |  |  |  |" in table
    assert "named 1 of 1, wrong names beside in 0" in table
