"""Frames from recordings: pairing by stamp, poses and temperatures by time, what is assumed and counted."""

from __future__ import annotations

import math
import pickle
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags import Recording, Topics, messages
from rim_camera_ros.bags.pairing import PENDING_STAMPS, History
from rim_camera_ros.bags.topics import IMAGE
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import RawFrame, Settings

from .helpers_bags import (
    INTRINSICS,
    POSE_A,
    POSE_B,
    SHARED,
    START,
    STEP,
    Line,
    camera_info,
    exposure,
    flat,
    frame_info,
    image,
    pair,
    pixels,
    pose,
    reference,
    stamp_at,
    temperature,
    write_bag,
    write_bag1,
)


def read(path: Path, **options: Any) -> tuple[list[RawFrame], dict[str, int], list[str]]:
    """Return frames, counts of what was skipped and assumptions."""
    topics = options.pop("topics", None)
    with Recording(path, topics=topics) as recording:
        frames = list(recording.frames(**options))
        return frames, dict(recording.skipped), recording.assumptions


def read_to_error(path: Path, **options: Any) -> tuple[list[RawFrame], RimError]:
    """Return the frames before the error and the error."""
    frames: list[RawFrame] = []
    with Recording(path) as recording, pytest.raises(RimError) as caught:
        frames.extend(recording.frames(**options))
    return frames, caught.value


def test_frames_carry_everything(tmp_path: Path) -> None:
    frames, skipped, assumptions = read(write_bag(tmp_path / "bag", flat(exposure(i) for i in range(4))))
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in range(4)]
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.distance, pixels(i))
        assert np.array_equal(frame.amplitude, pixels(i + 500))
        assert frame.intrinsics == INTRINSICS
        assert frame.settings == Settings(
            integration_time=16.0, modulation_frequency=20e6, uptime=0.5 + i, extra={}
        )
        assert frame.device == "SR-3000 7"
        assert not frame.truth
    assert not skipped
    assert not assumptions


def test_frames_can_be_read_again_and_left_early(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", flat(exposure(i) for i in range(4)))
    with Recording(path) as recording:
        assert next(recording.frames()).stamp == stamp_at(0)
        assert len(list(recording.frames())) == len(list(recording.frames())) == 4


def test_frames_go_to_other_processes_and_are_read_only(tmp_path: Path) -> None:
    frames, _, _ = read(write_bag(tmp_path / "bag", pair(0)))
    assert np.array_equal(pickle.loads(pickle.dumps(frames[0])).distance, pixels(0))
    with pytest.raises(ValueError, match="read-only"):
        frames[0].distance[0, 0] = 1


def test_without_settings_and_camera_info(tmp_path: Path) -> None:
    frames, _, assumptions = read(write_bag(tmp_path / "bag", pair(0)))
    assert frames[0].settings == Settings(extra={})
    assert frames[0].intrinsics is None
    assert [said.split(":")[0] for said in assumptions] == ["no camera_info", "no frame_info"]


def test_float_images(tmp_path: Path) -> None:
    lines = [
        image("/camera/distance/image_raw", 0, dtype=np.float32),
        image("/camera/amplitude/image_raw", 0, dtype=np.float32, offset=1),
    ]
    frames, _, _ = read(write_bag(tmp_path / "bag", lines))
    assert frames[0].distance.dtype == frames[0].amplitude.dtype == np.float32
    assert frames[0].distance[2, 4] == 2286.0


def test_other_namespace_and_names(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", pair(0, "/left/tof"))
    frames, _, assumptions = read(path)
    assert len(frames) == 1
    assert assumptions[0] == "the topics are those of the namespace /left/tof"
    swapped = Topics.parse(
        ["distance=/left/tof/amplitude/image_raw", "amplitude=/left/tof/distance/image_raw"]
    )
    frames, _, _ = read(path, topics=swapped)
    assert np.array_equal(frames[0].distance, pixels(500))


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (1, 3, 0, 2)])
def test_order_within_an_exposure_does_not_matter(tmp_path: Path, order: tuple[int, ...]) -> None:
    lines = flat([exposure(i)[k] for k in order] for i in range(3))
    frames, skipped, _ = read(write_bag(tmp_path / "bag", lines))
    assert [frame.settings.uptime for frame in frames] == [0.5, 1.5, 2.5]
    assert not skipped


