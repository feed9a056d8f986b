"""Writing of recordings: exact round trips, whole or not at all, nothing foreign is replaced."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from ruamel.yaml import YAML

from rim_camera_ros.bags import Recording, RecordingWriter, Topics, messages
from rim_camera_ros.bags.topics import IMAGE, TEMPERATURE
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import CorrectedFrame, RawFrame, Settings

from .helpers_bags import (
    INTRINSICS,
    POSE_A,
    POSE_B,
    START,
    STEP,
    pair,
    pixels,
    raw_frame,
    same_frame,
    stamp_at,
    write_bag,
    write_bag1,
)

WITHOUT_SETTINGS = raw_frame(
    0, settings=Settings(extra={}), truth={}, pose_stamps={}, intrinsics=None, device=""
)


def round_trip(path: Path, frames: list[RawFrame], **options: Any) -> list[RawFrame]:
    with RecordingWriter(path, **options) as writer:
        for frame in frames:
            writer.write_raw(frame)
    with Recording(path, topics=options.get("topics")) as recording:
        read = list(recording.frames())
        assert not recording.skipped
        return read


def counts(path: Path) -> dict[str, int]:
    with Recording(path) as recording:
        return {topic.name: topic.count for topic in recording.summary().topics}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(one.relative_to(folder)): one.read_bytes() for one in folder.rglob("*") if one.is_file()}


def corrected_frame(index: int) -> CorrectedFrame:
    distance = pixels(index, dtype=np.float32) / 1000
    distance[1, 2] = np.nan
    flags = np.arange(15, dtype=np.uint8).reshape(3, 5)
    settings = Settings(integration_time=16.0, body_temperature=30.0, extra={})
    return CorrectedFrame(
        stamp=stamp_at(index),
        distance=distance,
        amplitude=distance,
        sigma=distance / 100,
        flags=flags,
        settings=settings,
    )


def test_a_raw_round_trip_is_exact(tmp_path: Path) -> None:
    frames = [raw_frame(i) for i in range(5)]
    read = round_trip(tmp_path / "rec", frames)
    assert len(read) == 5
    assert all(map(same_frame, frames, read))


@pytest.mark.parametrize(
    "frame",
    [
        raw_frame(0, distance=pixels(0, dtype=np.float32) / 7, amplitude=pixels(9, dtype=np.float32) / 3),
        raw_frame(
            0,
            distance=np.asfortranarray(pixels(0)),
            amplitude=pixels(1)[::-1],
        ),
        raw_frame(0, distance=pixels(0, (6, 10))[::2, ::2]),
        raw_frame(0, intrinsics=replace(INTRINSICS, d=())),
        raw_frame(0, pose_stamps={}, truth={"b": POSE_A}, stamp=0),
        WITHOUT_SETTINGS,
    ],
)
def test_round_trips_of_unusual_frames(tmp_path: Path, frame: RawFrame) -> None:
    (read,) = round_trip(tmp_path / "rec", [frame])
    expected = replace(frame, pose_stamps=dict.fromkeys(frame.truth, 0)) if frame.stamp == 0 else frame
    assert same_frame(read, expected)


def test_values_that_end_are_read_as_unknown(tmp_path: Path) -> None:
    frames = [raw_frame(0), raw_frame(1, settings=Settings(extra={})), raw_frame(2)]
    read = round_trip(tmp_path / "rec", frames)
    assert all(map(same_frame, frames, read))


def test_the_reference_is_kept_as_float32(tmp_path: Path) -> None:
    (read,) = round_trip(tmp_path / "rec", [raw_frame(0, settings=Settings(reference_distance=0.1))])
    assert read.settings.reference_distance == float(np.float32(0.1))


def test_other_topics(tmp_path: Path) -> None:
    topics = Topics.parse(["distance=/d", "truth=/poses/<surface>"], "/left")
    frames = [raw_frame(i) for i in range(2)]
    read = round_trip(tmp_path / "rec", frames, topics=topics, frame_id="left_optical")
    assert all(map(same_frame, frames, read))
    assert {"/d", "/left/amplitude/image_raw", "/poses/board", "/camera_info"} <= set(
        counts(tmp_path / "rec")
    )


def test_only_what_changed_is_repeated(tmp_path: Path) -> None:
    round_trip(tmp_path / "rec", [raw_frame(i) for i in range(4)])
    assert counts(tmp_path / "rec") == {
        "/camera/distance/image_raw": 4,
        "/camera/distance/camera_info": 4,
        "/camera/amplitude/image_raw": 4,
        "/camera/camera_info": 4,
        "/camera/frame_info": 4,
        "/camera/temperature": 2,
        "/camera/ambient_temperature": 1,
        "/camera/reference": 1,
        "/ground_truth/board/pose": 2,
        "/ground_truth/wall/pose": 1,
    }


def test_a_pose_with_a_new_stamp_is_a_new_station(tmp_path: Path) -> None:
    frames = [raw_frame(i, truth={"b": POSE_B}, pose_stamps={"b": stamp_at(i) - 1000}) for i in range(3)]
    assert all(map(same_frame, frames, round_trip(tmp_path / "rec", frames)))
    assert counts(tmp_path / "rec")["/ground_truth/b/pose"] == 3


def test_the_library_reads_it_with_its_times_and_frame_id(tmp_path: Path) -> None:
    round_trip(tmp_path / "rec", [raw_frame(i) for i in range(3)])
    assert sorted(one.name for one in tmp_path.iterdir()) == ["rec"]
    assert sorted(one.name for one in (tmp_path / "rec").iterdir()) == ["metadata.yaml", "rec.mcap"]
    with AnyReader([tmp_path / "rec"]) as reader:
        assert reader.start_time == START
        assert reader.end_time == stamp_at(2) + 1
        for connection, time, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            assert message.header.frame_id == "camera_optical_frame"
            if connection.msgtype == IMAGE:
                assert messages.stamp_of(message) == time


def test_playback_finds_its_quality_of_service(tmp_path: Path) -> None:
    round_trip(tmp_path / "rec", [raw_frame(0)])
    information = YAML(typ="safe").load((tmp_path / "rec/metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert (information["version"], information["storage_identifier"]) == (9, "mcap")
    profiles = {
        one["topic_metadata"]["name"]: one["topic_metadata"]["offered_qos_profiles"]
        for one in information["topics_with_message_count"]
    }
    forever = {"sec": 9223372036, "nsec": 854775807}
    assert profiles["/camera/distance/image_raw"] == [
        {
            "history": "keep_last",
            "depth": 10,
            "reliability": "reliable",
            "durability": "volatile",
            "deadline": forever,
            "lifespan": forever,
            "liveliness": "automatic",
            "liveliness_lease_duration": forever,
            "avoid_ros_namespace_conventions": False,
        }
    ]
    assert profiles["/ground_truth/board/pose"][0]["durability"] == "transient_local"


def test_corrected_frames(tmp_path: Path) -> None:
    points = np.arange(60, dtype=np.float32).reshape(3, 5, 4)
    points[0, 0, :3] = np.nan
    depth = pixels(3, dtype=np.float32) / 500
    with RecordingWriter(tmp_path / "rec") as writer:
        writer.write_corrected(corrected_frame(0), points, depth, INTRINSICS)
        writer.write_corrected(corrected_frame(1))
    with Recording(tmp_path / "rec") as recording:
        summary = recording.summary()
    assert {one.role: one.count for one in summary.topics if one.role} == {
        "camera_info": 1,
        "frame_info": 2,
        "temperature": 1,
        "points": 1,
        "sigma": 2,
        "flags": 2,
        "corrected_distance": 2,
        "depth": 1,
    }
    found: dict[str, Any] = {}
    with AnyReader([tmp_path / "rec"]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, reader.deserialize(raw, connection.msgtype))
    frame = corrected_frame(0)
    topics = Topics()
    for role, array in (
        ("corrected_distance", frame.distance),
        ("sigma", frame.sigma),
        ("flags", frame.flags),
        ("depth", depth),
    ):
        image = messages.image_array(found[topics[role]], role=role)
        assert image.tobytes() == array.tobytes()
        assert messages.stamp_of(found[topics[role]]) == START
    assert messages.points_array(found["/camera/points"]).tobytes() == points.tobytes()
    for name in ("/camera/camera_info", "/camera/distance/camera_info", "/camera/depth/camera_info"):
        assert messages.intrinsics_from(found[name])[0] == INTRINSICS


def test_raw_and_corrected_of_one_exposure(tmp_path: Path) -> None:
    frames = [raw_frame(i) for i in range(3)]
    with RecordingWriter(tmp_path / "rec") as writer:
        for i, frame in enumerate(frames):
            writer.write_raw(frame)
            writer.write_corrected(replace(corrected_frame(i), settings=Settings()), intrinsics=INTRINSICS)
    with Recording(tmp_path / "rec") as recording:
        assert all(map(same_frame, frames, recording.frames()))
    assert (
        counts(tmp_path / "rec")["/camera/frame_info"] == counts(tmp_path / "rec")["/camera/camera_info"] == 3
    )


def test_any_message_can_be_added(tmp_path: Path) -> None:
    message = messages.temperature_message(4.0, START)
    with RecordingWriter(tmp_path / "rec") as writer:
        writer.write_message("/fridge", TEMPERATURE, START, message)
        with pytest.raises(
            RimError, match="/fridge is of type sensor_msgs/msg/Temperature, not sensor_msgs/msg/Image"
        ):
            writer.write_message("/fridge", IMAGE, START, message)
        assert writer.message_count == 1
    assert counts(tmp_path / "rec") == {"/fridge": 1}


def test_nothing_is_left_after_an_exception(tmp_path: Path) -> None:
    def interrupted() -> None:
        with RecordingWriter(tmp_path / "rec") as writer:
            writer.write_raw(raw_frame(0))
            assert len(list(tmp_path.iterdir())) == 1
            assert not (tmp_path / "rec").exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_a_recording_of_nothing_is_not_kept(tmp_path: Path) -> None:
    with (
        pytest.raises(RimError, match="rec: no message came: nothing was written"),
        RecordingWriter(tmp_path / "rec"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"distance": pixels(0, dtype=np.int32)}, "an array of type int32 and shape"),
        ({"amplitude": pixels(0, dtype=np.uint8)}, "an array of type uint8 is no amplitude image"),
        ({"stamp": -1}, "the stamp -1 ns is outside"),
    ],
)
def test_frames_that_fit_no_message_are_refused(tmp_path: Path, change: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match), RecordingWriter(tmp_path / "rec") as writer:
        writer.write_raw(raw_frame(0, **change))
    assert list(tmp_path.iterdir()) == []


def test_a_writer_is_used_in_a_with_statement(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="with statement"):
        RecordingWriter(tmp_path / "rec").write_raw(raw_frame(0))


def old_folder(path: Path) -> None:
    write_bag(path, pair(7))


def old_database(path: Path) -> None:
    write_bag(path, pair(7), StoragePlugin.SQLITE3)
    (path / "metadata.yaml").unlink()


def old_bag(path: Path) -> None:
    write_bag1(path, pair(7))


@pytest.mark.parametrize("make", [old_folder, old_database, old_bag])
def test_a_recording_is_replaced_only_with_force(tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "rec"
    make(path)
    before = contents(tmp_path)
    with (
        pytest.raises(InputError, match=r"rec: exists already \(--force replaces it\)"),
        RecordingWriter(path),
    ):
        pass
    assert contents(tmp_path) == before
    with RecordingWriter(path, force=True) as writer:
        writer.write_raw(raw_frame(0))
        assert {name: data for name, data in contents(tmp_path).items() if name in before} == before
    with Recording(path) as recording:
        assert [frame.stamp for frame in recording.frames()] == [START]
    assert [one.name for one in tmp_path.iterdir()] == ["rec"]


def test_the_old_recording_stays_if_the_new_one_fails(tmp_path: Path) -> None:
    old_folder(tmp_path / "rec")
    before = contents(tmp_path)

    def failing() -> None:
        with RecordingWriter(tmp_path / "rec", force=True) as writer:
            writer.write_raw(raw_frame(0))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert contents(tmp_path) == before


def with_notes(path: Path) -> None:
    old_folder(path)
    (path / "notes.txt").write_text("keep me")


def with_subfolder(path: Path) -> None:
    old_folder(path)
    (path / "more.mcap").mkdir()


def text_file(path: Path) -> None:
    path.write_text("keep me")


def pictures(path: Path) -> None:
    path.mkdir()
    (path / "a.png").write_bytes(b"png")


def other_metadata(path: Path) -> None:
    path.mkdir()
    (path / "metadata.yaml").write_text("title: a book")


def other_mcap(path: Path) -> None:
    path.mkdir()
    (path / "a.mcap").write_text("minecraft map")


def link(path: Path) -> None:
    old_folder(path.with_name("target"))
    path.symlink_to("target")


def dangling_link(path: Path) -> None:
    path.symlink_to("nowhere")


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (with_notes, "it holds notes.txt, which is not part of a recording"),
        (with_subfolder, "it holds more.mcap, which is not part"),
        (text_file, "rec: is not replaced: it is not a recording"),
        (pictures, "it holds a.png"),
        (other_metadata, "its metadata.yaml is not a recording's"),
        (other_mcap, "its a.mcap is not a recording's"),
        (Path.mkdir, "it is an empty folder"),
        (link, "it is a link"),
        (dangling_link, "it is a link"),
    ],
)
def test_what_is_no_recording_is_never_replaced(
    tmp_path: Path, make: Callable[[Path], None], match: str
) -> None:
    make(tmp_path / "rec")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=match), RecordingWriter(tmp_path / "rec", force=True):
        pass
    assert contents(tmp_path) == before


def test_what_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def write() -> None:
        with RecordingWriter(tmp_path / "rec") as writer:
            writer.write_raw(raw_frame(0))
            text_file(tmp_path / "rec")

    with pytest.raises(InputError, match="exists already"):
        write()
    assert contents(tmp_path) == {"rec": b"keep me"}


def test_the_old_recording_comes_back_if_it_cannot_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old_folder(tmp_path / "rec")
    before = contents(tmp_path)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.parent != tmp_path and self.name == "rec":
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    def write() -> None:
        with RecordingWriter(tmp_path / "rec", force=True) as writer:
            writer.write_raw(raw_frame(0))
            monkeypatch.setattr(Path, "rename", failing)

    with pytest.raises(RimError, match="rec: cannot be written: Input/output error; nothing was left"):
        write()
    assert contents(tmp_path) == before


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    match = r"no/such/rec: its folder does not exist \(make it: mkdir -p .*/no/such\)"
    with pytest.raises(InputError, match=match), RecordingWriter(tmp_path / "no/such/rec"):
        pass


def test_the_present_folder_is_no_output() -> None:
    with pytest.raises(InputError, match="is not a name for an output"), RecordingWriter("."):
        pass


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("method", ["write", "close", "open"])
def test_a_full_disk_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, code: int
) -> None:
    original = getattr(Writer, method)
    calls: list[int] = []

    def full(self: Writer, *arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == (3 if method == "write" else 1):
            raise OSError(code, os.strerror(code))
        return original(self, *arguments)

    monkeypatch.setattr(Writer, method, full)
    match = r"rec: cannot be written: the disk is full; nothing was left behind \(make room"
    with pytest.raises(RimError, match=match) as caught, RecordingWriter(tmp_path / "rec") as writer:
        writer.write_raw(raw_frame(0))
    assert caught.value.exit_status == 1
    assert list(tmp_path.iterdir()) == []


FULL = """
import resource, sys
import numpy as np
from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.errors import RimError
from rim_camera_ros.frame import RawFrame

