"""``rim import`` on recordings as each driver publishes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rim_camera_ros.bags import Recording
from rim_camera_ros.bags.topics import CAMERA_INFO, IMAGE
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose, RawFrame
from rim_camera_ros.imports.profile import TEMPLATE, load_profile, shipped_profiles
from rim_camera_ros.imports.sources import recognise
from test.helpers_bags import Line, pose
from test.helpers_cli import run
from test.imports.drivers import (
    EQUIDISTANT,
    EXPOSURES,
    METADATA,
    PERIOD,
    PLUMB_BOB,
    RATIONAL,
    SHAPE,
    START,
    Own,
    amplitude,
    compressed_depth,
    depth,
    encoded,
    image,
    info,
    json_text,
    own_line,
    packed,
    points_image,
    write_driver_bag,
)

FRAMES = 3
STAMPS = [START + i * PERIOD for i in range(FRAMES)]


def imported(capsys: Any, bag: Path, *options: str) -> tuple[list[RawFrame], str]:
    """Return the frames and notes of an import that must succeed."""
    out = bag.parent / "imported"
    status, said, notes = run(capsys, "import", bag, "--out", out, *options)
    assert status == 0, notes
    assert f"{FRAMES} frames" in said
    with Recording(out) as recording:
        frames = list(recording.frames())
        assert not any(recording.skipped.values())
    return frames, notes


def stretch(d: Any = PLUMB_BOB, *, fisheye: bool = False) -> Any:
    """Return distance over depth along z of the lens of `info`, by OpenCV's inversion."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    k = np.array([[30.5, 0, 15.2], [0, 31.0, 12.4], [0, 0, 1]])
    d = np.array(d)
    if fisheye:
        xy = cv2.fisheye.undistortPoints(pixels, k, d)
    else:
        xy = cv2.undistortPoints(pixels, k, d)
        for _ in range(200):  # until it stands
            back = cv2.projectPoints(
                np.concatenate([xy.reshape(-1, 2), np.ones((len(xy), 1))], 1), np.zeros(3), np.zeros(3), k, d
            )[0]
            xy = xy - (back.reshape(-1, 1, 2) - pixels) / 40.0
    return np.sqrt(1 + (xy.reshape(*SHAPE, 2) ** 2).sum(axis=-1))


def millimetres(index: int = 0) -> Any:
    return np.rint(depth(index) * 1e3).astype(np.uint16)


def check(frames: list[RawFrame], expected: Any, *, within: float = 2e-5) -> None:
    """Check stamps, radial distances [m] and 0 where there was none."""
    assert [one.stamp for one in frames] == STAMPS
    for i, one in enumerate(frames):
        assert one.distance.dtype == np.float32
        assert one.distance[3, 5] == 0.0
        assert np.abs(one.distance - expected(i)).max() < within
        assert np.array_equal(one.amplitude, amplitude(i))


@pytest.mark.parametrize("metres", [False, True])
def test_azure_kinect(tmp_path: Path, capsys: Any, metres: bool) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        z = depth(i).astype(np.float32) if metres else millimetres(i)
        lines += [
            image(z, "/depth/image_raw", stamp),
            image(amplitude(i), "/ir/image_raw", stamp, "mono16"),
            info("/depth/camera_info", stamp, model="rational_polynomial", d=RATIONAL),
            info("/ir/camera_info", stamp, model="rational_polynomial", d=RATIONAL),
            image(np.zeros(SHAPE, np.float32), "/depth_to_rgb/image_raw", stamp),
        ]
    frames, notes = imported(capsys, write_driver_bag(tmp_path / "bag", lines, ros1=False))
    factor = stretch(RATIONAL)
    check(frames, lambda i: (depth(i) if metres else millimetres(i) / 1e3) * factor)
    assert "the lens model rational_polynomial is converted to plumb_bob: residual" in notes
    assert frames[0].device == "Azure Kinect DK"
    assert frames[0].settings.extra["distance_lsb"] == "0.001"
    assert frames[0].settings.integration_time is None
    assert "no integration time" in notes


