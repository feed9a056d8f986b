"""Estimation of a camera's optics from observed targets: the adjustment, and which parameters it supports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.optics import Optics, rays_through
from rim_camera_ros.photogrammetry.adjustment import adjust, outliers
from rim_camera_ros.photogrammetry.bundle import Adjusted, Bundle, Loss, NotDetermined, State
from rim_camera_ros.photogrammetry.checks import (
    LEAST_TARGETS,
    check_directions,
    check_field,
    doubts,
    geometry_notes,
    usable_points,
)
from rim_camera_ros.photogrammetry.known_optics import departure_note, prior_of
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, optics_of, optics_vector
from rim_camera_ros.photogrammetry.report import (
    InsignificantParameters,
    OpticsCovariance,
    OpticsReport,
    RejectedPoint,
)
from rim_camera_ros.photogrammetry.significance import least_significant, returned
from rim_camera_ros.photogrammetry.summarise import Labels, correlation_of, covariance_of, report_on
from rim_camera_ros.photogrammetry.targets import Distance, ImagePoint, Observations
from rim_camera_ros.rotations import rotation_matrix

Array = NDArray[np.float64]

#: Points whose residual exceeds this many of its own sigma are gross errors: one in 25 000 good ones does.
GROSS = 4.5


def estimate_optics(
    observations: Observations,
    *,
    start: Optics,
    targets: Literal["known", "free"] = "known",
    distances: Sequence[Distance] = (),
    parameters: Sequence[str] = OPTICS_PARAMETERS,
    significance: float | None = 0.05,
    known: OpticsCovariance | None = None,
    loss: Loss = "huber",
    correct_ellipses: bool = True,
) -> tuple[Optics, OpticsCovariance, OpticsReport]:
    """Estimate a camera's optics from a target field seen from several stations (bundle adjustment).

    Brown's model in the parametrisation of plumb_bob (Kahlmann 2007, sec. 3.2). ``start``: approximate
    optics; parameters that are not in ``parameters`` (names of fx fy cx cy k1 k2 p1 p2 k3) keep their values
    from there, and without fy the ratio fy / fx is held. ``targets``: the field's coordinates are ``known``,
    or ``free``: the datum then comes from inner constraints, the scale from ``distances`` if there are any.
    ``significance``: level at which departures from ``start`` are tested; parameters without a significant
    one keep its value, one group after the other, the least significant first (k3, then k2, then k1; p1 with
    p2; fy apart from fx); None: all are estimated. ``known``: prior covariance of ``start``; its parameters
    are estimated with it as a prior, and not tested. ``loss``: ``huber`` bounds the influence of gross
    errors, which are then rejected; ``squared`` is plain least squares. ``correct_ellipses``: circles are
    compared with the centres of their ellipses.

    Returns the optics, the covariance of what was estimated, and a report. Raises `InputError` for too few
    targets, a single station, a plane seen from one direction, ids that the field does not have, or geometry
    that does not determine a parameter; `RimError` where the adjustment does not converge.
    """
    _check_names(parameters)
    prior, before = (None, ()) if known is None else prior_of(start, known)
    estimated = tuple(name for name in OPTICS_PARAMETERS if name in (*parameters, *before))
    points, notes = usable_points(observations)
    check_field(observations.field, distances=distances, free=targets == "free")

    def block_of(points: Sequence[ImagePoint]) -> Block:
        block = block_from(observations, points, start, targets, distances, correct_ellipses)
        block = replace(block, bundle=replace(block.bundle, prior=prior))
        _check_redundancy(block, len(estimated))
        return block

    block = block_of(points)
    poses = start_poses(observations, block, start)
    state = state_from(block, poses, optics_vector(start))
    check_directions(block.bundle.targets, state.rotations)

    rejected: list[RejectedPoint] = []
    adjusted = _adjusted(block, state, estimated, loss)
    while loss == "huber" and (gross := outliers(adjusted, block.bundle, limit=GROSS)).any():
        rejected += _rejected(adjusted, block.points, gross)
        kept = tuple(point for point, bad in zip(block.points, gross, strict=True) if not bad)
        points, few = usable_points(replace(observations, points=kept))
        notes += [f"after rejecting gross errors {note}" for note in few]
        block = block_of(points)
        # a pose that a gross error has spoilt starts anew
        adjusted = _adjusted(block, state_from(block, poses, adjusted.state.optics), estimated, loss)
    if loss == "huber":
        adjusted = _adjusted(block, adjusted.state, estimated, "squared")

    if prior is not None:
        # keeps its weight relative to observations whose errors are sigma zero times as large as stated
        scaled = replace(prior, root=adjusted.sigma_zero * prior.root)
        block = replace(block, bundle=replace(block.bundle, prior=scaled))
        adjusted = _adjusted(block, adjusted.state, estimated, "squared")
    insignificant: list[InsignificantParameters] = []
    while significance is not None and (group := least_significant(adjusted, start, significance, before)):
        insignificant.append(group)
        estimated = tuple(name for name in estimated if name not in group.parameters)
        adjusted = _adjusted(block, returned(adjusted.state, group.parameters, start), estimated, "squared")
    check_directions(adjusted.state.targets, adjusted.state.rotations)
    correlation, covariance = correlation_of(adjusted.optics_covariance), covariance_of(adjusted)
    notes = [
        *observations.notes,
        *([] if prior is None else departure_note(adjusted.state.optics, covariance, prior)),
        *notes,
        *geometry_notes(adjusted.state.rotations, correlation, adjusted.estimated),
    ]
    report = report_on(
        adjusted,
        points=block.points,
        stations=block.stations,
        names=block.names,
        insignificant=tuple(insignificant),
        rejected=tuple(rejected),
        doubts=doubts(len(rejected), len(block.points), adjusted.sigma_zero),
        notes=notes,
    )
    return optics_of(adjusted.state.optics), covariance, report


# --- setting up ------------------------------------------------------------------------------------


def _check_names(parameters: Sequence[str]) -> None:
    for name in parameters:
        if name not in OPTICS_PARAMETERS:
            raise InputError(
                f"unknown optics parameter '{name}'",
                place="parameters",
                remedy=nearest_name(name, OPTICS_PARAMETERS),
            )
    if "fy" in parameters and "fx" not in parameters:
        raise InputError(
            "fy is estimated without fx", place="parameters", remedy="estimate fx, or neither of the two"
        )


@dataclass(frozen=True)
class Block:
    """A bundle with the points, stations and target ids that its indices stand for."""

    bundle: Bundle
    points: tuple[ImagePoint, ...]
    stations: tuple[int, ...]
    names: tuple[str, ...]


def block_from(
    observations: Observations,
    points: Sequence[ImagePoint],
    start: Optics,
    targets: Literal["known", "free"],
    distances: Sequence[Distance],
    correct_ellipses: bool,
) -> Block:
    stations = sorted({point.station for point in points})
    seen = {point.target for point in points} | {
        name for distance in distances for name in (distance.first, distance.second)
    }
    names = [name for name in observations.field.targets if name in seen]
    station_of = {name: i for i, name in enumerate(stations)}
    target_of = {name: i for i, name in enumerate(names)}
    known = [observations.field.targets[name] for name in names]
    shared = [point.shifts for point in points]
    shape = next((one.shape for one in shared if one is not None), None)
    bundle = Bundle(
        image=np.array([(point.u, point.v) for point in points], dtype=float),
        sigma=np.array([point.sigma for point in points], dtype=float),
        shifts=None
        if shape is None
        else np.array([np.zeros(shape) if one is None else one for one in shared]),
        station=np.array([station_of[point.station] for point in points], dtype=np.intp),
        target=np.array([target_of[point.target] for point in points], dtype=np.intp),
        targets=np.array([one.position for one in known], dtype=float),
        radii=np.array([one.radius for one in known], dtype=float),
        normals=np.array([one.normal for one in known], dtype=float),
        free_targets=targets == "free",
        distances=tuple(
            (target_of[distance.first], target_of[distance.second], distance.length, distance.sigma)
            for distance in distances
        ),
        aspect=start.fx / start.fy,
        correct_ellipses=correct_ellipses,
    )
    return Block(bundle, tuple(points), tuple(stations), tuple(names))


def state_from(block: Block, poses: Mapping[int, tuple[Array, Array]], optics: Array) -> State:
    rotations = np.array([poses[station][0] for station in block.stations])
    translations = np.array([poses[station][1] for station in block.stations])
    return State(optics, rotations, translations, block.bundle.targets)


def start_poses(observations: Observations, block: Block, start: Optics) -> dict[int, tuple[Array, Array]]:
    """Return rotation (3, 3) and translation (3,) by station: as given, or else by cv2.solvePnP."""
    poses: dict[int, tuple[Array, Array]] = {}
    bundle = block.bundle
    rays = rays_through(start, bundle.image)
    for i, station in enumerate(block.stations):
        pose = observations.poses.get(station)
        if pose is not None:
            poses[station] = (rotation_matrix(pose.orientation), np.array(pose.position, dtype=float))
            continue
        mine = (bundle.station == i) & np.isfinite(rays[:, 2])
        resection = None
        if mine.sum() >= LEAST_TARGETS:
            resection = cv2.solvePnP(
                np.ascontiguousarray(bundle.targets[bundle.target[mine]]),
                np.ascontiguousarray(rays[mine, :2] / rays[mine, 2:]),
                np.eye(3),
                None,
                flags=cv2.SOLVEPNP_SQPNP,
            )
        if resection is None or not resection[0]:
            raise InputError(
                f"no pose of station {station} fits its targets",
                place="stations",
                remedy="check the identification of the targets, or give an approximate pose",
            )
        rotation = np.asarray(cv2.Rodrigues(resection[1])[0], dtype=float)
        poses[station] = (rotation, np.asarray(resection[2], dtype=float).ravel())
    return poses


def _check_redundancy(block: Block, estimated: int) -> None:
    bundle = block.bundle
    unknowns = estimated + 6 * len(block.stations)
    equations = 2 * len(bundle.sigma) + len(bundle.distances)
    if bundle.free_targets:
        unknowns += 3 * len(bundle.targets) - (6 if bundle.distances else 7)
    if equations <= unknowns:
        raise InputError(
            f"too few targets: {equations} measured values for {unknowns} unknowns",
            place="targets",
            remedy="observe more targets at each station, or estimate fewer parameters",
        )


# --- adjusting -------------------------------------------------------------------------------------


def _adjusted(block: Block, state: State, estimated: tuple[str, ...], loss: Loss) -> Adjusted:
    try:
        return adjust(block.bundle, state, estimated=estimated, loss=loss)
    except NotDetermined as error:
        unknown = Labels(estimated, block.stations, block.names)[error.unknown]
        raise InputError(
            f"the observations do not determine the {unknown}",
            place="stations",
            remedy="add stations with other tilts, distances and rolls, or estimate fewer parameters",
        ) from None


def _rejected(
    adjusted: Adjusted, points: Sequence[ImagePoint], gross: NDArray[np.bool_]
) -> list[RejectedPoint]:
    return [
        RejectedPoint(point.target, point.station, (float(u), float(v)))
        for point, (u, v), bad in zip(points, adjusted.residuals, gross, strict=True)
        if bad
    ]
