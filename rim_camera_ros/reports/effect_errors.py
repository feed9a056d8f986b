"""The error of each effect in the camera file before, and its uncertainty now, over the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import OPTICS
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.select.effect_sizes import change_by, contribution

Array = NDArray[Any]

#: Most stations that are used, evenly chosen.
_MOST_STATIONS = 24


@dataclass(frozen=True)
class EffectError:
    """An effect's share of the error of distances [m] (1-sigma, RMS over the recordings, less its mean).

    ``size`` is the contribution of the effect to the distances, ``before`` the error of that in the camera
    file before, ``after`` its uncertainty by the covariance, NaN where no parameter of it was determined.
    """

    size: float
    before: float
    after: float


def effect_errors(result: Calibration) -> dict[str, EffectError]:
    """Return the errors of every effect of the new camera that moves distances, by its name.

    Means over all distances are subtracted, as the offsets of pixels absorb them.
    """
    fitted = result.solution.fit
    new = fitted.forward
    step = max(1, round(result.before.sensor.width / fitted.camera.sensor.width))
    start = result.before if step == 1 else decimated_camera(result.before, step)
    old = fitted.by_another(start)
    old.margins = new.margins
    paths, covariance = result.solution.covariance()
    names = [n for n, effect in fitted.camera.effects.items() if effect.estimated in ("joint", "covariates")]
    names += [name for name in OPTICS if any(path.startswith("optics.") for path in paths)]
    every = max(1, len(new.dataset.stations) // _MOST_STATIONS)
    sums = {name: _Sums(name, paths, covariance) for name in names}
    pairs = zip(old.predictions(slopes=True, every=every), new.predictions(every=every), strict=True)
    for before, after in pairs:
        for effect_sums in sums.values():
            effect_sums.add(before, after, start)
    return {name: effect_sums.error() for name, effect_sums in sums.items() if effect_sums.count}


class _Sums:
    """Sums over pixels of an effect's size, its change, and its derivatives."""

    def __init__(self, name: str, paths: Sequence[str], covariance: Array) -> None:
        lead = f"effects.{name}."
        own = [i for i, path in enumerate(paths) if path.startswith(lead)]
        self._name = name
        self._paths = [paths[i].removeprefix(lead) for i in own]
        self._covariance = covariance[np.ix_(own, own)]
        self.count = 0
        self._first = np.zeros(2 + len(own))
        self._second = np.zeros((2 + len(own),) * 2)

    def add(self, before: Prediction, after: Prediction, start: Camera) -> None:
        old: Array = np.zeros(after.used.shape)
        if self._name in OPTICS:
            # the contribution of the optics is already their change
            size = contribution(after, self._name, start)
        else:
            size = change_by(after, self._name)[0]
            if self._name in start.effects:
                old = change_by(before, self._name)[0]
        columns: list[Any] = [size, size - old]
        if self._paths:
            slopes = after.columns(after.context.camera.effects[self._name])
            columns += [slopes[path][0] if path in slopes else 0.0 for path in self._paths]
        used = after.used & np.isfinite(size + old)
        rows = np.stack([np.nan_to_num(np.broadcast_to(column, used.shape)[used]) for column in columns])
        self.count += int(used.sum())
        self._first += rows.sum(axis=1)
        self._second += rows @ rows.T

    def error(self) -> EffectError:
        mean = self._first / self.count
        products = self._second / self.count - np.outer(mean, mean)
        uncertain = float(np.sum(products[2:, 2:] * self._covariance))
        return EffectError(
            size=float(np.sqrt(max(products[0, 0], 0.0))),
            before=float(np.sqrt(max(products[1, 1], 0.0))),
            after=float(np.sqrt(max(uncertain, 0.0))) if self._paths else float("nan"),
        )