resource.setrlimit(resource.RLIMIT_FSIZE, (3 << 20, 3 << 20))
image = np.zeros((480, 640), np.uint16)
try:
    with RecordingWriter(sys.argv[1]) as writer:
        for i in range(20):
            writer.write_raw(RawFrame(stamp=i, distance=image, amplitude=image))
except RimError as error:
    print(error)
"""


def test_a_limit_of_the_system_on_files_is_a_full_disk(tmp_path: Path) -> None:
    """The write itself fails here, in a process that may write 3 MiB to a file."""
    run = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "rec")],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
        timeout=60,
    )
    assert run.stdout.startswith(
        f"{tmp_path}/rec: cannot be written: the disk is full; nothing was left behind"
    )
    assert run.stderr == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with (
        pytest.raises(RimError, match="cannot be written: Permission denied"),
        RecordingWriter(tmp_path / "rec"),
    ):
        pass


def test_long_recordings_keep_order_across_chunks(tmp_path: Path) -> None:
    image = np.arange(144 * 176, dtype=np.uint16).reshape(144, 176)
    frames = [
        RawFrame(
            stamp=START + i * STEP,
            distance=image + np.uint16(i),
            amplitude=image,
            truth={"b": POSE_A},
            pose_stamps={"b": 5},
        )
        for i in range(60)
    ]
    read = round_trip(tmp_path / "rec", frames)
    assert [frame.stamp for frame in read] == [frame.stamp for frame in frames]
    assert all(frame.pose_stamps == {"b": 5} for frame in read)
    assert np.array_equal(read[59].distance, frames[59].distance)
