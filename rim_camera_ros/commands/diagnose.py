"""``rim diagnose``: where a recording differs from its simulation, and which physics is missing."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.calibrate.checks import require_fixed_poses
from rim_camera_ros.calibrate.recordings import on_workers, reduce_on_cluster
from rim_camera_ros.commands.common import (
    Progress,
    Stages,
    add_command,
    add_output,
    add_profile,
    add_scheduler,
    add_threads,
    add_topics,
    camera_of,
    check_outputs,
    say,
    scene_of,
    topics_of,
)
from rim_camera_ros.commands.from_images import (
    add_known,
    board_as_remedy,
    posed_recordings,
    require_board,
)
from rim_camera_ros.commands.output_folder import OutputFolder
from rim_camera_ros.diagnose.files import MODEL, PAGE, REPORT, WHERE
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.measurement import Part, measurement_of
from rim_camera_ros.scene import Scene

if TYPE_CHECKING:
    from rim_camera_ros.diagnose.result import Diagnosis

_EXAMPLES = """
rim diagnose bag --camera camera.yaml --scene scene.yaml --out diagnosis
rim diagnose bag --camera camera.yaml --board board.yaml --out diagnosis      # poses from the images
rim diagnose bag --camera sr3000 --scene board --out diagnosis --against simulated_bag
rim diagnose bag --camera camera.yaml --scene scene.yaml --out diagnosis --without-poses 36,38
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "diagnose",
        "Compare a recording with the simulation of its scene. Says where they differ, names the physics "
        "that the camera file lacks, models it, and shows on held-out poses that the simulation "
        "improved. "
        "Writes report.html, report.json, where.npy and the improved camera.yaml into a folder.",
        _EXAMPLES,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="recording with true poses: rosbag2 or ROS 1")
    parser.add_argument("--camera", required=True, help="camera file, or the name of a shipped one")
    parser.add_argument("--scene", help="scene file, or the name of a shipped one")
    parser.add_argument(
        "--board",
        metavar="BOARD",
        help="in the place of --scene: scene file of a board (rim board) whose poses are found in the images",
    )
    add_known(parser, of_board=True)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    parser.add_argument(
        "--against",
        type=Path,
        metavar="BAG",
        help="a recording of the simulation, compared with instead of simulating anew",
    )
    parser.add_argument(
        "--without-poses",
        type=_numbers,
        default=(),
        metavar="N,N,...",
        help="poses to exclude, by the numbers that a report of an inconsistent setup names",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the simulated nulls (0)")
    add_scheduler(parser, "the recordings are read and candidates are fitted")
    add_threads(parser)
    add_topics(parser)
    add_profile(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Diagnose, and write the report."""
    if not 0 <= given.seed < 2**64:
        raise InputError(f"--seed {given.seed} is not a number from 0 to 2^64 - 1")
    if (given.board is None) == (given.scene is None):
        raise InputError(
            "give --scene or --board", place="--scene", remedy="one of the two: what was recorded"
        )
    require_board(given)
    given.scene = given.scene if given.board is None else given.board
    if given.against is not None and given.against.resolve() == given.bag.resolve():
        raise InputError(
            "is the recording itself", file=given.against, place="--against", remedy="give its simulation"
        )
    inputs = [given.bag, given.against, find_camera(given.camera), find_scene(given.scene)]
    check_outputs({"--out": given.out}, inputs)
    camera, scene = camera_of(given.camera), scene_of(given.scene)
    parts = measurement_of(camera).parts(camera)
    own = {MODEL, REPORT, PAGE, WHERE, *(part.name for part in parts)}
    folder = OutputFolder(given.out, own=own, of="a diagnosis", mark=REPORT)
    folder.check(force=given.force)
    # before the work: a library that is not installed is an error at once
    try:
        from rim_camera_ros.reports.diagnosis.page import write_page
    except ImportError as error:
        remedy = "pip install 'rim_camera_ros[reports]', or apt install python3-matplotlib"
        raise InputError(f"no report can be drawn: {error}", remedy=remedy) from None
    from rim_camera_ros.diagnose.formula import require_formulas
    from rim_camera_ros.diagnose.report import write_report
    from rim_camera_ros.diagnose.run import diagnose
    from rim_camera_ros.diagnose.several_parts import text_of, write_as_one

    require_formulas()

    results: list[tuple[Part, Diagnosis]] = []
    with ExitStack() as stack:
        bag, topics = given.bag, topics_of(given)
        named: Callable[[str], str] = str
        if given.board is not None:
            posed = stack.enter_context(posed_recordings(given, (given.bag,), scene, camera, topics))
            (bag,), scene, topics, named = posed.recordings, posed.scene, Topics(), posed.named
        else:
            stack.enter_context(board_as_remedy(scene, given.scene))
        stages = stack.enter_context(Stages(quiet=given.quiet))
        workers = stack.enter_context(on_workers(given.scheduler))
        reviewed, changes = measurement_of(camera).review(camera, _frames(bag, topics), scene)
        measurement = measurement_of(reviewed)
        for part in measurement.parts(reviewed):
            against = None
            if given.against is not None:
                against = _stations(given, given.against, part, scene, topics_of(given))
            try:
                # nothing else may keep the images: those of large sensors are freed once they are decimated
                result = diagnose(
                    _stations(given, bag, part, scene, topics, named=named),
                    scene,
                    part.camera,
                    against=against,
                    seed=given.seed,
                    threads=given.threads,
                    workers=workers,
                    progress=stages.show,
                )
            except InputError as error:
                raise error.located(given.bag) from None
            results.append((part, result))
    improved = measurement.joined(reviewed, tuple(result.camera for _, result in results))
    with folder.written() as temporary:
        comment = f"Diagnosis of {given.bag} with camera {given.camera} and scene {given.scene}."
        for part, result in results:
            its = temporary / part.name
            its.mkdir(exist_ok=True)
            write_report(result, its, comment=comment)
            write_page(result, its, recording=str(given.bag), camera=given.camera, scene=given.scene)
        if parts[0].name:
            write_as_one(results, changes, improved, temporary, comment=comment)
    say(given, [note for _, result in results for note in result.notes])
    if not given.quiet:
        from rim_camera_ros.diagnose.summary import summary

        texts = [summary(result, given.out / part.name) for part, result in results]
        print(text_of(results, changes, texts) if parts[0].name else texts[0])
    return 0


def _frames(path: Path, topics: Topics) -> Iterator[RawFrame]:
    """Yield the frames of a recording, which is opened only when the first is requested."""
    with Recording(path, topics=topics) as recording:
        yield from recording.frames()


def _numbers(text: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(word) for word in text.split(","))
    except ValueError:
        numbers = (-1,)
    if min(numbers) < 0:
        raise argparse.ArgumentTypeError(f"'{text}' is no list of numbers of poses, as 3,17")
    return numbers


def _stations(
    given: argparse.Namespace,
    path: Path,
    part: Part,
    scene: Scene,
    topics: Topics,
    *,
    named: Callable[[str], str] = str,
) -> Dataset:
    """Read the images of a part in a recording and keep the stations that have all poses.

    ``named`` changes the names of files in its notes.
    """
    camera, names = part.camera, replace(topics, frequency=part.frequency)
    if given.scheduler is None:
        with Progress("read", None, quiet=given.quiet) as progress:
            dataset = reduce_recording(path, camera, topics=names, scene=scene, progress=progress.over)
    else:
        (dataset,) = reduce_on_cluster([path], camera, [scene], topics=names, scheduler=given.scheduler)
    dataset.with_poses(scene, path)
    require_fixed_poses(dataset, scene, path)
    poses = {station.pose for station in dataset.stations}
    unknown = sorted(set(given.without_poses) - poses)
    if unknown:
        raise InputError(
            f"there is no pose {unknown[0]}",
            file=path,
            place="--without-poses",
            remedy=f"the recording's are numbered {min(poses)} to {max(poses)}" if poses else None,
        )
    if poses and poses <= set(given.without_poses):
        raise InputError(
            "all poses are excluded", file=path, place="--without-poses", remedy="name fewer of them"
        )
    if given.without_poses:
        keys = {(station.recording, station.pose) for station in dataset.stations}
        dataset = dataset.without({key for key in keys if key[1] in given.without_poses})
        excluded = ", ".join(map(str, sorted(set(given.without_poses))))
        dataset.notes.append(f"poses excluded on request: {excluded}")
    dataset.notes = [named(note) for note in dataset.notes]
    return dataset
