"""``rim calibrate``: recordings and a scene make a camera file with its uncertainty."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from rim_camera_ros.bags import DEFAULT_NAMESPACE, Topics
from rim_camera_ros.calibrate.recordings import Reducer
from rim_camera_ros.calibrate.run import Calibration, Request, calibrate
from rim_camera_ros.camera import Camera
from rim_camera_ros.commands.common import (
    add_command,
    add_output,
    add_profile,
    add_scheduler,
    add_threads,
    add_topics,
    camera_of,
    check_file,
    check_outputs,
    say,
    scene_of,
    topics_of,
)
from rim_camera_ros.commands.from_images import (
    add_known,
    board_as_remedy,
    declared,
    posed_recordings,
    require_board,
)
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.measurement import Part, measurement_of
from rim_camera_ros.reports.calibration_files import (
    page_of,
    report_of_part,
    require_a_good_one,
    write_calibration,
    write_page,
)
from rim_camera_ros.reports.calibration_text import calibration_text
from rim_camera_ros.scene import Scene

_EXAMPLES = """
rim calibrate board_bag --camera sr3000 --scene board.yaml --out calibrated.yaml
rim calibrate bag --board board.yaml --camera camera.yaml --out calibrated.yaml    # poses from the images
rim calibrate board_bag cold_bag --scene board.yaml --scene wall.yaml --camera sr3000 --out calibrated.yaml
rim calibrate bag --camera a.yaml --scene s.yaml --out b.yaml --effects cyclic_error,amplitude_offset
rim calibrate bag --camera a.yaml --scene s.yaml --out b.yaml --effects distance_scale,empirical:amplitude
rim calibrate bag --camera a.yaml --scene s.yaml --out a.yaml --force    # replace the file that is read
"""
#: Seconds between two lines of progress on a terminal.
_PACE = 0.1


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "calibrate",
        "Fit a camera file to recordings of known scenes. One joint adjustment of all effects over all "
        "recordings, with errors of the reference instrument and an offset per pixel; writes the camera file "
        "with covariance, validity and provenance, and a report (HTML) beside it.",
        _EXAMPLES,
    )
    parser.add_argument("bags", metavar="BAG", type=Path, nargs="+", help="recordings of one camera")
    parser.add_argument("--camera", required=True, help="camera file to start from, or a shipped one's name")
    parser.add_argument(
        "--scene",
        action="append",
        help="scene file of the recordings, or the name of a shipped one; given several times: the scene of "
        "each recording, in their order",
    )
    parser.add_argument(
        "--board",
        metavar="BOARD",
        help="in the place of --scene: scene file of a board (rim board) whose poses are found in the images",
    )
    add_known(parser, of_board=True)
    parser.add_argument("--out", required=True, type=Path, metavar="CAMERA2", help="camera file to write")
    parser.add_argument(
        "--effects",
        metavar="A,B",
        help="fit exactly these effects; empirical:COVARIATE[:COVARIATE] fits a smooth function, "
        "integral_table alone a table by position (default: those of the camera file and those that the "
        "recordings require)",
    )
    parser.add_argument(
        "--geometry", action="store_true", help="fit camera constant, principal point and distortion, too"
    )
    add_scheduler(parser, "the recordings are read")
    parser.add_argument(
        "--force-result",
        action="store_true",
        help="write the result also where it makes held-out poses worse, did not converge, or takes poses to "
        "err ten times as much as stated",
    )
    parser.add_argument("--no-report", action="store_true", help="write no HTML report")
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulated nulls (0)")
    add_threads(parser)
    add_topics(parser)
    add_profile(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Calibrate, write, and print the table of results."""
    request, report = _checked(given)
    named: Callable[[str], str] = str
    with ExitStack() as stack:
        if given.board is not None:
            board = scene_of(given.board)
            posed = stack.enter_context(
                posed_recordings(given, request.recordings, board, request.camera, topics_of(given))
            )
            request = replace(
                request,
                recordings=posed.recordings,
                originals=posed.originals,
                scene=(posed.scene,),
                topics=None,
            )
            named = posed.named
        elif given.scene is not None and len(given.scene) == 1:
            stack.enter_context(board_as_remedy(scene_of(given.scene[0]), given.scene[0]))
        return _calibrated(given, request, report, named)


def _calibrated(
    given: argparse.Namespace, request: Request, report: Path | None, named: Callable[[str], str]
) -> int:
    """Calibrate and write; ``named`` puts names of recordings into notes as they were given."""
    measurement = measurement_of(request.camera)
    made: list[tuple[Part, Calibration, Path | None, bytes | None]] = []
    notes: list[str] = []
    with _Line(quiet=given.quiet) as line:
        try:
            for part in measurement.parts(request.camera):
                own = _of_part(request, part)
                result = calibrate(own, progress=line.show, reducer=_reducer(given.scheduler))
                result.notes = [named(note) for note in result.notes]
                if not given.force_result:
                    _require_a_good_one(given, result)
                line.show("report", None, None)
                its = None if report is None else report_of_part(report, part)
                page, said = page_of(result, title=given.out.name) if its is not None else (None, [])
                made.append((part, result, its, page))
                notes += [*said, *result.notes]
                notes += [f"written as asked, though {reason}" for reason in result.refused]
        except KeyboardInterrupt:
            raise KeyboardInterrupt("nothing was written") from None
        # the file of all parts comes first, then the reports
        _, first, its, page = made[0]
        camera = measurement.joined(request.camera, tuple(result.camera for _, result, _, _ in made))
        whole = replace(first, camera=camera)
        write_calibration(whole, out=given.out, report=its, page=page, author="rim calibrate")
        for _, _, its, page in made[1:]:
            write_page(its, page)
    say(given, notes)
    if not given.quiet:
        for part, result, _, _ in made:
            print(f"{part.name}\n" * bool(part.name) + calibration_text(result))
        files = [str(given.out), *(str(its) for _, _, its, page in made if page is not None)]
        print(f"written: {', '.join(files)}")
    return 0


