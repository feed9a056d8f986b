"""Changes while frames flow, with the very frame and without losing one; services that use files."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import Trigger

from rim_camera_ros.bags.messages import points_array
from rim_camera_ros.camera import Covariance
from rim_camera_ros.camera_file import load_camera, save_camera_apart
from rim_camera_ros.files import find_camera
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.pipeline.correct import Correction
from test.ros.harness import BEST_EFFORT, LOSSLESS_CORRECTION, LOSSLESS_DRIVER, Chain, World, stamp_of


def test_an_integration_time_selects_its_rows_with_the_very_frame(world: World, tmp_path: Path) -> None:
    # the setting changes with every frame: whoever used that of a neighbour would be centimetres off
    settings = [16, 100, 60, 16, 60, 100, 80, 16, 100, 30]
    scene = tmp_path / "settings.yaml"
    scene.write_text(
        "format: rim_scene/1\nsurfaces:\n- {name: wall, type: plane, pose: {position: [0, 0, 2.2]}}\n"
        "schedule:\n" + "".join(f"- {{frames: 1, rate: 20, integration_time: {one}}}\n" for one in settings)
    )
    chain = Chain(
        world,
        driver={"scene": str(scene), "frames": 20, "loop": True},
        correction={"camera": "sr3000"},
    )
    chain.finish()
    frames, clouds = chain.raw_frames(), chain.clouds()
    assert [one.settings.integration_time for one in frames] == [float(one) for one in settings * 2]
    correction = Correction(load_camera(find_camera("sr3000")))
    for frame in frames:
        expected = correction.cloud(correction.correct(frame))
        assert clouds[frame.stamp].tobytes() == expected.tobytes()


def test_another_camera_file_without_losing_a_frame(world: World, tmp_path: Path) -> None:
    folder = find_camera("sr3000").parent
    for file in folder.glob("sr3000*.npy"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    text = (folder / "sr3000.yaml").read_text()
    for name, offset in (("plain", 0.0), ("shifted", 0.5)):
        changed = text.replace("      100: 0.0\n", f"      100: {offset}\n")
        assert (changed == text) == (name == "plain")
        (tmp_path / f"{name}.yaml").write_text(changed)
    files = [str(tmp_path / f"{name}.yaml") for name in ("shifted", "plain")]
    world.start("correction_node", camera=files[1], folders=str(tmp_path), **LOSSLESS_CORRECTION)
    points = world.collect(PointCloud2, "points")
    assert world.until(lambda: points.matched), world.output()
    raw = world.collect(Image, "distance/image_raw")
    # at a rate that a busy machine holds: frames must not be lost for the change (the soak goes to 50 Hz)
    world.start("driver_node", scene="wall", frame_rate=20.0, wait_for_subscribers=1, **LOSSLESS_DRIVER)
    assert world.until(lambda: len(points) > 10), world.output()
    held: list[tuple[str, int, int]] = []  # file, and the time from the answer to the next change
    for file in files * 4:
        assert world.set("correction", camera=file) == ""
        answered = time.time_ns()

        def since(answered: int = answered) -> int:
            return sum(stamp_of(one) > answered for one in points.messages[-100:])

        assert world.until(lambda since=since: since() > 4), world.output()
        held.append((file, answered, time.time_ns()))
    # by service: the file of the parameter, which has become another one
    (tmp_path / "plain.yaml").write_text((tmp_path / "shifted.yaml").read_text())
    assert world.call(Trigger, "correction/load_camera").success
    last = stamp_of(raw.last)
    assert world.until(lambda: stamp_of(points.last) >= last + 200_000_000), world.output()
    corrected, taken = set(points.by_stamp()), set(raw.by_stamp())
    first = min(corrected)  # the processes may find each other topic by topic
    lost = {stamp for stamp in taken if first <= stamp <= stamp_of(points.last)} - corrected
    assert not lost, f"{len(lost)} of {len(taken)} frames lost"
    middle = [float(points_array(one)[70:76, 86:92, 2].mean()) for one in points]
    levels = np.array(middle)
    assert np.ptp(levels) == pytest.approx(0.5, abs=0.03)
    jumps = np.abs(np.diff(levels)) > 0.25
    assert jumps.sum() == 9  # each change is between two frames: no frame with half of one
    # what was stamped after the answer was corrected by the new file, before any other change
    for file, answered, until in held:
        expected = levels.min() if file == files[0] else levels.max()
        while_held = [i for i, one in enumerate(points) if answered < stamp_of(one) < until]
        assert len(while_held) >= 3
        assert np.abs(levels[while_held] - expected).max() < 0.03
    assert ((np.abs(levels - levels.max()) < 0.03) | (np.abs(levels - levels.min()) < 0.03)).all()


def info(**changes: Any) -> CameraInfo:
    values: dict[str, Any] = {
        "fx": 205.0,
        "fy": 206.5,
        "cx": 88.25,
        "cy": 71.5,
        "d": [-0.1, 0.02, 0.001, 0.0, 0.0],
    }
    values |= changes
    result = CameraInfo(
        width=values.get("width", 176), height=144, distortion_model=values.get("model", "plumb_bob")
    )
    result.d = values["d"]
    result.k = [values["fx"], 0.0, values["cx"], 0.0, values["fy"], values["cy"], 0.0, 0.0, 1.0]
    return result


def test_set_camera_info_is_stated_and_stored_and_used(world: World, tmp_path: Path) -> None:
    images = world.collect(CameraInfo, "camera_info", BEST_EFFORT)
    depth_info = world.collect(CameraInfo, "depth/camera_info", BEST_EFFORT)
    folder = tmp_path / "files"
    world.start("driver_node", folders=str(folder))
    correction = world.start("correction_node", folders=str(folder))
    assert world.until(lambda: images and depth_info), world.output()
    before = list(images.last.k)
    for bad, reason in (
        (info(width=320), r"camera_info is of 320 x 144 px, the camera of 176 x 144"),
        (info(model="equidistant"), r"distortion model equidistant"),
        (info(fx=0.0), r"uncalibrated"),
        (info(fx=float("nan")), r"not finite"),
        (info(fy=-200.0), r"focal lengths 205, -200 px are not positive"),
        (info(d=[0.0] * 8), r"D has 8 numbers, plumb_bob has 5"),
        (info(d=[-9.0, 0.0, 0.0, 0.0, 0.0]), r"camera_info: .*(invert|fold)"),
    ):
        response = world.call(SetCameraInfo, "set_camera_info", node="driver", camera_info=bad)
        assert not response.success
        assert re.search(reason, response.status_message), response.status_message
    assert list(images.last.k) == before
    assert not list(folder.glob("*.yaml"))
    response = world.call(SetCameraInfo, "set_camera_info", node="driver", camera_info=info())
    assert response.success, response.status_message
    path = folder / "sr3000.yaml"
    assert response.status_message == f"the geometry is in {path}; give this file to the correction"
    stored = load_camera(path)
    assert (stored.optics.fx, stored.optics.fy, stored.optics.cx, stored.optics.cy) == (
        205.0,
        206.5,
        88.25,
        71.5,
    )
    assert stored.optics.d == (-0.1, 0.02, 0.001, 0.0, 0.0)
    assert stored.effects == load_camera(find_camera("sr3000")).effects or len(stored.effects) == 14
    assert world.until(lambda: images.last.k[0] == 205.0), world.output()
    assert world.get("driver", "camera_info") == [str(path)]
    before = path.read_bytes()
    response = world.call(SetCameraInfo, "set_camera_info", node="driver", camera_info=info(fx=207.0))
    assert response.status_message.startswith(f"the geometry is in {folder / 'sr3000_2.yaml'};")
    assert path.read_bytes() == before
    assert world.set("driver", camera_info=str(path)) == ""
    assert world.until(
        lambda: "camera_info differs from the camera file's optics by up to" in correction.text
    )
    assert world.set("correction", camera=str(path)) == ""
    assert world.until(lambda: depth_info.last.k[4] == 206.5), world.output()
    assert list(depth_info.last.d) == [-0.1, 0.02, 0.001, 0.0, 0.0]


def test_save_camera_writes_what_is_corrected_by_and_only_into_its_folder(
    world: World, tmp_path: Path
) -> None:
    folder = tmp_path / "files"
    world.start("correction_node", folders=str(folder), **{"effects.scattering": False})
    assert world.set("correction", save_as="desk", minimum_amplitude=250.0) == ""
    response = world.call(Trigger, "correction/save_camera")
    assert response.success, response.message
    saved = load_camera(folder / "desk.yaml")
    shipped = load_camera(find_camera("sr3000"))
    assert set(shipped.effects) - set(saved.effects) == {"scattering"}
    assert saved.minimum_amplitude == 250.0
    assert saved.optics == shipped.optics
    assert world.set("correction", camera=str(folder / "desk.yaml")) == ""
    for name in ("../outside", "/etc/passwd", "a/b", "..", "", " ", "x" * 200, "nul\0"):
        if "\0" in name:
            continue  # no ROS string holds it
        assert world.set("correction", save_as=name) == ""
        response = world.call(Trigger, "correction/save_camera")
        assert response.success == (name == ""), name  # empty: the name of the file in use
        if not response.success:
            assert "is not a name of a file" in response.message
        elif name == "":
            assert response.message == (
                f"written to {folder}/desk_2.yaml (desk.yaml was there before and stays as it is)"
            )
    assert sorted(one.name for one in tmp_path.rglob("*.yaml")) == ["desk.yaml", "desk_2.yaml"]
    # a link that lies in the folder does not lead out of it
    secret = tmp_path / "secret.yaml"
    secret.write_text("mine")
    (folder / "link.yaml").symlink_to(secret)
    assert world.set("correction", save_as="link") == ""
    response = world.call(Trigger, "correction/save_camera")
    assert not response.success
    assert "is a link" in response.message
    assert secret.read_text() == "mine"
    assert "outside of the folders" in world.set("correction", camera=str(folder / "link.yaml"))


def test_save_camera_leaves_the_calibration_that_it_corrects_with(world: World, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    shipped = load_camera(find_camera("sr3000"))
    paths = ("optics.fx", "effects.scattering.kernels.0.weight", "effects.distance_scale.scale")
    matrix = np.array([[4.0, 0.1, 0.2], [0.1, 9.0, 0.3], [0.2, 0.3, 16.0]])
    covariance = Covariance(paths, ArrayFile("covariance.npy", matrix))
    save_camera_apart(replace(shipped, covariance=covariance), folder / "calibrated_1.yaml")
    before = {one.name: one.read_bytes() for one in folder.iterdir()}
    world.start("correction_node", folders=str(folder), camera=str(folder / "calibrated_1.yaml"))
    assert world.set("correction", **{"effects.scattering": False}) == ""
    for number in (2, 3):
        response = world.call(Trigger, "correction/save_camera")
        assert response.success, response.message
        path = folder / f"calibrated_1_{number}.yaml"
        assert response.message.startswith(f"written to {path} (calibrated_1.yaml was there before")
        saved = load_camera(path)
        assert "scattering" not in saved.effects
        assert saved.covariance is not None
        assert saved.covariance.parameters == (paths[0], paths[2])
        assert saved.covariance.matrix.values.tolist() == [[4.0, 0.2], [0.2, 16.0]]
    assert {name: (folder / name).read_bytes() for name in before} == before
    assert load_camera(folder / "calibrated_1.yaml").covariance is not None


def test_a_folder_that_cannot_be_written_is_said(world: World, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file where the folder should be")
    correction = world.start("correction_node", folders=str(taken))
    response = world.call(Trigger, "correction/save_camera")
    assert not response.success
    assert "the folder cannot be made" in response.message
    assert correction.running
    assert "Traceback" not in correction.text
