"""A track for each person: constant-velocity Kalman filters and the assignment of detections to them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.tracking.moving import Detection, divided

Array = NDArray[np.float64]

#: Cost of a pair outside of the gate, larger than that of any other pair.
_FORBIDDEN = 1e9
#: Most positions that a track keeps.
_TRAIL = 200
#: Area and top of a person in full view, as a track keeps them, shrink at most by this share per detection.
_SHRINK = 0.02
#: Clusters wider than this many half widths of a person can hold two people.
_WIDE = 3.5


@dataclass(frozen=True, kw_only=True)
class TrackSettings:
    """How people move, and how they appear.

    ``acceleration`` [m^2/s^3]: spectral density of the white acceleration. ``measurement_sigma`` [m]: 1-sigma
    per axis of the position of a person in full view. ``start_speed`` [m/s]: 1-sigma of the speed per axis of
    a new person. ``gate`` [-]: probability that a person's own detection lies within the gate.
    ``confirm_after``: detections after which a track is shown. ``coast`` [s]: for how long a hidden person is
    predicted. ``apart`` [m]: least distance of a new person from known ones. ``half_width`` [m] of a person
    across the shoulders; ``body_radius`` [m] as in `ClusterSettings`.
    """

    acceleration: float = 0.2
    measurement_sigma: float = 0.06
    start_speed: float = 1.0
    gate: float = 0.995
    confirm_after: int = 3
    coast: float = 2.0
    apart: float = 0.45
    half_width: float = 0.22
    body_radius: float = 0.15


@dataclass
class Track:
    """One person: ``state`` x y [m] vx vy [m/s] on the floor with ``covariance`` (4, 4) at ``time`` [s].

    ``area`` [m^2] and ``top`` [m] of the person in full view; ``trail``: the last (time, x, y).
    """

    identity: int
    state: Array
    covariance: Array
    time: float
    area: float
    top: float
    detections: int = 1
    seen: float = 0.0
    trail: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=_TRAIL))

    @property
    def position(self) -> Array:
        """(2,) in m."""
        return self.state[:2]

    @property
    def hidden(self) -> bool:
        """Whether there was no detection in the last frame."""
        return self.seen < self.time


def transition(step: float) -> Array:
    """Return the transition matrix (4, 4) of constant velocity over ``step`` s."""
    result = np.eye(4)
    result[0, 2] = result[1, 3] = step
    return result


def process_noise(step: float, density: float) -> Array:
    """Return the covariance (4, 4) that white acceleration adds in ``step`` s; ``density`` [m^2/s^3].

    Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), 6.2.2.
    """
    block = density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    result: Array = np.kron(block, np.eye(2)).astype(float)
    return result


def predict(state: Array, covariance: Array, *, step: float, density: float) -> tuple[Array, Array]:
    """Return state (4,) and covariance (4, 4) ``step`` s later."""
    motion = transition(step)
    return motion @ state, motion @ covariance @ motion.T + process_noise(step, density)


def update(state: Array, covariance: Array, position: Array, *, variance: float) -> tuple[Array, Array]:
    """Return state and covariance after a measured ``position`` (2,) [m] with ``variance`` [m^2] per axis."""
    gain = np.linalg.solve(covariance[:2, :2] + variance * np.eye(2), covariance[:2]).T
    rest = np.eye(4)
    rest[:, :2] -= gain
    # Joseph's form stays symmetric and positive
    return state + gain @ (position - state[:2]), rest @ covariance @ rest.T + variance * gain @ gain.T


class Tracker:
    """Follows people from frame to frame; identities count from 1 and are not used again."""

    def __init__(self, settings: TrackSettings | None = None) -> None:
        from scipy.optimize import linear_sum_assignment  # takes a good part of a node's start

        self.settings = settings or TrackSettings()
        self._assignment = linear_sum_assignment
        self._tracks: list[Track] = []
        self._next = 1

    @property
    def people(self) -> list[Track]:
        """Confirmed tracks, including those of hidden people."""
        return [track for track in self._tracks if self._confirmed(track)]

    def forget(self) -> None:
        """End all tracks."""
        self._tracks.clear()

    def take(self, found: Sequence[Detection], *, time: float) -> list[Track]:
        """Predict to ``time`` [s], assign detections, begin and end tracks; return `people`.

        Detections are assigned to confirmed tracks first, then to new ones; remaining ones begin new tracks.
        """
        settings = self.settings
        for person in self._tracks:
            person.state, person.covariance = predict(
                person.state,
                person.covariance,
                step=max(time - person.time, 0.0),
                density=settings.acceleration,
            )
            person.time = time
        rest = self._divide(found)
        for group in (self.people, [person for person in self._tracks if not self._confirmed(person)]):
            rest = self._assign(group, rest)
        self._tracks = [person for person in self._tracks if self._lives(person)]
        for new in rest:
            if all(np.linalg.norm(new.position - other.position) >= settings.apart for other in self._tracks):
                self._begin(new, time)
        for track in self._tracks:
            track.trail.append((time, float(track.state[0]), float(track.state[1])))
        return self.people

    def _confirmed(self, person: Track) -> bool:
        return person.detections >= self.settings.confirm_after

    def _lives(self, person: Track) -> bool:
        return not person.hidden or (
            self._confirmed(person) and person.time - person.seen <= self.settings.coast
        )

    def _divide(self, found: Sequence[Detection]) -> list[Detection]:
        """Divide clusters that are too wide for one person among the people expected there."""
        half_width, radius = self.settings.half_width, self.settings.body_radius
        result: list[Detection] = []
        for detection in found:
            expected = [
                track.position
                for track in self.people
                if np.linalg.norm(detection.cells - track.position, axis=1).min() < 2 * half_width
            ]
            wide = len(expected) > 1 and detection.width > _WIDE * half_width
            result += divided(detection, np.array(expected), body_radius=radius) if wide else [detection]
        return result

    def _variance(self, track: Track, detection: Detection) -> float:
        """Return the variance [m^2] of a measured position: of a half hidden person only one side is seen."""
        visible = min(detection.area / track.area, 1.0)
        return self.settings.measurement_sigma**2 + ((1 - visible) * self.settings.half_width) ** 2

    def _assign(self, tracks: list[Track], found: list[Detection]) -> list[Detection]:
        """Assign detections to tracks by the greatest likelihood within the gate; return those left."""
        if not tracks or not found:
            return list(found)
        gate = -2.0 * math.log1p(-self.settings.gate)  # quantile of a chi-square of two degrees
        cost = np.full((len(tracks), len(found)), _FORBIDDEN)
        for i, track in enumerate(tracks):
            for k, detection in enumerate(found):
                spread = track.covariance[:2, :2] + self._variance(track, detection) * np.eye(2)
                difference = detection.position - track.position
                mahalanobis = float(difference @ np.linalg.solve(spread, difference))
                if mahalanobis <= gate:
                    cost[i, k] = mahalanobis + float(np.log(np.linalg.det(spread)))
        taken = set()
        for row, column in zip(*self._assignment(cost), strict=True):
            if cost[row, column] < _FORBIDDEN:
                taken.add(int(column))
                self._see(tracks[row], found[column])
        return [detection for k, detection in enumerate(found) if k not in taken]

    def _see(self, track: Track, detection: Detection) -> None:
        variance = self._variance(track, detection)
        track.state, track.covariance = update(
            track.state, track.covariance, detection.position, variance=variance
        )
        track.area = max(detection.area, (1 - _SHRINK) * track.area)
        track.top = max(detection.top, (1 - _SHRINK) * track.top)
        track.detections += 1
        track.seen = track.time

    def _begin(self, detection: Detection, time: float) -> None:
        settings = self.settings
        variances = [settings.measurement_sigma**2] * 2 + [settings.start_speed**2] * 2
        self._tracks.append(
            Track(
                identity=self._next,
                state=np.array([*detection.position, 0.0, 0.0]),
                covariance=np.diag(variances),
                time=time,
                area=detection.area,
                top=detection.top,
                seen=time,
            )
        )
        self._next += 1
