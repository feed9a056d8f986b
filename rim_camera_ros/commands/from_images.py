"""Parts of the commands that find poses in images: options, and recordings with poses for other commands."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.commands.common import Progress, say
from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.fit.data import MissingPoses
from rim_camera_ros.photogrammetry.board_stations import board_of
from rim_camera_ros.photogrammetry.from_images import (
    DEFAULT_BOARD_SIGMA,
    DEFAULT_CENTRE_SIGMA,
    DEFAULT_FOCAL_SIGMA,
    Known,
    poses_of_recording,
    write_poses,
)
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS
from rim_camera_ros.scene import Scene
from rim_camera_ros.temporary import temporary_folder

#: Name of the folder of recordings with poses.
_FOLDER = "rim_poses"


def _sigma(text: str) -> float:
    value = float(text)
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be 0 or more, found {text}")
    return value


def add_known(parser: argparse.ArgumentParser, *, of_board: bool = False) -> None:
    """Add the options that declare errors of the optics and the board.

    ``of_board``: for commands in which ``--board`` requests poses from the images, and the optics are held.
    """
    also = "with --board: " if of_board else ""
    if not of_board:
        parser.add_argument(
            "--estimate",
            metavar="fx,cx,...",
            help="parameters of the optics to adjust with the poses: fx fy cx cy k1 k2 p1 p2 k3, or all "
            "(default: none, those of the camera file hold)",
        )
    parser.add_argument(
        "--board-sigma",
        type=_sigma,
        metavar="REL",
        help=f"{also}relative 1-sigma of the size of the board ({DEFAULT_BOARD_SIGMA:g}: 0.1 mm in 200 mm)",
    )
    parser.add_argument(
        "--focal-sigma",
        type=_sigma,
        metavar="REL",
        help=f"{also}relative 1-sigma of a focal length that is held (default: the camera file's covariance, "
        f"else {DEFAULT_FOCAL_SIGMA:g})",
    )
    parser.add_argument(
        "--centre-sigma",
        type=_sigma,
        metavar="PX",
        help=f"{also}1-sigma of a principal point that is held (default: the camera file's covariance, else "
        f"{DEFAULT_CENTRE_SIGMA:g})",
    )


def declared(given: argparse.Namespace) -> dict[str, float]:
    """Return the values of the options of `add_known`, by their names."""
    found = {f"--{name}-sigma": getattr(given, f"{name}_sigma") for name in ("board", "focal", "centre")}
    return {name: value for name, value in found.items() if value is not None}


def require_board(given: argparse.Namespace) -> None:
    """Raise `InputError` where options for poses from the images are given without ``--board``."""
    if given.board is None:
        for name in declared(given):
            raise InputError(
                "poses are those of the recording",
                place=name,
                remedy="it belongs to --board; errors of recorded poses are pose_sigma in the scene file",
            )


def known_of(given: argparse.Namespace) -> Known:
    """Return the knowledge of optics and board that the options declare."""
    board = DEFAULT_BOARD_SIGMA if given.board_sigma is None else given.board_sigma
    return Known(focal_sigma=given.focal_sigma, centre_sigma=given.centre_sigma, board_sigma=board)


def estimated(given: argparse.Namespace) -> tuple[str, ...]:
    """Return the parameters that are to be estimated. Raises `InputError` for unknown ones."""
    if given.estimate is None:
        return ()
    names = [word.strip() for word in given.estimate.split(",") if word.strip()]
    if names == ["all"]:
        return OPTICS_PARAMETERS
    for name in names:
        if name not in OPTICS_PARAMETERS:
            raise InputError(
                f"no parameter '{name}' of the optics",
                place="--estimate",
                remedy=nearest_name(name, OPTICS_PARAMETERS),
            )
    return tuple(name for name in OPTICS_PARAMETERS if name in names)


@contextmanager
def board_as_remedy(scene: Scene, name: str) -> Iterator[None]:
    """Name ``--board`` in errors of missing poses, where the scene ``name`` has a board to find in images."""
    try:
        yield
    except MissingPoses as error:
        try:
            board_of(scene)
        except InputError:
            raise error from None
        raise InputError(
            error.problem,
            file=error.file,
            place=error.place,
            remedy=f"--board {name} in the place of --scene finds them in the images; or {error.remedy}",
        ) from None


@dataclass(frozen=True)
class Posed:
    """Recordings with poses of a board that were made from ``originals``, in their order.

    ``scene`` has the board, with the errors that the poses share.
    """

    recordings: tuple[Path, ...]
    originals: tuple[Path, ...]
    scene: Scene

    def named(self, text: str) -> str:
        """Return a text that names the originals in the place of the recordings."""
        pairs = zip(self.recordings, self.originals, strict=True)
        # longer names first: 1 begins 10
        for its, original in sorted(pairs, key=lambda pair: -len(str(pair[0]))):
            text = text.replace(str(its), str(original))
        return text


@contextmanager
def posed_recordings(
    given: argparse.Namespace, bags: tuple[Path, ...], board: Scene, camera: Camera, topics: Topics
) -> Iterator[Posed]:
    """Recordings with the poses of a board found in their images, for as long as the context lasts.

    The result is printed. The recordings are in a folder that is removed afterwards (by the next run where
    this one is killed). Errors name the originals. ``pose_common`` of the scene file is replaced by the share
    of the poses' variance that all poses of a recording have in common, as a mean over the recordings, and
    ``pose_scale_sigma`` by the scale error of all.
    """
    known = known_of(given)
    with closing(temporary_folder(Path(tempfile.gettempdir()), _FOLDER)) as folder:
        made: list[Path] = []
        shares: list[float] = []
        scales: list[float] = []
        for number, bag in enumerate(bags):
            with Recording(bag, topics=topics) as recording:
                total = recording.frame_count
            with Progress("searched", total, quiet=given.quiet) as progress:
                found = poses_of_recording(
                    bag, board, camera, topics=topics, known=known, progress=progress.over
                )
            made.append(folder.path / str(number))
            write_poses(bag, found, made[-1], topics=topics)
            say(given, [*found.notes, found.scale_words(known.board_sigma)])
            if not given.quiet:
                print("\n".join(found.words()))
            shares.append(found.poses.common_share)
            scales.append(found.poses.scale_sigma)
        # one camera and one board: all recordings have the same error of scale
        there = found.scene_of(board, share=sum(shares) / len(shares), scale=max(scales))
        posed = Posed(tuple(made), bags, there)
        try:
            yield posed
        except RimError as error:
            file = None if error.file is None else posed.named(error.file)
            problem = posed.named(error.problem)
            raise type(error)(problem, file=file, place=error.place, remedy=error.remedy) from None
