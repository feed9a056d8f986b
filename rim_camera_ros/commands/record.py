"""``rim record``: the topics of running nodes become a recording."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from types import FrameType

from rim_camera_ros.bags import RecordingWriter
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_topics,
    camera_of,
    check_outputs,
    positive,
    scene_of,
    topics_of,
)
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.info.text import several

#: Signals that end the recording, which is complete then.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_EXAMPLES = """
rim record --out bag                              # until Ctrl-C
rim record --out bag --frames 200
rim record --out bag --namespace /left --duration 60
rim record --out bag --scene board.yaml --camera camera.yaml     # says what to record next
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "record",
        "Record running nodes. Raw images, settings, temperatures, true poses and, if there are any, "
        "corrected images and clouds. Ctrl-C ends the recording, which is complete then. With a scene, what "
        "the stations determine so far and which one is missing next.",
        _EXAMPLES,
    )
    parser.add_argument("--out", required=True, type=Path, metavar="BAG", help="recording to write (mcap)")
    parser.add_argument("--frames", type=positive(int), help="end after so many distance images")
    parser.add_argument("--duration", type=positive(float), metavar="S", help="end after so many seconds")
    parser.add_argument(
        "--scene",
        help="scene file, or a shipped one's name: says after every station which effects are determined so "
        "far and what to record next, also as topics coverage and coverage/image; poses as they are "
        "published, or of the scene's board in the images",
    )
    parser.add_argument("--camera", help="camera file, or a shipped one's name, for --scene")
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Record; 1 if no frame came."""
    check_outputs({"--out": given.out}, [])
    known = _known(given)
    try:
        from rim_camera_ros.coverage.picture import print_report
        from rim_camera_ros.nodes.common.recorder import record
    except ImportError as error:
        raise RimError(
            f"recording needs ROS 2 ({error})",
            remedy="source /opt/ros/jazzy/setup.bash, or pip install ros-jazzy-rclpy "
            "ros-jazzy-rmw-fastrtps-cpp ros-jazzy-common-interfaces",
        ) from None
    stop: list[int] = []

    def ask_to_stop(number: int, frame: FrameType | None) -> None:
        stop.append(number)

    before = {number: signal.getsignal(number) for number in _ENDING}
    for number in (
        signals for signals in _ENDING if signals != signal.SIGHUP or before[signals] != signal.SIG_IGN
    ):
        signal.signal(number, ask_to_stop)
    try:
        with (
            RecordingWriter(given.out, topics=topics_of(given), force=given.force) as writer,
            Progress("recorded", given.frames, quiet=given.quiet) as progress,
        ):
            if not given.quiet:
                source = topics_of(given)["distance"]
                print(
                    f"recording {source} and what belongs to it; Ctrl-C ends it", file=sys.stderr, flush=True
                )
            frames = record(
                topics_of(given),
                writer,
                frames=given.frames,
                duration=given.duration,
                show=progress.show,
                stopped=lambda: bool(stop),
                known=known,
                report=None if given.quiet else print_report,
            )
            if frames == 0:
                raise RimError(
                    f"no frame came on {topics_of(given)['distance']}",
                    remedy="is a driver running, in this ROS domain and namespace?",
                )
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if not given.quiet:
        print(f"{several(frames, 'frame')} recorded: {given.out}")
    return 0


def _known(given: argparse.Namespace) -> tuple[Path, Path] | None:
    """Return the files of scene and camera for the coverage, None where no coverage is requested."""
    if given.scene is None and given.camera is None:
        return None
    if given.scene is None or given.camera is None:
        missing = "--scene" if given.scene is None else "--camera"
        raise InputError(
            f"{missing} is missing", place="record", remedy="the coverage needs both --scene and --camera"
        )
    scene_of(given.scene), camera_of(given.camera)  # raises errors in them before the work
    return find_scene(given.scene), find_camera(given.camera)
