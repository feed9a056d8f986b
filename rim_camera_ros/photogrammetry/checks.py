"""Checks of the observations of a bundle adjustment: errors where it cannot work, notes where it is weak."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.photogrammetry.targets import Distance, ImagePoint, Observations, TargetField

Array = NDArray[np.float64]

#: Fewest targets at a station: three allow up to four poses, the fourth target decides between them.
LEAST_TARGETS = 4
#: A field thinner than this share of its length is a plane.
_FLAT = 0.02
#: Least angles in rad between the directions from which a plane is seen, and between the camera's rolls:
#: tilts of 40 deg in different directions alone are up to 40 deg of roll between two stations.
_LEAST_DIRECTIONS = np.deg2rad(5.0)
_LEAST_ROLL = np.deg2rad(60.0)
#: Routine data hold 1 to 10 % of gross errors (Hampel et al. 1986, sec. 1.2c); more have another cause.
_MOST_GROSS = 0.1
#: Where residuals have more than twice the stated variance, most of it has another cause.
_MOST_VARIANCE = 2.0


def usable_points(observations: Observations) -> tuple[list[ImagePoint], list[str]]:
    """Return the points of the stations that have enough of them, and notes on the others.

    Raises `InputError` in one line: an id that the field does not have, a target seen twice at a station,
    a sigma or coordinate that is no number, too few targets, only one station.
    """
    field = observations.field
    for point in observations.points:
        if point.target not in field.targets:
            raise InputError(
                f"target '{point.target}' of station {point.station} is not in the target field",
                place="targets",
                remedy=nearest_name(point.target, field.targets),
            )
        if not (np.isfinite([point.u, point.v, point.sigma]).all() and point.sigma > 0):
            raise InputError(
                f"target '{point.target}' of station {point.station} has u {point.u:g}, v {point.v:g}, "
                f"sigma {point.sigma:g}",
                place="targets",
                remedy="coordinates must be numbers and sigma positive",
            )
    counted = Counter((point.station, point.target) for point in observations.points)
    for (station, target), count in counted.items():
        if count > 1:
            raise InputError(
                f"target '{target}' was observed {count} times at station {station}",
                place="targets",
                remedy="give each target at most once per station",
            )
    by_station: dict[int, list[tuple[float, float, float]]] = {}
    for point in observations.points:
        by_station.setdefault(point.station, []).append(field.targets[point.target].position)
    if not by_station:
        raise InputError(
            "too few targets: none was observed",
            place="targets",
            remedy="check that the scene describes the target field and that it is in view",
        )
    unusable: dict[int, str] = {}
    for station, positions in sorted(by_station.items()):
        if len(positions) < LEAST_TARGETS:
            unusable[station] = f"{len(positions)} targets, at least {LEAST_TARGETS} are needed"
        elif _on_a_line(np.array(positions)):
            unusable[station] = f"its {len(positions)} targets lie on one line"
    notes = [f"station {station} excluded: {reason}" for station, reason in unusable.items()]
    stations = sorted(set(by_station) - set(unusable))
    if not stations:
        station = max(unusable, key=lambda one: len(by_station[one]))
        raise InputError(
            f"too few targets at every station; at station {station}, which has most: {unusable[station]}",
            place="targets",
            remedy="bring more of the target field into view",
        )
    if len(stations) == 1:
        raise InputError(
            f"only one station ({stations[0]}) has enough targets",
            place="stations",
            remedy="observe the field from at least two stations, better eight and more, some of them rolled",
        )
    return [point for point in observations.points if point.station not in unusable], notes


def check_field(field: TargetField, *, distances: Sequence[Distance], free: bool) -> None:
    """Raise `InputError` for distances between unknown targets, with known coordinates, or not positive."""
    for distance in distances:
        for name in (distance.first, distance.second):
            if name not in field.targets:
                raise InputError(
                    f"the known distance {distance.first} - {distance.second} names target '{name}', "
                    "which is not in the field",
                    place="distances",
                    remedy=nearest_name(name, field.targets),
                )
        if distance.first == distance.second or not (distance.length > 0 and distance.sigma > 0):
            raise InputError(
                f"the known distance {distance.first} - {distance.second} is {distance.length:g} m, "
                f"sigma {distance.sigma:g} m",
                place="distances",
                remedy="length and sigma must be positive and the two targets different",
            )
    if distances and not free:
        raise InputError(
            "known distances were given together with known target coordinates",
            place="distances",
            remedy="give one of the two, or let the target coordinates be free",
        )


def check_directions(targets: Array, rotations: Array) -> None:
    """Raise `InputError` where all targets lie in a plane that all stations see from one direction.

    ``targets`` (t, 3), ``rotations`` (s, 3, 3) field to camera. The camera constant and the distance then
    only scale the same image.
    """
    if not is_flat(targets):
        return
    normal = np.linalg.svd(targets - targets.mean(axis=0))[2][2]
    seen = rotations @ normal
    spread = _largest_angle(seen)
    if spread < _LEAST_DIRECTIONS:
        raise InputError(
            "all targets lie in a plane and all stations see it from one direction "
            f"(within {np.rad2deg(spread):.1f} deg)",
            place="stations",
            remedy="tilt the field or the camera by 30 deg and more between stations",
        )


def geometry_notes(rotations: Array, correlation: Array, names: Sequence[str]) -> list[str]:
    """Return a warning where no station is rolled about the optical axis against another.

    ``rotations`` (s, 3, 3) field to camera; ``correlation`` (k, k) of the optics parameters ``names``: the
    warning states the greatest correlation between principal point and decentring.
    """
    between = np.einsum("aij,bkj->abik", rotations, rotations).reshape(-1, 3, 3)
    quaternions = Rotation.from_matrix(between).as_quat()
    # the part of a rotation that turns about z
    twist = 2 * np.arctan2(quaternions[:, 2], quaternions[:, 3])
    roll = float(np.abs(np.angle(np.exp(1j * twist))).max())
    if roll >= _LEAST_ROLL:
        return []
    pairs = [
        (float(correlation[names.index(one), names.index(other)]), one, other)
        for one in ("cx", "cy")
        for other in ("p1", "p2")
        if one in names and other in names
    ]
    value, one, other = max(pairs, key=lambda pair: abs(pair[0]), default=(0.0, "", ""))
    measured = f" (correlation {one} - {other} {value:+.2f})" if pairs else ""
    return [
        "no station is rotated about the optical axis "
        f"(largest roll between stations {np.rad2deg(roll):.0f} deg): "
        f"principal point and decentring are not separable{measured}; add stations rolled by 90 deg"
    ]


def doubts(rejected: int, kept: int, sigma_zero: float) -> list[str]:
    """Return a warning where more targets were rejected, or residuals are larger, than by chance."""
    many = rejected > _MOST_GROSS * (rejected + kept)
    large = sigma_zero**2 > _MOST_VARIANCE
    if not (many or large):
        return []
    words = [f"{rejected} of {rejected + kept} targets were rejected as gross errors"] * many
    words += [f"residuals are {sigma_zero:.2g} times as large as the images of the targets imply"] * large
    widened = ", by which the standard deviations are widened" if large else ""
    return [
        f"{' and '.join(words)}{widened}: do not use these optics before the cause is known (a board that is "
        "bent, moves, or is not as the scene file says; a lens that needs another model; reflections)"
    ]


def is_flat(targets: Array) -> bool:
    """Whether targets (t, 3) lie in a plane, within 2 % of their extent."""
    sizes = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)
    return bool(sizes[-1] < _FLAT * sizes[0])


def _on_a_line(targets: Array) -> bool:
    sizes = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)
    return bool(sizes[1] < _FLAT * sizes[0])


def _largest_angle(directions: Array) -> float:
    cosine = np.clip(np.abs(directions @ directions.T), 0.0, 1.0)
    return float(np.arccos(cosine.min()))
