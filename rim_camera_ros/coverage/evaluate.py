"""The parameters that stations determine, by the equations of a plan, and the station that would add most."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.plan import (
    NARROWED,
    blocks_of,
    narrowing,
    planned_station,
    planning_camera,
    with_expected_light,
)
from rim_camera_ros.camera import Camera
from rim_camera_ros.coverage.proposals import Proposal, proposals
from rim_camera_ros.effects import registry
from rim_camera_ros.effects.candidate import Block, priors_of
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.decimation import decimated_dataset
from rim_camera_ros.fit.fold_sums import Fold
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import NormalEquations, accumulate, reduce_folds
from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.scene import Scene

Array = NDArray[Any]

#: Number of the recording of proposed stations: the next after the one that is being made.
_PROPOSED = 1
#: Number of classes in the picture, of distance (up to the ambiguity range) and amplitude (powers of two
#: counts).
DISTANCE_CLASSES, AMPLITUDE_CLASSES = 24, 16


@dataclass(frozen=True)
class Next:
    """The station that would add the most, in words, and the factors of effects before and after it."""

    words: str
    raised: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Coverage:
    """The parameters that the stations determine.

    ``factors`` by effect: by how much the data narrow its parameters; from `NARROWED` on it counts as
    determined. ``seen`` (H, W): number of stations in which each pixel of the coarse grid was used;
    ``readings`` (`DISTANCE_CLASSES`, `AMPLITUDE_CLASSES`): number of pixels by distance and amplitude.
    ``next``: None where no station of this scene would determine more. ``moved`` [m]: change of the last
    station's distances from frame to frame, by a tilt, at the rim of the array; None if it was at rest.
    """

    stations: int
    frames: int
    factors: Mapping[str, float]
    seen: Array
    readings: Array
    last: str
    moved: float | None
    next: Next | None

    @property
    def determined(self) -> dict[str, float]:
        """The effects that are determined, with their factors."""
        return {name: factor for name, factor in self.factors.items() if factor >= NARROWED}

    @property
    def open(self) -> dict[str, float]:
        """The effects that are not determined, with their factors."""
        return {name: factor for name, factor in self.factors.items() if factor < NARROWED}

    def lines(self) -> list[str]:
        """Return the state in words, a line each."""
        rest = "at rest" if self.moved is None else f"NOT at rest: {self.moved * 1e3:.2g} mm; repeat it"
        lines = [f"station {self.stations}: {self.last}, {rest}"]
        lines.append(f"  determined: {_list(self.determined) or 'nothing yet'}")
        if self.open:
            lines.append(f"  not yet (below x{NARROWED:g}): {_list(self.open)}")
        if self.next is not None:
            raised = ", ".join(f"{name} x{a:.2g} to x{b:.2g}" for name, (a, b) in self.next.raised.items())
            lines.append(f"  next: {self.next.words} ({raised})")
        elif self.open:
            name = min(self.open, key=lambda one: self.open[one])
            lines.append("  next: nothing in this scene adds more" + _elsewhere(name))
        return lines


def _list(factors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} x{one:.2g}" for name, one in sorted(factors.items(), key=lambda i: -i[1]))


def _elsewhere(name: str) -> str:
    effect = registry().get(name)
    return "" if effect is None else f"; {name} needs another recording: {effect.observable}"


class Evaluator:
    """Keeps the stations of a recording on the coarse grid of plans and evaluates them."""

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self.scene = scene
        self.camera, self.step = planning_camera(camera)
        self._stations: list[Station] = []
        self._seen: dict[int, Array] = {}
        self._readings = np.zeros((DISTANCE_CLASSES, AMPLITUDE_CLASSES), np.int64)
        self._drawn = 0
        self._kinds: Any = None
        self._blocks: list[Block] = []
        self._offered: dict[str, Fold] = {}

    def add(self, station: Station) -> bool:
        """Add a station, given on all pixels; False if it lacks the pose of a surface."""
        if any(name not in station.truth for name in self.scene.needs_truth):
            return False
        small = decimated_dataset(Dataset([station]), self.step).stations[0] if self.step > 1 else station
        self._stations.append(replace(small, recording=0))
        return True

    def evaluate(self, *, moved: float | None = None) -> Coverage:
        """Return the coverage by the stations so far; there must be at least one.

        ``moved`` [m]: as in `Coverage`.
        """
        stations = list(self._stations)
        last = stations[-1]
        offered = proposals(self.scene, self.camera, last)
        real = Dataset(stations, decimation=self.step)
        self._choose_blocks(stations, offered)
        equations = self._accumulated(real, self.scene, self.camera)
        priors = priors_of(equations.regressors)

        def factors(*folds: Fold) -> dict[str, float]:
            kept = [*equations.folds, *folds]
            return narrowing(equations.regressors, reduce_folds(kept, priors, equations.pixels).gram)

        now = factors()
        self._draw(stations)
        return Coverage(
            stations=len({station.pose for station in stations}),
            frames=sum(station.frames for station in stations),
            factors=now,
            seen=np.sum(list(self._seen.values()), axis=0),
            readings=self._readings.copy(),
            last=self._words(last),
            moved=moved,
            next=_best(now, offered, [factors(self._fold(proposal, last)) for proposal in offered]),
        )

    def _choose_blocks(self, stations: Sequence[Station], offered: Sequence[Proposal]) -> None:
        """Choose the regressors anew where there is another setting or another temperature than before."""
        settings = [station.settings for station in stations] + [proposal.settings for proposal in offered]
        kinds = {
            (self.camera.integration_time(setting), setting.uptime is None, setting.ambient_temperature)
            for setting in settings
        }
        if kinds == self._kinds:
            return
        last = stations[-1]
        planned = [
            # only for their settings: brightness is that of the recorded stations
            replace(self._planned(proposal, last, number), count=np.zeros_like(last.count))
            for number, proposal in enumerate(offered)
        ]
        self._blocks = blocks_of(self.camera, Dataset([*stations, *planned], decimation=self.step))
        self._kinds, self._offered = kinds, {}

    def _fold(self, proposal: Proposal, last: Station) -> Fold:
        """Return the sums of a proposed station; for other poses they do not change during a recording."""
        if proposal.lasting and proposal.words in self._offered:
            return self._offered[proposal.words]
        planned = Dataset([self._planned(proposal, last, 0)], decimation=self.step)
        scene = proposal.scene or self.scene
        # an error of the target's reflectivity acts on its light like the emitter's power at a pose
        varies = math.hypot(self.camera.radiometry.gain_sigma, proposal.light_sigma)
        camera = replace(self.camera, radiometry=replace(self.camera.radiometry, gain_sigma=varies))
        expected = with_expected_light(planned, scene, camera)
        fold = self._accumulated(expected, scene, camera).folds[0]
        self._offered[proposal.words] = fold
        return fold

    def _accumulated(self, dataset: Dataset, scene: Scene, camera: Camera) -> NormalEquations:
        """Return sums of stations over all pixels, as proposed stations use other pixels than others."""
        every = np.ones(camera.shape, bool).ravel()
        return accumulate(Forward(dataset, scene, camera), self._blocks, seen=every)

    def _planned(self, proposal: Proposal, last: Station, number: int) -> Station:
        return planned_station(
            self.camera,
            recording=_PROPOSED,
            pose=number,
            frames=last.frames,
            stamp=last.stamp + round((proposal.wait + 10.0) * NANOSECONDS),
            time=last.time + proposal.wait + 10.0,
            settings=proposal.settings,
            truth=proposal.truth,
        )

    def _draw(self, stations: Sequence[Station]) -> None:
        """Count the pixels that new stations used, by place and by distance and amplitude."""
        new = Dataset(list(stations[self._drawn :]), decimation=self.step)
        self._drawn = len(stations)
        for prediction in Forward(new, self.scene, self.camera).predictions(slopes=False):
            used = prediction.used
            self._seen[prediction.station.pose] = used | self._seen.get(
                prediction.station.pose, np.zeros_like(used)
            )
            distance = prediction.station.distance[used] / self.camera.sensor.ambiguity * DISTANCE_CLASSES
            amplitude = np.log2(np.maximum(prediction.station.amplitude[used], 1.0))
            at = [
                np.clip(values.astype(int), 0, number - 1)
                for values, number in ((distance, DISTANCE_CLASSES), (amplitude, AMPLITUDE_CLASSES))
            ]
            np.add.at(self._readings, (at[0], at[1]), 1)

    def _words(self, station: Station) -> str:
        lit = station.count > 0
        if not lit.any():
            return f"{station.frames} frames without a distance"
        low, middle, high = np.percentile(station.amplitude[lit], [5, 50, 95])
        distance = float(np.median(station.distance[lit]))
        return (
            f"{distance:.2f} m, {low:.0f} to {high:.0f} counts (median {middle:.0f}), "
            f"integration time {self.camera.integration_time(station.settings):g}, {station.frames} frames"
        )


def _best(
    now: Mapping[str, float], offered: Sequence[Proposal], after: Sequence[dict[str, float]]
) -> Next | None:
    """Return the proposal with the largest sum of logarithms of factors, each counted up to `NARROWED`."""

    def worth(factors: Mapping[str, float]) -> float:
        return sum(float(np.log(min(factor, NARROWED))) for factor in factors.values())

    if not offered:
        return None
    best = max(range(len(offered)), key=lambda number: worth(after[number]))
    raised = {
        name: (one, after[best][name])
        for name, one in now.items()
        if one < NARROWED and after[best][name] >= one * _WORTH_WHILE
    }
    return Next(offered[best].words, raised) if raised else None


#: Least factor by which a station must narrow an effect's parameters to be proposed.
_WORTH_WHILE = 1.1
