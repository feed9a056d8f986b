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
    check_outputs,
    positive,
    topics_of,
)
from rim_camera_ros.errors import RimError
from rim_camera_ros.info.text import several

#: Signals that end the recording, which is complete then.
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_EXAMPLES = """
rim record --out bag                              # until Ctrl-C
rim record --out bag --frames 200
rim record --out bag --namespace /left --duration 60
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "record",
        "Record running nodes. Raw images, settings, temperatures, true poses and, if there are any, "
        "corrected images and clouds. Ctrl-C ends the recording, which is complete then.",
        _EXAMPLES,
    )
    parser.add_argument("--out", required=True, type=Path, metavar="BAG", help="recording to write (mcap)")
    parser.add_argument("--frames", type=positive(int), help="end after so many distance images")
    parser.add_argument("--duration", type=positive(float), metavar="S", help="end after so many seconds")
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Record; 1 if no frame came."""
    check_outputs({"--out": given.out}, [])
    try:
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
    for number in (one for one in _ENDING if one != signal.SIGHUP or before[one] != signal.SIG_IGN):
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