def test_amplitudes_that_lag_behind(tmp_path: Path) -> None:
    lines = [
        replace(line, time=line.time + 50 * STEP * (k == 1))
        for i in range(80)
        for k, line in enumerate(pair(i))
    ]
    lines.sort(key=lambda line: line.time)
    frames, skipped, _ = read(write_bag(tmp_path / "bag", lines))
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in range(80)]
    assert all(np.array_equal(frame.amplitude, pixels(i + 500)) for i, frame in enumerate(frames))
    assert not skipped


def test_what_does_not_pair_is_counted(tmp_path: Path) -> None:
    groups = [exposure(i) for i in range(6)]
    del groups[1][1]  # no amplitude
    del groups[2][0]  # no distance
    del groups[3][2]  # no camera_info
    del groups[4][3]  # no frame_info
    frames, skipped, _ = read(write_bag(tmp_path / "bag", flat(groups)))
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in (0, 3, 4, 5)]
    assert skipped == {
        "distance without amplitude": 1,
        "amplitude without distance": 1,
        "camera_info missing beside a frame": 1,
        "frame_info missing beside a frame": 1,
    }
    assert [frame.settings.integration_time for frame in frames] == [16.0, 16.0, None, 16.0]
    assert all(frame.intrinsics == INTRINSICS for frame in frames)


def test_unpaired_messages_do_not_pile_up(tmp_path: Path) -> None:
    lines = [image("/camera/distance/image_raw", i) for i in range(3 * PENDING_STAMPS)]
    lines += pair(3 * PENDING_STAMPS)
    frames, skipped, _ = read(write_bag(tmp_path / "bag", lines))
    assert len(frames) == 1
    assert skipped == {"distance without amplitude": 3 * PENDING_STAMPS}


def test_settings_without_images_are_counted(tmp_path: Path) -> None:
    lines = [*exposure(0), frame_info(1, Settings()), camera_info(1), frame_info(2, Settings())]
    _, skipped, _ = read(write_bag(tmp_path / "bag", lines))
    assert skipped == {"frame_info and camera_info without distance": 1, "frame_info without distance": 1}


def test_poses_hold_from_their_stamp(tmp_path: Path) -> None:
    lines = flat(pair(i) for i in range(5))
    lines += [pose(stamp_at(1), POSE_A), pose(stamp_at(3) + 1, POSE_B), pose(stamp_at(2), POSE_B, "wall")]
    frames, _, _ = read(write_bag(tmp_path / "bag", lines))
    board = [frame.truth.get("board") for frame in frames]
    assert board == [None, POSE_A, POSE_A, POSE_A, POSE_B]
    assert [frame.pose_stamps.get("board") for frame in frames] == [None, *[stamp_at(1)] * 3, stamp_at(3) + 1]
    assert ["wall" in frame.truth for frame in frames] == [False, False, True, True, True]


@pytest.mark.parametrize("late", [0, 1, 30, PENDING_STAMPS - 1])
def test_a_pose_recorded_late_applies_from_its_stamp(tmp_path: Path, late: int) -> None:
    lines = flat(pair(i) for i in range(100))
    lines += [pose(START - 1, POSE_A), pose(stamp_at(7), POSE_B, time=stamp_at(7 + late) + 1)]
    lines.sort(key=lambda line: line.time)
    frames, _, _ = read(write_bag(tmp_path / "bag", lines))
    assert [frame.truth["board"] for frame in frames] == [POSE_A] * 7 + [POSE_B] * 93


def test_temperatures_and_reference_are_the_last_ones(tmp_path: Path) -> None:
    lines = flat(pair(i) for i in range(4))
    lines += [
        temperature(stamp_at(0) - 5, 31.5),
        temperature(stamp_at(2), 32.25),
        temperature(stamp_at(1), 20.125, "/camera/ambient_temperature"),
        temperature(stamp_at(3), math.nan, "/camera/ambient_temperature"),
        reference(stamp_at(2) + 1, 0.375),
    ]
    frames, _, _ = read(write_bag(tmp_path / "bag", lines))
    assert [frame.settings.body_temperature for frame in frames] == [31.5, 31.5, 32.25, 32.25]
    assert [frame.settings.ambient_temperature for frame in frames] == [None, 20.125, 20.125, None]
    readings = frames[-1].settings.ambient_readings
    assert readings is not None
    assert (readings.stamps, readings.values) == ([stamp_at(1)], [20.125])
    assert [frame.settings.reference_distance for frame in frames] == [None, None, None, 0.375]


