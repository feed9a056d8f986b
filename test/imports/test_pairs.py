"""Which images belong together, and what becomes of those that do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rim_camera_ros.bags import Recording
from rim_camera_ros.imports.stamps import Series, half_period, header_stamp, pairs
from test.helpers_bags import JAZZY, Line, to_ros1
from test.helpers_cli import run
from test.imports.drivers import PERIOD, START, amplitude, depth, image, info, write_driver_bag

stamps = st.lists(st.integers(0, 400), min_size=1, max_size=30).map(lambda x: np.array(x, np.int64))


@given(stamps, stamps, st.integers(0, 40))
def test_pairs_are_mutual_nearest_and_within_the_tolerance(first: Any, second: Any, tolerance: int) -> None:
    found = pairs(first, second, tolerance=tolerance)
    assert len(set(found.values())) == len(found)
    for one, other in found.items():
        assert abs(one - other) <= tolerance
        assert abs(one - other) == np.abs(second - one).min() == np.abs(first - other).min()
    # with equal stamps nothing is lost
    for one in set(first.tolist()) & set(second.tolist()):
        assert found[one] == one


def test_half_a_period_ignores_gaps() -> None:
    assert half_period(np.array([0, 10, 20, 30, 500, 510], np.int64)) == 5
    assert half_period(np.array([7], np.int64)) == 500_000_000


def test_settings_of_a_long_recording_are_all_kept() -> None:
    series = Series()
    for i in range(30_000):
        series.add(10 * (i ^ 1), float(i ^ 1))  # neighbours exchanged
    assert series.latest(-1) is None
    assert (series.latest(0), series.latest(15), series.latest(20)) == (0.0, 1.0, 2.0)
    assert series.latest(10**9) == 29_999.0


def test_stamp_of_bytes() -> None:
    line = image(depth().astype(np.float32), "/d", 1_234_567_890_987_654_321)
    raw = bytes(JAZZY.serialize_cdr(line.message, line.msgtype))
    assert header_stamp(raw, ros1=False) == 1_234_567_890_987_654_321
    assert header_stamp(to_ros1(line.message, line.msgtype), ros1=True) == 1_234_567_890_987_654_321
    big = bytes(JAZZY.serialize_cdr(line.message, line.msgtype, little_endian=False))
    assert header_stamp(big, ros1=False) == 1_234_567_890_987_654_321
    assert header_stamp(raw[:11], ros1=False) is None


def pico(offsets: list[tuple[float | None, float | None]]) -> list[Line]:
    """Return images of a pico flexx at (distance, amplitude) stamps in periods, None for none."""
    lines = [info("/pico_flexx/camera_info", START)]
    for i, (distance, grey) in enumerate(offsets):
        for when, array, name in ((distance, depth(i), "image_depth"), (grey, amplitude(i), "image_mono16")):
            if when is not None:
                stamp = START + round(when * PERIOD)
                kind = np.float32 if name == "image_depth" else np.uint16
                lines.append(image(array.astype(kind), f"/pico_flexx/{name}", stamp))
    return lines


def test_images_without_a_partner_are_counted(tmp_path: Path, capsys: Any) -> None:
    offsets = [(0, 0.4), (1, 1.4), (2, None), (3, 3.4), (None, 4.4), (5, 5.7)]
    bag = write_driver_bag(tmp_path / "bag", pico(offsets), ros1=False)
    status, said, notes = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert (status, said.split(" imported")[0]) == (0, "3 frames")
    assert "excluded: 2 distance images without a partner within half a period" in notes
    assert "excluded: 2 amplitude images without a partner" in notes
    assert "up to 13.3 ms apart (half a period: 16.7 ms)" in notes
    with Recording(tmp_path / "out") as recording:
        frames = list(recording.frames())
    assert [int(one.amplitude[0, 0]) for one in frames] == [400, 401, 403]


def test_order_in_the_recording_does_not_matter(tmp_path: Path, capsys: Any) -> None:
    lines = pico([(0, 0.4), (1, 1.4), (2, 2.4)])
    for line in lines:  # all amplitudes were written after all distances
        line.time = START + (10 * PERIOD if line.topic.endswith("mono16") else 0)
    bag = write_driver_bag(tmp_path / "bag", lines, ros1=False)
    status, said, _ = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert (status, said.split(" imported")[0]) == (0, "3 frames")


def test_images_without_stamps_take_the_time_of_recording(tmp_path: Path, capsys: Any) -> None:
    lines = pico([(0, 0.1), (1, 1.1), (2, 2.1)])
    for line in lines:
        line.message.header.stamp.sec = line.message.header.stamp.nanosec = 0
    bag = write_driver_bag(tmp_path / "bag", lines, ros1=False)
    status, _, notes = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert status == 0
    assert "the images carry no stamps: the times of recording are taken" in notes
    with Recording(tmp_path / "out") as recording:
        assert [one.stamp for one in recording.frames()] == [START + i * PERIOD for i in range(3)]


def test_two_clocks_are_an_error(tmp_path: Path, capsys: Any) -> None:
    bag = write_driver_bag(tmp_path / "bag", pico([(0, 9000.5), (1, 9001.5), (2, 9002.5)]), ros1=False)
    status, _, error = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert status == 2
    assert "no distance image has an amplitude image within half a period (16.7 ms)" in error
    assert error.strip().endswith("(record both with one clock)")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ([], "rim: --out: nothing says where to write (rim import BAG --out BAG2)"),
        (["--out", "OUT", "--profile", "kinect2_brige"], "kinect2_brige: no profile of this name (did you "
         "mean 'kinect2_bridge'? shipped: azure_kinect,"),
        (["--out", "OUT", "--profile", "none.yaml"], "none.yaml: no such profile (give a file or one"),
        (["--out", "OUT", "--profile", "azure_kinect"], "bag: no distance image /depth/image_raw, raw or "
         "compressed; images: /pico_flexx/image_depth, /pico_flexx/image_mono16 (--topic distance=NAME"),
        (["--out", "OUT", "--topic", "sigma=/x"], "--topic: the role sigma is not imported (roles: distance"),
        (["--out", "OUT", "--topic", "amplitude=/pico_flexx/image_depth"], "/pico_flexx/image_depth is both "
         "distance and amplitude"),
        (["--out", "OUT", "--topic", "camera_info=/x"], "no topic /x of type sensor_msgs/CameraInfo (there "
         "are: /pico_flexx/camera_info)"),
        (["--out", "OUT", "--namespace", "/left"], "no driver that is known"),
        (["--out", "OUT", "--distance-kind", "points"], "the image has one value a pixel (--distance-kind"),
        (["--out", "OUT", "--integration-time", "0"], "argument --integration-time: must be positive"),
        (["--out", "OUT", "--camera-info", "ost.yaml"], "ost.yaml: no such file"),
    ],
)  # fmt: skip
def test_bad_usage_is_one_line(tmp_path: Path, capsys: Any, options: list[str], error: str) -> None:
    bag = write_driver_bag(tmp_path / "bag", pico([(0, 0), (1, 1)]), ros1=False)
    given_options = [str(tmp_path / "out") if one == "OUT" else one for one in options]
    status, _, said = run(capsys, "import", bag, *given_options)
    assert status == 2
    assert error in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_profile_of_ones_own(tmp_path: Path, capsys: Any) -> None:
    bag = write_driver_bag(tmp_path / "bag", pico([(0, 0), (1, 1)]), ros1=False)
    own = tmp_path / "mine.yaml"
    text = (
        "format: rim_profile/1\ndriver: mine\nsource: [here]\ndevice: Mine\n"
        "distance: {topics: [image_depth], kind: radial}\namplitude: {topics: [image_mono16]}\n"
        "camera_info: {topics: [camera_info]}\n"
    )
    own.write_text(text)
    status, said, _ = run(capsys, "import", bag, "--profile", own, "--out", tmp_path / "out")
    assert (status, said) == (0, f"2 frames imported from mine: {tmp_path / 'out'}\n")
    for wrong, error in (
        (text.replace("radial", "deep"), "distance.kind (line 5): unknown value 'deep'"),
        (text.replace("radial", "z"), "distance (line 5): unit is missing (depth along z needs metres"),
        (text.replace("rim_profile/1", "x"), "not a profile: format is 'x' (expected format: rim_profile/1)"),
        (text + "distanse: {}\n", "distanse (line 8): unknown key (did you mean 'distance'?)"),
        (text + "name: x\n", "name (line 8): unknown key"),
    ):
        own.write_text(wrong)
        status, _, said = run(capsys, "import", bag, "--profile", own, "--out", tmp_path / "out2")
        assert status == 2
        assert error in said


def test_settings_that_cannot_be_read_are_named(tmp_path: Path, capsys: Any) -> None:
    bag = write_driver_bag(tmp_path / "bag", pico([(0, 0), (1, 1)]), ros1=False)
    own = tmp_path / "mine.yaml"
    for path, error in (
        ("header.stam", "header.stam: no field 'stam' (did you mean 'stamp'?)"),
        ("header.frame_id", "header.frame_id is no number but 'optical'"),
        ("header.frame_id.x", "the text before 'x' is not JSON"),
        ("k.12", "k.12: no element '12'"),
    ):
        own.write_text(
            "format: rim_profile/1\ndriver: mine\nsource: [here]\ndevice: Mine\n"
            "distance: {topics: [image_depth], kind: radial}\namplitude: {topics: [image_mono16]}\n"
            "camera_info: {topics: [camera_info]}\n"
            f"body_temperature: {{topics: [camera_info], path: {path}}}\n"
        )
        status, _, said = run(capsys, "import", bag, "--profile", own, "--out", tmp_path / "out")
        assert status == 2
        assert error in said


def test_own_recordings_need_no_import(tmp_path: Path, capsys: Any) -> None:
    lines = [
        image(depth().astype(np.float32), "/camera/distance/image_raw", START),
        image(amplitude(), "/camera/amplitude/image_raw", START),
    ]
    bag = write_driver_bag(tmp_path / "bag", lines, ros1=False)
    status, _, error = run(capsys, "import", bag, "--out", tmp_path / "out")
    assert (status, "own already (no import is needed: rim info BAG)" in error) == (2, True)


def test_list_names_every_profile_and_its_source(capsys: Any) -> None:
    status, said, _ = run(capsys, "import", "--list")
    assert status == 0
    assert "kinect2_bridge: github code-iai/iai_kinect2 at 0e2c5f6" in said
    assert "swissranger_camera" in said
