"""``rim optics``: the geometry of a camera alone, from a recorded board; camera_info YAML in and out."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import save_camera
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_topics,
    camera_of,
    check_file,
    check_outputs,
    say,
    scene_of,
    topics_of,
)
from rim_camera_ros.commands.from_images import add_known, estimated, known_of
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.photogrammetry.camera_info_file import read_camera_info, write_camera_info
from rim_camera_ros.photogrammetry.from_images import poses_of_recording
from rim_camera_ros.photogrammetry.known_optics import with_optics

_EXAMPLES = """
rim optics bag --scene board.yaml --camera sr3000 --out camera_info.yaml
rim optics bag --scene board.yaml --camera camera.yaml --start old.yaml --estimate fx,cx,cy,k1 --out new.yaml
rim optics bag --scene board.yaml --camera camera.yaml --out camera_info.yaml --camera-out camera2.yaml
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "optics",
        "Estimate the geometry of a camera from a recorded board. Focal length, principal point and "
        "distortion by bundle adjustment, with standard deviations; written as camera_info YAML of ROS, and "
        "as a camera file where asked.",
        _EXAMPLES,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="recording of a board at many tilts and rolls")
    parser.add_argument("--scene", required=True, help="scene file of the board, or a shipped one's name")
    parser.add_argument("--camera", required=True, help="camera file, or the name of a shipped one")
    parser.add_argument("--start", type=Path, metavar="YAML", help="camera_info to start from")
    parser.add_argument("--out", type=Path, required=True, metavar="YAML", help="camera_info to write")
    parser.add_argument(
        "--camera-out",
        type=Path,
        metavar="CAMERA2",
        help="camera file to write with the optics and their covariance; all else is that of --camera",
    )
    add_known(parser)
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Estimate the optics and write them."""
    camera, scene = camera_of(given.camera), scene_of(given.scene)
    inputs = [given.bag, find_camera(given.camera), find_scene(given.scene), given.start]
    check_outputs({"--out": given.out, "--camera-out": given.camera_out}, inputs)
    for path in (given.out, given.camera_out):
        if path is not None and path.suffix not in (".yaml", ".yml"):
            raise InputError("such a file ends in .yaml", file=path, remedy=f"give {path}.yaml")
        check_file(path, force=given.force)
    if given.start is not None:
        camera = _started(camera, given.start)
    known = known_of(given)
    estimate = estimated(given) if given.estimate else ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    with Recording(given.bag, topics=topics_of(given)) as bag:
        total = bag.frame_count
    with Progress("searched", total, quiet=given.quiet) as progress:
        found = poses_of_recording(
            given.bag,
            scene,
            camera,
            topics=topics_of(given),
            known=known,
            estimate=estimate,
            progress=progress.over,
        )
    assert found.report is not None
    write_camera_info(given.out, found.optics, shape=camera.shape, name=camera.device)
    if given.camera_out is not None:
        save_camera(with_optics(camera, found.optics, found.covariance), given.camera_out)
    say(given, [*found.notes, found.scale_words(known.board_sigma)])
    if not given.quiet:
        print(found.report.text())
        also = f", {given.camera_out}" if given.camera_out is not None else ""
        print(f"written: {given.out}{also}")
    return 0


def _started(camera: Camera, path: Path) -> Camera:
    optics, shape = read_camera_info(path)
    if shape != camera.shape:
        raise InputError(
            f"it is for {shape[1]} x {shape[0]} px, the camera has {camera.shape[1]} x {camera.shape[0]}",
            file=path,
            remedy="give the camera_info of the same mode",
        )
    known = None if camera.covariance is None else camera.covariance.without(["optics."])
    return replace(camera, optics=optics, covariance=known)