def test_poses_in_another_frame_are_mentioned(tmp_path: Path) -> None:
    line = pose(START, POSE_A)
    line.message.header.frame_id = "world"
    _, _, assumptions = read(write_bag(tmp_path / "bag", [line, *pair(0), *pair(1)]))
    assert assumptions[-1].startswith(
        "the poses of board are in the frame world, taken for that of the images"
    )


def test_history_forgets_what_is_past() -> None:
    history = History()
    for stamp, value in [(10, "a"), (30, "c"), (20, "b"), (20, "later")]:
        history.add(stamp, value)
    assert history.latest(9) is None
    assert history.latest(15) == (10, "a")
    assert history.latest(29) == (20, "later")
    history.forget(29)
    assert history.latest(15) is None
    assert history.latest(20) == (20, "later")
    assert history.latest(30) == (30, "c")
    history.forget(0)
    assert history.latest(20) == (20, "later")


def test_camera_info_of_another_size_is_not_used(tmp_path: Path) -> None:
    lines = [*pair(0), camera_info(0, replace(INTRINSICS, width=640))]
    frames, _, assumptions = read(write_bag(tmp_path / "bag", lines))
    assert frames[0].intrinsics is None
    assert "camera_info is for 640 x 3 pixels, the images are 5 x 3: it is not used" in assumptions


def test_stamps_that_run_backwards_are_an_error(tmp_path: Path) -> None:
    lines = [replace(line, time=START + n) for n, i in enumerate([0, 1, 2, 1, 2, 3]) for line in exposure(i)]
    frames, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in range(3)]
    text = f"topic /camera/distance/image_raw at {messages.stamp_text(stamp_at(1))}: the stamp is not after"
    assert text in str(error)
    assert "frames read before it: 3" in str(error)


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("length", [1, 3, 100])
def test_loops_are_counted_where_asked(tmp_path: Path, length: int, truth: bool) -> None:
    lines = []
    for lap in range(3):
        for i in range(length):
            group = exposure(i) + ([pose(stamp_at(i), POSE_A if i < 2 else POSE_B)] if truth else [])
            lines += [replace(line, time=START + (lap * length + i) * STEP) for line in group]
    frames, skipped, _ = read(write_bag(tmp_path / "bag", lines), on_backwards="count")
    assert [frame.stamp for frame in frames] == [stamp_at(i) for i in range(length)] * 3
    assert skipped == {"stamps that run backwards": 2}
    assert all(np.array_equal(frame.distance, pixels(i % length)) for i, frame in enumerate(frames))
    if truth:
        expected = [POSE_A if i < 2 else POSE_B for i in range(length)] * 3
        assert [frame.truth["board"] for frame in frames] == expected


def test_size_that_changes_is_an_error(tmp_path: Path) -> None:
    lines = [*pair(0), *pair(1), *pair(2, size=(4, 5))]
    frames, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert len(frames) == 2
    place = f"topic /camera/distance/image_raw at {messages.stamp_text(stamp_at(2))}"
    assert f"{place}: the image is 5 x 4 16UC1, before it was 5 x 3 16UC1" in str(error)


def test_encoding_that_changes_is_an_error(tmp_path: Path) -> None:
    lines = [*pair(0), image("/camera/distance/image_raw", 1, dtype=np.float32)]
    _, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert "the image is 5 x 3 32FC1, before it was 5 x 3 16UC1" in str(error)


def test_images_of_different_sizes_are_an_error(tmp_path: Path) -> None:
    lines = [image("/camera/distance/image_raw", 0), image("/camera/amplitude/image_raw", 0, size=(3, 4))]
    frames, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert not frames
    assert "the amplitude is 4 x 3, the distance 5 x 3" in str(error)


def test_wrong_length_of_data_is_an_error_with_its_place(tmp_path: Path) -> None:
    lines = [*pair(0), *pair(1)]
    lines[2].message.data = lines[2].message.data[:-1]
    frames, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert len(frames) == 1
    place = (
        f"bag: topic /camera/distance/image_raw at {messages.stamp_text(stamp_at(1))}: 29 bytes of image data"
    )
    assert place in str(error)


def test_settings_that_are_no_numbers_are_an_error_with_their_place(tmp_path: Path) -> None:
    lines = [*exposure(0), *pair(1), frame_info(1, Settings(extra={"integration_time": "auto"}))]
    frames, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert len(frames) == 1
    place = f"topic /camera/frame_info at {messages.stamp_text(stamp_at(1))}, integration_time"
    assert f"{place}: 'auto' is not a number" in str(error)
    assert isinstance(error, InputError)


