"""``rim simulate``: a scene and a camera make a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.bags.messages import stamp_text
from rim_camera_ros.bags.topics import SAMPLES
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_topics,
    camera_of,
    check_outputs,
    positive,
    reading_notes,
    say,
    scene_of,
    topics_of,
)
from rim_camera_ros.devices.timeline import Timeline, exposures_like
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import NANOSECONDS, RawFrame
from rim_camera_ros.info.text import several
from rim_camera_ros.measurement import FrameSimulation, measurement_of
from rim_camera_ros.phasor import Waveform, parse_waveform
from rim_camera_ros.pipeline.simulate import Exposure

#: Stamp of the first frame: ROS time 0 means "no time".
START = NANOSECONDS

_EXAMPLES = """
rim simulate room --camera sr3000 --out room_bag
rim simulate board.yaml --camera camera.yaml --poses real_bag --out simulated_bag
rim simulate wall --camera sr3000 --integration-time 60 --frames 200 --seed 7 --out wall_bag
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "simulate",
        "Simulate a camera before a scene. Writes raw images, settings, temperatures and the true poses.",
        _EXAMPLES,
    )
    parser.add_argument("scene", metavar="SCENE", help="scene file, or the name of a shipped one")
    parser.add_argument("--camera", required=True, help="camera file, or the name of a shipped one")
    parser.add_argument("--out", required=True, type=Path, metavar="BAG", help="recording to write (mcap)")
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="BAG",
        help="recording whose true poses, stamps, settings and temperatures are taken",
    )
    parser.add_argument(
        "--frames",
        type=positive(int),
        help="number of frames (default: the schedule's or recording's, else 100)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise (0)")
    parser.add_argument(
        "--integration-time",
        type=positive(float),
        help="setting in the camera's own unit (default: the scene's)",
    )
    parser.add_argument(
        "--rate", type=positive(float), metavar="HZ", help="frames per second (default: the scene's)"
    )
    parser.add_argument(
        "--waveform",
        help="work at the level of the four samples: sinusoid, square:DUTY, harmonics:3=0.1,5=-0.02; the "
        "cyclic error then emerges (leave cyclic_error out of the camera file)",
    )
    parser.add_argument(
        "--samples",
        action="store_true",
        help="also write what distances are evaluated from, where the camera has it: histograms, gates",
    )
    add_topics(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Simulate and write the recording."""
    camera, scene = camera_of(given.camera), scene_of(given.scene)
    inputs = [find_camera(given.camera), find_scene(given.scene), given.poses]
    check_outputs({"--out": given.out}, inputs)
    waveform = _waveform(given.waveform)
    if not 0 <= given.seed < 2**64:
        raise InputError(f"--seed {given.seed} is not a number from 0 to 2^64 - 1")
    if given.poses is not None and (given.rate or given.integration_time):
        raise InputError("--rate and --integration-time come from the recording that --poses names")
    try:
        measurement = measurement_of(camera)
        simulation = measurement.simulation(camera, scene, seed=given.seed, waveform=waveform)
        with ExitStack() as stack:
            bag = None
            if given.poses is not None:
                bag = stack.enter_context(Recording(given.poses, topics=topics_of(given)))
            exposures, total = _exposures(given, simulation, bag)
            writer = stack.enter_context(
                RecordingWriter(given.out, topics=topics_of(given), force=given.force)
            )
            progress = stack.enter_context(Progress("simulated", total, quiet=given.quiet))
            count = 0
            for exposure in progress.over(exposures):
                writer.write_raw(_chosen(simulation.frame(exposure), samples=given.samples))
                count += 1
    except InputError as error:
        raise error.located(given.scene) from None
    say(given, [*simulation.notes, *(reading_notes(bag) if bag is not None else [])])
    if not given.quiet:
        print(f"{several(count, 'frame')} simulated: {given.out}")
    return 0


def _chosen(frame: RawFrame, *, samples: bool) -> RawFrame:
    """Return the frame with its samples only on request: they are a hundred times its size."""
    if samples:
        return frame
    return replace(frame, images={role: image for role, image in frame.images.items() if role not in SAMPLES})


def _waveform(text: str | None) -> Waveform | None:
    if text is None:
        return None
    try:
        return parse_waveform(text)
    except ValueError as error:
        raise InputError(str(error), place="--waveform") from None


def _exposures(
    given: argparse.Namespace, simulation: FrameSimulation, bag: Recording | None
) -> tuple[Iterable[Exposure], int | None]:
    """Return the exposures and, where it is known, their number."""
    scene, camera = simulation.scene, simulation.camera
    exposures: Iterator[Exposure]
    if bag is not None:
        exposures, total = _like(bag, given.poses, simulation), bag.frame_count
        if given.frames:
            exposures, total = islice(exposures, given.frames), min(given.frames, total)
        return exposures, total
    timeline = Timeline(
        scene,
        camera,
        start=START,
        integration_time=given.integration_time,
        rate=given.rate,
        repeat=given.frames is not None,
    )
    total = given.frames or timeline.length
    return islice(iter(timeline), total), total


def _like(bag: Recording, path: Path, simulation: FrameSimulation) -> Iterator[Exposure]:
    """Yield the exposures of a recording; an error names the recording and the frame."""
    last: list[int] = []

    def watched() -> Iterator[RawFrame]:
        for frame in bag.frames():
            last[:] = [frame.stamp]
            yield frame

    try:
        yield from exposures_like(watched(), simulation.scene, simulation.camera)
    except InputError as error:
        if error.file is None and last:
            place = f"frame at {stamp_text(last[0])}"
            raise InputError(error.problem, file=path, place=place, remedy=error.remedy) from None
        raise error.located(path) from None
