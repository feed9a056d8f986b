"""``rim correct``: a recording and a camera file make corrected images and clouds."""

from __future__ import annotations

import argparse
import io
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_topics,
    camera_of,
    check_file,
    check_outputs,
    reading_notes,
    say,
    topics_of,
)
from rim_camera_ros.commands.ply import write_ply
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import CorrectedFrame, RawFrame
from rim_camera_ros.info.text import several
from rim_camera_ros.measurement import FrameCorrection, measurement_of
from rim_camera_ros.yaml_files import write_whole

_EXAMPLES = """
rim correct bag --camera camera.yaml --out corrected_bag
rim correct bag --camera sr3000 --ply cloud.ply --frame 12
rim correct bag --camera camera.yaml --npz frame.npz --without scattering,incidence_angle
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "correct",
        "Correct a recording by a camera file. Writes clouds, sigma, flags, corrected distances, depths, and "
        "the settings and true poses of the recording; or single frames as PLY or npz.",
        _EXAMPLES,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="recording: rosbag2 or ROS 1")
    parser.add_argument("--camera", required=True, help="camera file, or the name of a shipped one")
    parser.add_argument("--out", type=Path, metavar="BAG", help="recording to write (mcap)")
    parser.add_argument(
        "--ply", type=Path, metavar="FILE", help="write the cloud of one frame as PLY [m, counts]"
    )
    parser.add_argument(
        "--npz",
        type=Path,
        metavar="FILE",
        help="write one frame as numpy arrays: distance, sigma [m], flags, amplitude, points, stamp [ns]",
    )
    parser.add_argument(
        "--frame", type=int, default=0, help="frame of --ply and --npz, from 0; -1: the last (0)"
    )
    parser.add_argument(
        "--without",
        default="",
        metavar="A,B",
        help="effects that are left uncorrected; rim info CAMERA --json lists their names",
    )
    parser.add_argument(
        "--minimum-amplitude",
        type=float,
        metavar="COUNTS",
        help="instead of the camera file's or the automatic one",
    )
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Correct, and write the requested outputs."""
    camera = _checked(given)
    without = [word.strip() for word in given.without.split(",") if word.strip()]
    correction = measurement_of(camera).correction(
        camera, without=without, minimum_amplitude=given.minimum_amplitude
    )
    single = given.ply is not None or given.npz is not None
    if given.frame != 0 and not single:
        raise InputError(
            "is the frame of --ply or --npz, and neither is given", place="--frame", remedy="give --ply FILE"
        )
    count, chosen = 0, None
    written: list[str] = []
    damaged: list[str] = []
    with ExitStack() as stack:
        bag = stack.enter_context(Recording(given.bag, topics=topics_of(given)))
        total = bag.frame_count
        wanted = given.frame if given.frame >= 0 else total + given.frame
        frames = bag.frames()
        if single and not 0 <= wanted < total:
            raise InputError(
                f"there is no frame {given.frame}: it has {several(total, 'frame')}",
                file=given.bag,
                place="--frame",
                remedy=f"0 to {total - 1}, or -1 for the last" if total else None,
            )
        writer = None
        if given.out is not None:
            writer = stack.enter_context(
                RecordingWriter(given.out, topics=topics_of(given), force=given.force)
            )
        progress = stack.enter_context(
            Progress("corrected", total if writer is not None else wanted + 1, quiet=given.quiet)
        )
        for raw in progress.over(frames):
            corrected = _corrected(correction, raw, given)
            if writer is not None:
                writer.write_corrected(
                    corrected,
                    points=correction.cloud(corrected),
                    depth=correction.depth(corrected),
                    intrinsics=camera.intrinsics,
                    raw=raw,
                )
            if single and count == wanted:
                chosen = corrected
            count += 1
            if writer is None and chosen is not None:
                break
        if single:
            if chosen is None:
                problem = f"only {several(count, 'frame')} of {total} could be read"
                raise InputError(problem, file=given.bag, place=f"--frame {given.frame}")
            if writer is None and given.frame < 0 and (damage := bag.summary().damage):
                damaged.append(
                    f"{given.bag} is damaged, frame {wanted} is counted from what can be read: {damage}"
                )
            written = _write_frame(given, correction, wanted, chosen)
    say(given, [*correction.notes, *reading_notes(bag), *damaged])
    if not given.quiet:
        done = several(count, "frame") if given.out is not None else f"frame {wanted}"
        print(f"{done} corrected: {', '.join([str(given.out)] * (given.out is not None) + written)}")
    return 0


def _checked(given: argparse.Namespace) -> Camera:
    """Check the options and return the camera."""
    if given.out is None and given.ply is None and given.npz is None:
        raise InputError("nothing to write", remedy="give --out BAG, --ply FILE or --npz FILE")
    if given.minimum_amplitude is not None and not 0 <= given.minimum_amplitude < np.inf:
        raise InputError(f"--minimum-amplitude must be 0 or more counts, found {given.minimum_amplitude:g}")
    outputs = {"--out": given.out, "--ply": given.ply, "--npz": given.npz}
    check_outputs(outputs, [given.bag, find_camera(given.camera)])
    for path in (given.ply, given.npz):
        check_file(path, force=given.force)
    return camera_of(given.camera)


def _corrected(correction: FrameCorrection, raw: RawFrame, given: argparse.Namespace) -> CorrectedFrame:
    try:
        return correction.correct(raw)
    except InputError as error:
        raise error.located(given.bag) from None


def _write_frame(
    given: argparse.Namespace, correction: FrameCorrection, index: int, corrected: CorrectedFrame
) -> list[str]:
    points = correction.cloud(corrected)
    written = []
    if given.ply is not None:
        n = write_ply(given.ply, points, comment=f"frame {index} of {given.bag}, stamp {corrected.stamp} ns")
        written.append(f"{given.ply} ({n} points)")
    if given.npz is not None:
        arrays: dict[str, Any] = {
            "distance": corrected.distance,
            "sigma": corrected.sigma,
            "flags": corrected.flags,
            "amplitude": corrected.amplitude,
            "points": points,
            "stamp": np.int64(corrected.stamp),
        }
        # a zip file that cannot be closed would print its own message
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)
        write_whole(given.npz, lambda stream: stream.write(packed.getvalue()))
        written.append(str(given.npz))
    return written