@pytest.mark.parametrize(
    ("dropped", "match"),
    [
        ("amplitude", "bag: distance without amplitude: no topic /camera/amplitude/image_raw; topics of type "
         r"sensor_msgs/Image: /camera/distance/image_raw \(name it with --topic amplitude=name\)"),
        ("distance", "amplitude without distance: no topic /camera/distance/image_raw"),
    ],
)  # fmt: skip
def test_a_missing_topic_is_named(tmp_path: Path, dropped: str, match: str) -> None:
    lines = [line for line in exposure(0) if dropped not in line.topic]
    with Recording(write_bag(tmp_path / "bag", lines)) as recording, pytest.raises(InputError, match=match):
        recording.frames()


def test_no_common_stamp_is_an_error(tmp_path: Path) -> None:
    lines = [image("/camera/distance/image_raw", 0), image("/camera/amplitude/image_raw", 1)]
    _, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert "no frame in it: 1 distance without amplitude, 1 amplitude without distance" in str(error)
    assert "must carry the same stamp" in str(error)


def test_a_mono8_distance_is_refused_with_a_hint(tmp_path: Path) -> None:
    lines = pair(0, "/sr")
    lines[0] = image("/sr/distance/image_raw", 0, dtype=np.uint8)
    lines[0].message.encoding = "mono8"
    _, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert "256 steps only" in str(error)
    assert "distance/image_raw16" in str(error)


@pytest.mark.parametrize("ros1", [False, True])
def test_swissranger_recordings_with_mono8_intensity(tmp_path: Path, ros1: bool) -> None:
    lines = [image("/sr/distance/image_raw16", 0), image("/sr/intensity/image_raw", 0, dtype=np.uint8)]
    lines[0].message.encoding = "mono16"
    lines[1].message.encoding = "mono8"
    path = write_bag1(tmp_path / "a.bag", lines) if ros1 else write_bag(tmp_path / "a", lines)
    frames, _, assumptions = read(path)
    assert np.array_equal(frames[0].distance, pixels(0))
    assert np.array_equal(frames[0].amplitude, pixels(0, dtype=np.uint8).astype(np.uint16) * 256)
    assert "/sr/intensity/image_raw is mono8: one step is 256 counts" in assumptions


def test_a_mono8_amplitude_of_another_name_is_refused(tmp_path: Path) -> None:
    lines = [pair(0)[0], image("/camera/amplitude/image_raw", 0, dtype=np.uint8)]
    _, error = read_to_error(write_bag(tmp_path / "bag", lines))
    assert "encoding '8UC1' is not one for the role amplitude" in str(error)


def test_padding_and_byte_order_in_a_recording(tmp_path: Path) -> None:
    lines = pair(0)
    distance = lines[0].message
    rows = np.full((3, 13), 0xEE, np.uint8)
    rows[:, :10] = pixels(0).astype(">u2").view(np.uint8)
    distance.data, distance.step, distance.is_bigendian = rows.reshape(-1), 13, 1
    frames, _, _ = read(write_bag(tmp_path / "bag", lines))
    assert np.array_equal(frames[0].distance, pixels(0))


def test_summary_needs_no_images(tmp_path: Path) -> None:
    lines = [*flat(exposure(i) for i in range(3)), pose(START, POSE_A), pose(START, POSE_B, "wall")]
    lines.append(Line("/other", IMAGE, START, pair(0)[0].message))
    with Recording(write_bag(tmp_path / "bag", lines)) as recording:
        summary = recording.summary()
        assert recording.frame_count == summary.frame_count == 3
        assert recording.truth_surfaces == summary.truth_surfaces == ("board", "wall")
    assert summary.path == tmp_path / "bag"
    assert (summary.storage, summary.message_count, summary.damage) == ("mcap", 15, None)
    assert (summary.start, summary.duration) == (START, pytest.approx(0.08))
    assert {one.name: (one.count, one.role) for one in summary.topics} == {
        "/camera/amplitude/image_raw": (3, "amplitude"),
        "/camera/camera_info": (3, "camera_info"),
        "/camera/distance/image_raw": (3, "distance"),
        "/camera/frame_info": (3, "frame_info"),
        "/ground_truth/board/pose": (1, "truth"),
        "/ground_truth/wall/pose": (1, "truth"),
        "/other": (1, None),
    }
    assert summary.roles["truth"] == "/ground_truth/<surface>/pose"