def _of_part(request: Request, part: Part) -> Request:
    topics = request.topics if request.topics is not None else Topics()
    return replace(request, camera=part.camera, topics=replace(topics, frequency=part.frequency))


def _require_a_good_one(given: argparse.Namespace, result: Calibration) -> None:
    """Raise `RimError` where the result should not be used, after the table that shows why."""
    if result.refused:
        say(given, result.notes)
        if not given.quiet:
            print(calibration_text(result))
    require_a_good_one(
        result, remedy="choose other --effects, or record more different poses; --force-result writes it"
    )


def _reducer(scheduler: str | None) -> Reducer | None:
    if scheduler is None:
        return None
    from rim_camera_ros.calibrate.recordings import reduce_on_cluster

    def reduce_all(
        paths: Sequence[Path], camera: Camera, topics: Topics | None, scenes: Sequence[Scene]
    ) -> list[Dataset]:
        return reduce_on_cluster(paths, camera, scenes, topics=topics, scheduler=scheduler)

    return reduce_all


def _checked(given: argparse.Namespace) -> tuple[Request, Path | None]:
    """Check the options before any work; return the request and the report's path."""
    if given.out.suffix not in (".yaml", ".yml"):
        raise InputError(
            "a camera file ends in .yaml", file=given.out, place="--out", remedy=f"give {given.out}.yaml"
        )
    if given.board is not None and given.scene:
        raise InputError("--board is the scene", place="--scene", remedy="give one of the two")
    require_board(given)
    source = find_camera(given.camera)
    check_file(given.out, force=given.force)
    same = given.out.exists() and given.out.resolve() == source.resolve()
    names = given.scene or ([given.board] if given.board is not None else [])
    scenes = [find_scene(name) for name in names]
    inputs: list[str | Path | None] = [*given.bags, *dict.fromkeys(scenes), *([] if same else [source])]
    report = None if given.no_report else given.out.with_name(f"{given.out.stem}.report.html")
    camera = camera_of(given.camera)
    reports: dict[str, Path | None] = {}
    for part in measurement_of(camera).parts(camera) if report is not None else ():
        assert report is not None
        name = f"the report of {part.name}" if part.name else "the report"
        reports[name] = report_of_part(report, part)
    check_outputs({"--out": given.out, **reports}, inputs)
    for file in reports.values():
        check_file(file, force=given.force)
    seen: dict[Path, Path] = {}
    for bag in given.bags:
        if bag.resolve() in seen:
            raise InputError("is given twice", file=bag, remedy="give each recording once")
        seen[bag.resolve()] = bag
    if not 0 <= given.seed < 2**64:
        raise InputError(f"--seed {given.seed} is not a number from 0 to 2^64 - 1")
    effects = None
    if given.effects is not None:
        effects = tuple(word.strip() for word in given.effects.split(",") if word.strip())
        if not effects and not given.geometry:
            raise InputError("--effects names none", remedy="leave it out, or name effects: rim info CAMERA")
    request = Request(
        recordings=tuple(given.bags),
        camera=camera,
        scene=tuple(scene_of(name) for name in names) if names else None,
        effects=effects,
        geometry=given.geometry,
        topics=topics_of(given),
        seed=given.seed,
        threads=given.threads,
        camera_name=given.camera,
        scene_name=", ".join(names) if names else None,
        command=shlex.join(["rim", *_command_line(given)]),
    )
    return request, report


def _command_line(given: argparse.Namespace) -> list[str]:
    words = ["calibrate", *map(str, given.bags), "--camera", given.camera]
    words += [word for scene in given.scene or () for word in ("--scene", scene)]
    for name in ("board", "out", "effects"):
        value = getattr(given, name)
        if value is not None:
            words += [f"--{name}", str(value)]
    words += [word for name, value in declared(given).items() for word in (name, f"{value:g}")]
    words += ["--geometry"] * given.geometry
    words += ["--force-result"] * given.force_result
    words += ["--seed", str(given.seed)] if given.seed else []
    for topic in given.topic:
        words += ["--topic", topic]
    if given.namespace != DEFAULT_NAMESPACE:
        words += ["--namespace", given.namespace]
    return words


class _Line:
    """One line on a terminal with the progress; nothing in a pipe or with --quiet."""

    def __init__(self, *, quiet: bool) -> None:
        self._shown = not quiet and sys.stderr.isatty()
        self._start = time.monotonic()
        self._last = 0.0

    def __enter__(self) -> _Line:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            sys.stderr.write("\r\033[K")
            sys.stderr.flush()

    def show(self, words: str, done: int | None, total: int | None) -> None:
        """Show the progress; counts at most ten times a second."""
        now = time.monotonic()
        if not self._shown or (done is not None and now - self._last < _PACE):
            return
        self._last = now
        count = "" if done is None else f" {done}" + ("" if not total else f" of {total}")
        sys.stderr.write(f"\r\033[K{now - self._start:4.0f} s  {words}{count}"[:110])
        sys.stderr.flush()
