"""``rim poses``: a recorded board makes truth poses with their covariance."""

from __future__ import annotations

import argparse
from pathlib import Path

from rim_camera_ros.bags import Recording
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_topics,
    camera_of,
    check_outputs,
    say,
    scene_of,
    topics_of,
)
from rim_camera_ros.commands.from_images import add_known, estimated, known_of
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.photogrammetry.from_images import poses_of_recording, write_poses

_EXAMPLES = """
rim board checkerboard --out board                         # print board.pdf, board.yaml is its scene
rim poses bag --scene board.yaml --camera camera.yaml --out bag_with_poses
rim poses bag --scene board.yaml --camera camera.yaml --out posed --estimate fx,cx,cy,k1 --board-sigma 2e-4
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "poses",
        "Find a board in the amplitude images of a recording and write its poses as truth, with their "
        "covariance. Frames in which the board rests are one station. Frames without the board are not "
        "written.",
        _EXAMPLES,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="recording of a board")
    parser.add_argument("--scene", required=True, help="scene file of the board, or a shipped one's name")
    parser.add_argument(
        "--camera", required=True, help="camera file with the optics, or a shipped one's name"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="BAG2", help="recording to write (mcap)")
    add_known(parser)
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Find the poses and write the recording."""
    camera, scene = camera_of(given.camera), scene_of(given.scene)
    check_outputs({"--out": given.out}, [given.bag, find_camera(given.camera), find_scene(given.scene)])
    known, estimate = known_of(given), estimated(given)
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
    write_poses(given.bag, found, given.out, topics=topics_of(given), force=given.force)
    say(given, [*found.notes, found.scale_words(known.board_sigma)])
    if not given.quiet:
        print("\n".join([*found.words(), f"written: {given.out}"]))
    return 0
