"""Truth poses from a recorded board: it is found in the images, its poses are adjusted and written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rim_camera_ros.bags import Recording, RecordingWriter, Topics
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry.board_stations import BoardStations, board_of
from rim_camera_ros.photogrammetry.estimate import estimate_optics
from rim_camera_ros.photogrammetry.known_optics import stated_optics
from rim_camera_ros.photogrammetry.observe import observe
from rim_camera_ros.photogrammetry.poses import BoardPoses, estimate_poses
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, OPTICS_PATHS
from rim_camera_ros.photogrammetry.report import OpticsCovariance, OpticsReport
from rim_camera_ros.photogrammetry.targets import Observations
from rim_camera_ros.scene import Scene, Surface

#: 1-sigmas assumed where the camera file states no covariance: focal length (relative), centre [px].
DEFAULT_FOCAL_SIGMA = 0.002
DEFAULT_CENTRE_SIGMA = 0.5
#: ... and of the size of a printed board: 0.1 mm in 200 mm.
DEFAULT_BOARD_SIGMA = 0.0005
#: Stations that estimated optics need, as `docs/photogrammetry.md` says.
_LEAST_STATIONS = 3

Wrapped = Callable[[Iterable[RawFrame]], Iterable[RawFrame]]


@dataclass(frozen=True)
class Known:
    """Declared 1-sigmas: of focal length and board size (relative), of the principal point in px.

    None: by the covariance of the camera file, or else the default.
    """

    focal_sigma: float | None = None
    centre_sigma: float | None = None
    board_sigma: float = DEFAULT_BOARD_SIGMA

    @property
    def focal(self) -> float:
        """Relative 1-sigma of a focal length of which the camera file states no covariance."""
        return DEFAULT_FOCAL_SIGMA if self.focal_sigma is None else self.focal_sigma

    @property
    def centre(self) -> float:
        """1-sigma [px] of a principal point of which the camera file states no covariance."""
        return DEFAULT_CENTRE_SIGMA if self.centre_sigma is None else self.centre_sigma


@dataclass(frozen=True)
class ImagePoses:
    """Poses of a board by the stamps of the frames that show it.

    ``optics`` and ``covariance`` as they were used; ``report`` of their estimation, None if they were held.
    """

    surface: Surface
    poses: BoardPoses
    station: dict[int, int]
    first: tuple[int, ...]
    optics: Optics
    covariance: OpticsCovariance
    report: OpticsReport | None
    notes: tuple[str, ...]
    frames: int

    def placed(self, frames: Iterable[RawFrame]) -> Iterator[RawFrame]:
        """Yield the frames that have a pose, with it; poses of other surfaces stay."""
        name = self.surface.name
        for frame in frames:
            number = self.station.get(frame.stamp)
            if number is None or number not in self.poses.stations:
                continue
            pose = self.poses.stations[number].pose
            yield replace(
                frame,
                truth={**frame.truth, name: pose},
                pose_stamps={**frame.pose_stamps, name: self.first[number]},
            )

    @property
    def placed_frames(self) -> int:
        """Number of frames that have a pose."""
        return sum(number in self.poses.stations for number in self.station.values())

    def words(self) -> list[str]:
        """Return the result in lines."""
        stations = list(self.poses.stations.values())
        normal = [1e3 * station.sigma_normal for station in stations]
        tilt = [1e3 * station.sigma_tilt for station in stations]
        residual = [station.residual for station in stations]
        lines = [
            f"'{self.surface.name}' at {len(stations)} stations, in {self.placed_frames} of {self.frames} "
            f"frames; {np.median([station.points for station in stations]):.0f} targets each, residuals "
            f"{np.median(residual):.2g} px (medians)",
            f"1-sigma of the poses: {np.median(normal):.2g} mm along the normal ({min(normal):.2g} to "
            f"{max(normal):.2g}), {np.median(tilt):.2g} mrad of tilt ({min(tilt):.2g} to {max(tilt):.2g})",
        ]
        if self.report is None:
            lines.append("optics: those of the camera file, held")
        else:
            sigmas = self.report.sigmas
            values = [
                f"{name} {value:.6g}" + (f" +- {sigmas[name]:.2g}" if name in sigmas else "")
                for name, value in self.report.values.items()
                if value != 0
            ]
            lines = [*(f"warning: {doubt}" for doubt in self.report.doubts), *lines]
            lines.append(f"optics: {', '.join(values)}; residuals {self.report.residual_rms:.2g} px")
        return lines

    def scene_of(self, board: Scene, *, share: float, scale: float) -> Scene:
        """Return the scene with the common errors of the board's poses.

        ``share``: the share of their variance that is the same in all; ``scale``: the relative 1-sigma of
        their scale.
        """
        surfaces = [
            replace(surface, pose_common=share, pose_scale_sigma=scale)
            if surface.name == self.surface.name
            else surface
            for surface in board.surfaces
        ]
        return replace(board, surfaces=tuple(surfaces))

    def scale_words(self, board_sigma: float) -> str:
        """Return in words how well the scale of distances is known; images do not separate it from others."""
        return (
            "distance scale, focal length and size of the board are not separable from images: all distances "
            f"to the board are known to {100 * self.poses.scale_sigma:.2g} % together (focal length and "
            "principal point, size of the board "
            f"{100 * board_sigma:.2g} %): a distance_scale within that says nothing about the camera; "
            f"{100 * self.poses.common_share:.0f} % of the variance of the poses is the same at all stations "
            f"(pose_common: {self.poses.common_share:.2f}, pose_scale_sigma: {self.poses.scale_sigma:.2g} of "
            "the scene file)"
        )


def poses_of_recording(
    path: Path,
    scene: Scene,
    camera: Camera,
    *,
    topics: Topics | None = None,
    known: Known | None = None,
    estimate: tuple[str, ...] = (),
    progress: Wrapped = iter,
) -> ImagePoses:
    """Find the board of a scene in a recording and return its poses.

    ``estimate`` names parameters of the optics (fx fy cx cy k1 k2 p1 p2 k3) that are adjusted jointly with
    the poses. Parameters with a covariance in the camera file are then adjusted as well, with it as a prior.
    Without names the optics of ``camera`` are held. ``known``: how well the optics and the size of the board
    are known. Raises `InputError` where the scene has no board or no frame shows it, `RimError` where no
    pose is determined.
    """
    known = known or Known()
    surface = board_of(scene)
    stations = BoardStations(surface, camera)
    with Recording(path, topics=topics) as bag:
        frames = bag.frame_count
        try:
            observed = observe(stations.frames(progress(bag.frames())), camera, Scene((surface,)))
        except InputError as error:
            if not stations.first and stations.unseen:
                raise InputError(
                    f"the board '{surface.name}' was found in none of {stations.unseen} frames",
                    file=path,
                    remedy=stations.described_otherwise()
                    or "the whole board must be in view, its squares 5 px and more; the scene file must "
                    "describe it as it is",
                ) from None
            raise error.located(path) from None
    optics, covariance, report = _optics(observed, camera, known, estimate)
    try:
        poses = estimate_poses(
            observed, optics=optics, covariance=covariance, board_scale_sigma=known.board_sigma
        )
    except RimError as error:
        raise error.located(path) from None
    notes = list(dict.fromkeys((*(() if report is None else report.notes), *poses.notes)))
    if stations.unseen:
        notes.append(f"{path}: excluded: {stations.unseen} frames in which the board was not found")
    if stations.ambiguous:
        notes.append(
            f"turned by 180 degrees the board '{surface.name}' looks alike: which end is which is taken from "
            "the frame before (grey fields, markers, or an even by an odd number of squares would show it)"
        )
    if report is None and stated_optics(camera) is None:
        notes.append(
            "the camera file states no covariance of its optics: focal length known to "
            f"{100 * known.focal:.2g} % and principal point to {known.centre:.2g} px are taken"
        )
    return ImagePoses(
        surface=surface,
        poses=poses,
        station=dict(stations.station),
        first=tuple(stations.first),
        optics=optics,
        covariance=covariance,
        report=report,
        notes=tuple(notes),
        frames=frames,
    )


def write_poses(
    source: Path, found: ImagePoses, out: Path, *, topics: Topics | None = None, force: bool = False
) -> None:
    """Write the frames of a recording that have a pose, with the pose and its covariance."""
    with Recording(source, topics=topics) as bag, RecordingWriter(out, force=force) as writer:
        for frame in found.placed(bag.frames()):
            writer.write_raw(frame)


def _optics(
    observed: Observations, camera: Camera, known: Known, estimate: tuple[str, ...]
) -> tuple[Optics, OpticsCovariance, OpticsReport | None]:
    """Return the optics to use and their covariance."""
    if estimate:
        if len({point.station for point in observed.points}) < _LEAST_STATIONS:
            raise InputError(
                f"optics need {_LEAST_STATIONS} stations and more",
                place="--estimate",
                remedy="hold the board at other distances and tilts, or hold the optics (leave it out)",
            )
        optics, covariance, report = estimate_optics(
            observed, start=camera.optics, parameters=estimate, known=stated_optics(camera)
        )
        held = _declared(
            optics,
            known,
            [parameter for parameter in OPTICS_PARAMETERS[:4] if parameter not in report.sigmas],
        )
        paths = (*covariance.parameters, *held.parameters)
        matrix = np.zeros((len(paths), len(paths)))
        n = len(covariance.parameters)
        matrix[:n, :n], matrix[n:, n:] = covariance.matrix, held.matrix
        return optics, OpticsCovariance(paths, matrix), report
    stated = stated_optics(camera)
    if stated is not None and known.focal_sigma is None and known.centre_sigma is None:
        return camera.optics, stated, None
    return camera.optics, _declared(camera.optics, known, OPTICS_PARAMETERS[:4]), None


def _declared(optics: Optics, known: Known, names: Iterable[str]) -> OpticsCovariance:
    """Return the covariance of held parameters; focal lengths err together."""
    effect = {"fx": (optics.fx * known.focal, 0.0, 0.0), "fy": (optics.fy * known.focal, 0.0, 0.0)}
    effect |= {"cx": (0.0, known.centre, 0.0), "cy": (0.0, 0.0, known.centre)}
    chosen = [name for name in names if name in effect]
    rows = np.array([effect[name] for name in chosen]).reshape(-1, 3)
    paths = tuple(OPTICS_PATHS[OPTICS_PARAMETERS.index(name)] for name in chosen)
    return OpticsCovariance(paths, rows @ rows.T)