def test_kinect2_bridge_with_compressed_images_of_ros1(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        tiff, png = encoded(millimetres(i), ".tif"), encoded(amplitude(i), ".png")
        lines += [
            packed(tiff, "16UC1; tiff compressed", "/kinect2/sd/image_depth/compressed", stamp),
            packed(png, "16UC1; png compressed", "/kinect2/sd/image_ir/compressed", stamp),
            info("/kinect2/sd/camera_info", stamp),
        ]
    bag = write_driver_bag(tmp_path / "kinect.bag", lines, ros1=True)
    frames, notes = imported(capsys, bag, "--integration-time", "7.5", "--modulation-frequency", "80e6")
    check(frames, lambda i: millimetres(i) / 1e3 * stretch())
    assert frames[1].settings.integration_time == 7.5
    assert frames[1].settings.modulation_frequency == 80e6
    assert "/kinect2/sd/image_depth/compressed is the distance (depth along z)" in notes
    assert "converted to plumb_bob" not in notes
    assert frames[0].intrinsics is not None
    assert frames[0].intrinsics.d == pytest.approx(PLUMB_BOB)


def test_kinect2_bridge_rectified(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(millimetres(i), "/kinect2/sd/image_depth_rect", stamp),
            image(amplitude(i), "/kinect2/sd/image_ir_rect", stamp),
            info("/kinect2/sd/camera_info", stamp),
        ]
    frames, notes = imported(capsys, write_driver_bag(tmp_path / "bag", lines, ros1=True))
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    factor = np.sqrt(1 + ((u - 15.7) / 28.5) ** 2 + ((v - 12.15) / 29.5) ** 2)
    check(frames, lambda i: millimetres(i) / 1e3 * factor)
    assert "the images are rectified: P of camera_info, no distortion" in notes


def test_orbbec_femto_with_metadata_and_stamps_apart(tmp_path: Path, capsys: Any) -> None:
    """Exposure from the JSON of its metadata; eight coefficients that the driver calls plumb_bob."""
    late = PERIOD // 3
    lines, own = [], []
    kind = Own("orbbec_camera_msgs/msg/Metadata", METADATA)
    for i, stamp in enumerate(STAMPS):
        lines += [
            compressed_depth(millimetres(i), "/camera/depth/image_raw", stamp),
            image(amplitude(i), "/camera/ir/image_raw", stamp + late, "mono16"),
            info("/camera/depth/camera_info", stamp, d=RATIONAL),
        ]
        text = json_text(frame_number=7 + i, exposure=1000 + 10 * i, gain=16)
        own.append(own_line(kind, "/camera/depth/metadata", stamp, json_data=text))
    frames, notes = imported(capsys, write_driver_bag(tmp_path / "bag", lines, own, ros1=False))
    check(frames, lambda i: millimetres(i) / 1e3 * stretch(RATIONAL))
    assert [one.settings.integration_time for one in frames] == [1000.0, 1010.0, 1020.0]
    assert "distance and amplitude are up to 11.1 ms apart (half a period: 16.7 ms)" in notes
    assert "rational_polynomial is converted" in notes


TOF_INFO = Own("ifm3d_ros2/msg/TOFInfo", load_profile("ifm3d_o3r").body_temperature.definition or "")  # type: ignore[union-attr]


def test_ifm3d_o3r_equidistant_with_temperature(tmp_path: Path, capsys: Any) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(TOF_INFO.definition, TOF_INFO.msgtype))
    types: Any = store.types

    def header() -> Any:
        time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        return types["std_msgs/msg/Header"](stamp=time, frame_id="")

    def lens(name: str) -> Any:
        return types[f"ifm3d_ros2/msg/{name}"](
            header=header(), model_id=2, model_parameters=np.zeros(32, np.float32)
        )

    lines, own = [], []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image((depth(i)).astype(np.float32), "/ifm3d/camera/distance", stamp),
            image(amplitude(i), "/ifm3d/camera/raw_amplitude", stamp),
            image(amplitude(i) * 0, "/ifm3d/camera/amplitude", stamp),
            info("/ifm3d/camera/camera_info", stamp, model="equidistant", d=EQUIDISTANT),
        ]
        extrinsics = types["ifm3d_ros2/msg/Extrinsics"](
            header=header(), tx=0.0, ty=0.0, tz=0.0, rot_x=0.0, rot_y=0.0, rot_z=0.0
        )
        fields = {
            "measurement_block_index": 0, "measurement_range_min": 0.0, "measurement_range_max": 8.0,
            "version": 4, "distance_resolution": 0.001, "amplitude_resolution": 1.0,
            "amp_normalization_factors": np.ones(3, np.float32), "extrinsics": extrinsics,
            "intrinsics": lens("Intrinsics"), "inverse_intrinsics": lens("InverseIntrinsics"),
            "exposure_timestamps_ns": np.zeros(3, np.uint64), "exposure_times_s": np.zeros(3, np.uint32),
            "illu_temperature": 41.25 + i, "mode": "standard_range2m", "imager": "38k",
        }  # fmt: skip
        own.append(own_line(TOF_INFO, "/ifm3d/camera/tof_info", stamp, **fields))
    frames, notes = imported(capsys, write_driver_bag(tmp_path / "bag", lines, own, ros1=False))
    check(frames, depth, within=1e-6)  # already radial
    assert [one.settings.body_temperature for one in frames] == [41.25, 42.25, 43.25]
    assert "the lens model equidistant is converted to plumb_bob: residual" in notes