@pytest.mark.parametrize("namespace", ["/camera", "/front"])
def test_poses_below_the_namespace(tmp_path: Path, namespace: str) -> None:
    def below(line: Line, of: str = namespace) -> Line:
        return replace(line, topic=of + line.topic.removeprefix("/camera"))

    lines = [below(one) for one in flat(exposure(i) for i in range(3))]
    lines += [below(pose(START, POSE_A)), pose(START, POSE_B, "wall"), below(pose(START, POSE_B), "/rear")]
    lines.append(pose(START, POSE_B))  # of another source: that of this camera counts
    with Recording(write_bag(tmp_path / "bag", lines)) as recording:
        summary = recording.summary()
        frames = list(recording.frames())
    assert summary.truth_surfaces == ("board", "wall")
    assert [dict(one.truth) for one in frames] == [{"board": POSE_A, "wall": POSE_B}] * 3
    roles = {one.name: one.role for one in summary.topics}
    assert roles[f"{namespace}/ground_truth/board/pose"] == "truth"
    assert roles["/ground_truth/wall/pose"] == "truth"
    assert roles["/ground_truth/board/pose"] is None
    assert roles["/rear/ground_truth/board/pose"] is None


def test_summary_of_a_foreign_recording(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", [Line("/left/image", IMAGE, START, pair(0)[0].message)])
    with Recording(path) as recording:
        summary = recording.summary()
        assert (summary.frame_count, dict(summary.roles), summary.assumptions) == (0, {}, ())
        with pytest.raises(InputError, match=r"no topic /camera/distance/image_raw.*/left/image"):
            recording.frames()


def test_a_recording_is_used_in_a_with_statement(tmp_path: Path) -> None:
    recording = Recording(write_bag(tmp_path / "bag", pair(0)))
    with pytest.raises(RuntimeError, match="with statement"):
        recording.summary()


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    lines = flat([*pair(i, size=(24, 32)), pose(stamp_at(i), POSE_A)] for i in range(2000))
    path = write_bag(tmp_path / "bag", lines)
    del lines
    with Recording(path) as recording:
        for _ in recording.frames():  # fills the caches of the decoders
            break
        tracemalloc.start()
        try:
            peaks = []
            for number, _ in enumerate(recording.frames(), 1):
                if number in (500, 1999):
                    peaks.append(tracemalloc.get_traced_memory()[1])
                    tracemalloc.reset_peak()
        finally:
            tracemalloc.stop()
    assert number == 2000
    assert peaks[1] < peaks[0] * 1.1
    assert peaks[1] < 8e6  # two chunks of 1 MiB, 64 frames of 3 KiB


@pytest.mark.parametrize(
    ("folder", "count", "size", "settings"),
    [
        ("recordings/kinect2_checkerboard", 68, (424, 512), (1.0, 80e6, None, None)),
        ("recordings/o3d303_wall", 3, (132, 176), (25.0, 15e6, None, None)),
        ("cases/scattering", 120, (72, 88), (60.0, 20e6, 179.945, 17.60380262712836)),
    ],
)
def test_real_recordings(folder: str, count: int, size: tuple[int, int], settings: tuple[Any, ...]) -> None:
    path = SHARED / folder / "recording"
    if not path.exists():
        pytest.skip(f"the recordings are not there: {path}")
    with Recording(path) as recording:
        assert recording.frame_count == count
        frames = list(recording.frames())
        assert not recording.skipped
        assert not recording.assumptions
        surfaces = recording.truth_surfaces
    assert len(frames) == count
    assert {frame.shape for frame in frames} == {size}
    first = frames[0].settings
    found = (first.integration_time, first.modulation_frequency, first.uptime, first.ambient_temperature)
    assert found == settings
    assert all(set(frame.truth) == set(surfaces) for frame in frames)
    assert all(frame.intrinsics is not None and frame.intrinsics.width == size[1] for frame in frames)
    assert all(a.stamp < b.stamp for a, b in pairwise(frames))


def test_poses_of_a_case_come_before_their_three_frames() -> None:
    path = SHARED / "cases/scattering/recording"
    if not path.exists():
        pytest.skip(f"the recordings are not there: {path}")
    with Recording(path) as recording:
        stamps = [(frame.pose_stamps["wall"], frame.stamp) for frame in recording.frames()]
    assert len({pose_stamp for pose_stamp, _ in stamps}) == 40
    assert all(stamps[i][0] == stamps[i + 2][0] == stamps[i][1] - 1000 for i in range(0, 120, 3))
