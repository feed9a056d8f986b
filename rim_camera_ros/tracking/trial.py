"""Trials: walking figures are simulated, corrected and tracked, and compared with their true positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.devices.timeline import Timeline
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Simulation
from rim_camera_ros.tracking.figures import GROUND, Walk, walking_scene
from rim_camera_ros.tracking.people import PeopleSettings, PeopleTracker

Array = NDArray[np.float64]

RATE = 10.0
#: A track belongs to the figure that is nearest to it, up to this distance [m].
_BELONGS = 0.5


@dataclass(frozen=True)
class Trial:
    """Results of a trial.

    ``times`` (T,) [s] and ``truth`` (T, K, 2) [m] of the K walks; ``tracks``: for each identity (N, 4) with
    time [s], x, y [m] and whether the person was hidden; ``detected`` (T, K): a detection lay within 0.5 m.
    """

    times: Array
    truth: Array
    tracks: dict[int, Array]
    detected: NDArray[np.bool_]

    def owners(self, identity: int) -> Array:
        """Return for each visible moment (N,) the walk next to the track, -1 where none is within 0.5 m."""
        track = self.tracks[identity]
        seen = track[track[:, 3] == 0]
        index = np.searchsorted(self.times, seen[:, 0] - 1e-6)
        apart = np.linalg.norm(self.truth[index] - seen[:, None, 1:3], axis=2)
        return np.where(apart.min(axis=1) <= _BELONGS, apart.argmin(axis=1), -1)

    @property
    def identities_kept(self) -> bool:
        """Whether each figure had one track, which was never at another figure, and there were no others."""
        owners = [self.owners(track) for track in self.tracks]
        alone = all(len(set(owner.tolist())) == 1 for owner in owners)
        return alone and sorted(int(owner[0]) for owner in owners) == list(range(self.truth.shape[1]))

    @property
    def errors(self) -> Array:
        """Distances (N,) [m] of visible people's tracks from their figures."""
        result = []
        for identity, track in self.tracks.items():
            seen = track[track[:, 3] == 0]
            index = np.searchsorted(self.times, seen[:, 0] - 1e-6)
            owner = self.owners(identity)
            apart = np.linalg.norm(self.truth[index, np.maximum(owner, 0)] - seen[:, 1:3], axis=1)
            result.append(apart[owner >= 0])
        return np.concatenate(result) if result else np.zeros(0)


def run(
    walks: Sequence[Walk],
    camera: Camera,
    *,
    seed: int,
    frames: int = 75,
    still: int = 25,
    settings: PeopleSettings | None = None,
) -> Trial:
    """Simulate walks at 10 Hz with ``camera``, correct the frames with it, and follow the people."""
    scene = walking_scene(walks, frames=frames, rate=RATE, still=still)
    simulation, correction = Simulation(camera, scene, seed=seed), Correction(camera)
    people = PeopleTracker(settings or PeopleSettings(ground=GROUND))
    tracks: dict[int, list[tuple[float, float, float, float]]] = {}
    times, truth, detected = [], [], []
    for i, exposure in enumerate(Timeline(scene, camera)):
        frame = simulation.frame(exposure)
        corrected = correction.correct(frame)
        found = people.take(correction.cloud(corrected), corrected.sigma, stamp=frame.stamp)
        time = (i - still) / RATE
        places = np.array([walk.position(max(time, 0.0)) for walk in walks])
        times.append(time)
        truth.append(places)
        detected.append(
            [_near(place, [detection.position for detection in people.detections]) for place in places]
        )
        for person in found:
            entry = (time, float(person.position[0]), float(person.position[1]), float(person.hidden))
            tracks.setdefault(person.identity, []).append(entry)
    return Trial(
        times=np.array(times),
        truth=np.array(truth),
        tracks={identity: np.array(entries) for identity, entries in tracks.items()},
        detected=np.array(detected),
    )


def _near(place: Array, positions: list[Array]) -> bool:
    return any(float(np.linalg.norm(position - place)) <= _BELONGS for position in positions)
