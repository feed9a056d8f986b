"""``rim diagnose``: where a recording differs from its simulation, and what physics was left out."""

from __future__ import annotations

import argparse
from pathlib import Path

from rim_camera_ros.bags import Topics
from rim_camera_ros.calibrate.checks import require_fixed_poses
from rim_camera_ros.calibrate.recordings import on_workers, reduce_on_cluster
from rim_camera_ros.camera import Camera
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
from rim_camera_ros.commands.from_images import posed_recordings
from rim_camera_ros.commands.output_folder import OutputFolder
from rim_camera_ros.diagnose.files import MODEL, PAGE, REPORT, WHERE
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.scene import Scene

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
        help="poses to leave out, by the numbers that a report of an inconsistent setup names",
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
    given.scene = given.scene if given.board is None else given.board
    if given.against is not None and given.against.resolve() == given.bag.resolve():
        raise InputError(
            "is the recording itself", file=given.against, place="--against", remedy="give its simulation"
        )
    inputs = [given.bag, given.against, find_camera(given.camera), find_scene(given.scene)]
    check_outputs({"--out": given.out}, inputs)
    folder = OutputFolder(given.out, own={MODEL, REPORT, PAGE, WHERE}, of="a diagnosis", mark=REPORT)
    folder.check(force=given.force)
    camera, scene = camera_of(given.camera), scene_of(given.scene)
    # before the work: what is not installed is said at once
    try:
        from rim_camera_ros.reports.diagnosis.page import write_page
    except ImportError as error:
        remedy = "pip install 'rim_camera_ros[reports]', or apt install python3-matplotlib"
        raise InputError(f"no report can be drawn: {error}", remedy=remedy) from None
    from rim_camera_ros.diagnose.formula import require_formulas
    from rim_camera_ros.diagnose.report import write_report
    from rim_camera_ros.diagnose.run import diagnose

    require_formulas()

    if given.board is None:
        dataset = _stations(given, given.bag, camera, scene)
    else:
        with posed_recordings(given, (given.bag,), scene, camera, topics_of(given)) as (posed,):
            dataset = _stations(given, posed, camera, scene, topics=Topics())
    against = None if given.against is None else _stations(given, given.against, camera, scene)
    with Stages(quiet=given.quiet) as stages, on_workers(given.scheduler) as workers:
        try:
            result = diagnose(
                dataset,
                scene,
                camera,
                against=against,
                seed=given.seed,
                threads=given.threads,
                workers=workers,
                progress=stages.show,
            )
        except InputError as error:
            raise error.located(given.bag) from None
    with folder.written() as temporary:
        comment = f"Diagnosis of {given.bag} with camera {given.camera} and scene {given.scene}."
        write_report(result, temporary, comment=comment)
        write_page(result, temporary, recording=str(given.bag), camera=given.camera, scene=given.scene)
    say(given, result.notes)
    if not given.quiet:
        from rim_camera_ros.diagnose.summary import summary

        print(summary(result, given.out))
    return 0


def _numbers(text: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(one) for one in text.split(","))
    except ValueError:
        numbers = (-1,)
    if min(numbers) < 0:
        raise argparse.ArgumentTypeError(f"'{text}' is no list of numbers of poses, as 3,17")
    return numbers


def _stations(
    given: argparse.Namespace, path: Path, camera: Camera, scene: Scene, *, topics: Topics | None = None
) -> Dataset:
    """Read a recording and keep the stations that have all poses."""
    names = topics_of(given) if topics is None else topics
    if given.scheduler is None:
        with Progress("read", None, quiet=given.quiet) as progress:
            dataset = reduce_recording(path, camera, topics=names, scene=scene, progress=progress.over)
    else:
        (dataset,) = reduce_on_cluster([path], camera, [scene], topics=names, scheduler=given.scheduler)
    dataset.with_poses(scene, path)
    require_fixed_poses(dataset, scene, path)
    poses = {one.pose for one in dataset.stations}
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
            "all poses are left out", file=path, place="--without-poses", remedy="name fewer of them"
        )
    if given.without_poses:
        keys = {(one.recording, one.pose) for one in dataset.stations}
        dataset = dataset.without({key for key in keys if key[1] in given.without_poses})
        left_out = ", ".join(map(str, sorted(set(given.without_poses))))
        dataset.notes.append(f"poses left out as asked for: {left_out}")
    return dataset