def test_ifm3d_o3d3xx_with_a_calibration_file(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(millimetres(i), "/ifm3d/camera/distance", stamp),
            image(amplitude(i), "/ifm3d/camera/amplitude", stamp),
            image(np.zeros(SHAPE, np.uint8), "/ifm3d/camera/good_bad_pixels", stamp),
            image(np.zeros(SHAPE, np.uint8), "/ifm3d/camera/xyz_image", stamp),
        ]
    bag = write_driver_bag(tmp_path / "o3d.bag", lines, ros1=True)
    ost = tmp_path / "ost.yaml"
    ost.write_text(
        "image_width: 32\nimage_height: 24\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [30.5, 0, 15.2, 0, 31, 12.4, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.2, 0, 0, 0]}\n"
    )
    frames, notes = imported(capsys, bag, "--camera-info", str(ost))
    for i, one in enumerate(frames):  # counts stay counts
        assert one.distance.dtype == np.uint16
        assert np.array_equal(one.distance, millimetres(i))
        assert one.settings.extra["distance_lsb"] == "0.001"
        assert one.intrinsics is not None
        assert one.intrinsics.d == (-0.1, 0.2, 0.0, 0.0, 0.0)
    assert "by the profile ifm3d_o3d3xx" in notes


def test_pico_flexx(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(depth(i).astype(np.float32), "/pico_flexx/image_depth", stamp),
            image(amplitude(i), "/pico_flexx/image_mono16", stamp, "mono16"),
            info("/pico_flexx/camera_info", stamp),
        ]
    frames, _ = imported(capsys, write_driver_bag(tmp_path / "pico.bag", lines, ros1=True))
    check(frames, lambda i: depth(i) * stretch())


def test_royale_points_and_exposures(tmp_path: Path, capsys: Any) -> None:
    base = "/royale_ros/camera/stream/1"
    direction = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 32), np.linspace(-0.4, 0.4, 24)), axis=-1)
    lines, own = [], []
    for i, stamp in enumerate(STAMPS):
        xyz = np.concatenate([direction, np.ones((*SHAPE, 1))], axis=-1) * depth(i)[..., None]
        lines += [
            points_image(xyz, f"{base}/xyz", stamp),
            image(amplitude(i), f"{base}/gray", stamp),
            info(f"{base}/camera_info", stamp),
        ]
        kind = Own("royale_ros/msg/ExposureTimes", EXPOSURES)
        usec = np.array([200, 1000 + i, 1000 + i], np.uint32)
        own.append(own_line(kind, f"{base}/exposure_times", stamp, usec=usec))
    frames, _ = imported(capsys, write_driver_bag(tmp_path / "royale.bag", lines, own, ros1=True))
    check(frames, lambda i: depth(i) * np.sqrt(1 + (direction**2).sum(axis=-1)))
    assert [one.settings.integration_time for one in frames] == [1000.0, 1001.0, 1002.0]


def test_realsense_l515(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(millimetres(i), "/camera/depth/image_rect_raw", stamp),
            image((amplitude(i) // 8).astype(np.uint8), "/camera/infra/image_raw", stamp, "mono8"),
            info("/camera/depth/camera_info", stamp, d=(0.0,) * 5),
            image(np.zeros(SHAPE, np.uint8), "/camera/confidence/image_rect_raw", stamp, "mono8"),
        ]
    frames, _ = imported(capsys, write_driver_bag(tmp_path / "bag", lines, ros1=False))
    for i, one in enumerate(frames):
        assert np.abs(one.distance - millimetres(i) / 1e3 * stretch((0.0,) * 5)).max() < 2e-5
        assert np.array_equal(one.amplitude, amplitude(i) // 8)
        assert one.amplitude.dtype == np.uint16


def test_basler_tof(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(millimetres(i), "/camera/depth/image_raw", stamp),
            image(amplitude(i), "/camera/intensity/image_raw", stamp, "mono16"),
            image(amplitude(i), "/camera/confidence/image_raw", stamp, "mono16"),
            info("/camera/depth/camera_info", stamp),
        ]
    frames, _ = imported(capsys, write_driver_bag(tmp_path / "basler.bag", lines, ros1=True))
    check(frames, lambda i: millimetres(i) / 1e3 * stretch())


def test_basler_blaze_needs_its_range(tmp_path: Path, capsys: Any) -> None:
    base = "/my_blaze/pylon_ros2_camera_node/blaze_"
    least, most = 0.25, 3.0
    lines = []
    for i, stamp in enumerate(STAMPS):
        counts = np.where(depth(i) > 0, (depth(i) - least) * 65535 / (most - least), 0).astype(np.uint16)
        lines += [
            image(counts, f"{base}depth_map", stamp),
            image(amplitude(i), f"{base}intensity", stamp, "mono16"),
            info(f"{base}camera_info", stamp, d=(0.0,) * 5),
        ]
    bag = write_driver_bag(tmp_path / "bag", lines, ros1=False)
    status, _, error = run(capsys, "import", bag, "--out", tmp_path / "imported")
    assert status == 2
    assert "--distance-unit: the unit of the distance is not in the recording: the driver stretches" in error
    unit = f"{(most - least) / 65535:.12g}"
    frames, notes = imported(capsys, bag, "--distance-unit", unit, "--distance-offset", str(least))
    check(frames, lambda i: depth(i) * stretch((0.0,) * 5), within=2 * (most - least) / 65535)
    assert "these amplitudes are no amplitudes" in notes


def test_sick_visionary_in_quarters_of_a_millimetre(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(np.rint(depth(i) * 4e3).astype(np.uint16), "/sick_visionary_t_mini/depth", stamp),
            image(amplitude(i), "/sick_visionary_t_mini/intensity", stamp),
            info("/sick_visionary_t_mini/camera_info", stamp, model=""),
        ]
    frames, _ = imported(capsys, write_driver_bag(tmp_path / "sick.bag", lines, ros1=True))
    for i, one in enumerate(frames):
        assert one.distance.dtype == np.uint16
        assert np.array_equal(one.distance, np.rint(depth(i) * 4e3))
        assert float(one.settings.extra["distance_lsb"]) == 0.00025


def test_swissranger_camera(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(amplitude(i) * 20, "/SwissRanger/distance/image_raw16", stamp, "mono16"),
            image(np.zeros(SHAPE, np.uint8), "/SwissRanger/distance/image_raw", stamp, "mono8"),
            image((amplitude(i) // 8).astype(np.uint8), "/SwissRanger/intensity/image_raw", stamp, "mono8"),
            info("/SwissRanger/camera_info", stamp),
        ]
    bag = write_driver_bag(tmp_path / "sr.bag", lines, ros1=True)
    frames, _ = imported(capsys, bag, "--integration-time", "30", "--modulation-frequency", "30e6")
    for i, one in enumerate(frames):
        assert np.array_equal(one.distance, amplitude(i) * 20)
        assert np.array_equal(one.amplitude, (amplitude(i) // 8) * 257)  # 255 counts are 65535
        assert "distance_lsb" not in one.settings.extra


@pytest.mark.parametrize("name", shipped_profiles())
def test_each_driver_is_recognised_by_what_it_publishes(name: str) -> None:
    profile = load_profile(name)
    assert any(one.startswith("github ") for one in profile.source)
    types = {f"{profile.namespace}/{one}": "x/msg/Y" for one in profile.also}
    for one in (profile.distance, profile.amplitude):
        types[f"{profile.namespace}/{one.topics[0]}"] = IMAGE
    types[f"{profile.namespace}/{profile.camera_info.topics[0]}"] = CAMERA_INFO
    assert recognise(types).name == name


def test_twins_must_be_distinguished() -> None:
    types = {"/a/depth/image_raw": IMAGE, "/a/ir/image_raw": IMAGE}
    with pytest.raises(
        InputError,
        match=r"could be those of azure_kinect or orbbec_femto \(say which: --profile azure_kinect",
    ):
        recognise(types)
    with pytest.raises(InputError, match=r"no driver that is known; images: /x \(name one with --profile"):
        recognise({"/x": IMAGE})


def test_template_is_a_profile() -> None:
    assert load_profile(TEMPLATE).distance.kind == "z"
    assert TEMPLATE not in shipped_profiles()


def test_true_poses_come_along(tmp_path: Path, capsys: Any) -> None:
    lines: list[Line] = [pose(START - 5, Pose((0.1, 0.2, 1.5), (0.1, 0.2, 0.4, 0.8888194417315589)))]
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(millimetres(i), "/pico_flexx/image_depth", stamp),
            image(amplitude(i), "/pico_flexx/image_mono16", stamp),
            info("/pico_flexx/camera_info", stamp),
        ]
    for ros1 in (False, True):
        bag = write_driver_bag(tmp_path / f"bag{ros1}.bag", lines, ros1=ros1)
        frames, _ = imported(capsys, bag, "--force")
        assert frames[0].truth["board"].position == (0.1, 0.2, 1.5)
        assert frames[0].pose_stamps["board"] == START - 5


def test_profiles_of_radial_images_are_read_without_an_import(tmp_path: Path, capsys: Any) -> None:
    lines = []
    for i, stamp in enumerate(STAMPS):
        lines += [
            image(np.rint(depth(i) * 4e3).astype(np.uint16), "/sick_visionary_t_mini/depth", stamp),
            image(amplitude(i), "/sick_visionary_t_mini/intensity", stamp),
            info("/sick_visionary_t_mini/camera_info", stamp),
        ]
    bag = write_driver_bag(tmp_path / "sick.bag", lines, ros1=True)
    status, said, error = run(capsys, "info", bag, "--profile", "sick_visionary", "--json")
    assert status == 0, error
    facts = json.loads(said)
    assert (facts["frames"], facts["width"], facts["has_camera_info"]) == (3, 32, True)
    out = tmp_path / "camera.yaml"
    assert run(capsys, "camera", bag, "--profile", "sick_visionary", "--out", out)[0] == 0
    assert load_camera(out).sensor.distance_lsb == 0.00025
    status, _, error = run(capsys, "info", bag, "--profile", "pico_flexx")
    assert status == 2
    assert (
        "--profile: the distance of pico_flexx_driver (ROS 1) is depth along z (convert it first: " in error
    )
    assert f"rim import {bag} --profile pico_flexx --out BAG)" in error
    status, _, error = run(
        capsys, "calibrate", bag, "--profile", "ifm3d_o3r", "--camera", "sr3000", "--out", "x.yaml"
    )
    assert status == 2
    assert "no distance image /ifm3d/camera/distance, raw or compressed" in error
