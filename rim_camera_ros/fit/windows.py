"""The part of the array in which rays meet the scene, where that is a small one.

A board held by hand covers a twentieth of a large sensor. Outside of it there is nothing to predict, so that
what acts on each pixel by itself is computed within the window around it alone. The numbers are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.chain import Chain
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.signal import Signal, Window
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.undescribed import sees_nothing_described, with_measured_light
from rim_camera_ros.fit.views import View
from rim_camera_ros.geometry import Geometry

Array = NDArray[Any]

#: Share of the array up to which a window is computed alone. Its images are put back, so that a hundredth of
#: 176 x 144 pixels still takes 1.3 ms where all of them take 2.3 (no effects); derivatives are not put back.
_LARGEST = 0.5

#: What images of a prediction are where nothing is seen; NaN those that are not named.
_NOTHING: dict[str, float | bool] = {
    "amplitude": 1.0,
    "amplitude_share": 1.0,
    "amplitude_freedom": 0.0,
    "used": False,
    "amplitude_used": False,
    "slope_distance": 1.0,
    "slope_amplitude": 0.0,
    "slope_published": 1.0,
    "model_amplitude": 1.0,
    "model_reading": 1.0,
    "model_slope": 0.0,
    "pixel_gain": 1.0,
    "amplitude_follows": 1.0,
    "amplitude_measured": 0.0,
}
_IMAGES = (
    *_NOTHING,
    "distance",
    "residual",
    "amplitude_residual",
    "sigma",
    "amplitude_sigma",
    "amplitude_noise",
)


def window_of(view: View) -> Window | None:
    """Return the rows and columns in which rays meet the scene; None where they are most of the array."""
    hit = view.geometry.hit
    sides = [np.flatnonzero(hit.any(axis=axis)) for axis in (1, 0)]
    if not sides[0].size:
        return None
    rows, columns = (slice(int(side[0]), int(side[-1]) + 1) for side in sides)
    covered = (rows.stop - rows.start) * (columns.stop - columns.start)
    return (rows, columns) if covered <= _LARGEST * hit.size else None


def view_within(view: View, window: Window) -> View:
    """Return what the pixels of a window see.

    The view does not keep it: the two would refer to each other, and a view that nobody needs any more would
    stay in memory until the next search for such cycles.
    """
    return View(
        _geometry_within(view.geometry, window),
        view.clean[window],
        view.poses,
        [
            replace(column, distance=column.distance[window], amplitude=column.amplitude[window])
            for column in view.pose_columns
        ],
        whole=view,
        window=window,
    )


def _geometry_within(geometry: Geometry, window: Window) -> Geometry:
    names = ("surface", "distance", "points", "normals", "cos_incidence", "reflectivity", "tile")
    return replace(geometry, **{name: getattr(geometry, name)[window] for name in names})


def on_whole_array(inner: Prediction, station: Station, view: View) -> Prediction:
    """Return the prediction of a window as one of all pixels, which keeps that of the window.

    Its columns of the pose are those of the view, without waves of correlated errors: `Prediction.inner` has
    all of them.
    """
    window = inner.context.window
    assert window is not None
    shape = view.geometry.distance.shape

    def put(values: Any, nothing: float | bool = np.nan) -> Any:
        if np.ndim(values) < 2:
            return values
        result = np.full(shape, nothing, np.asarray(values).dtype)
        result[window] = values
        return result

    def light(signal: Signal) -> Signal:
        return Signal(
            put(signal.distance), put(signal.amplitude, 0.0), put(signal.offset), put(signal.published, 0.0)
        )

    def geometry_at(seconds: float) -> tuple[Geometry, Array]:
        # where there are windows nothing moves
        assert inner.context.geometry_at is not None
        return view.geometry, put(inner.context.geometry_at(seconds)[1], 0.0)

    context = replace(
        inner.context,
        geometry=view.geometry,
        geometry_at=geometry_at,
        incidence=put(inner.context.incidence),
        saturated=station.saturated > 0,
        window=None,
    )
    images = {name: put(getattr(inner, name), _NOTHING.get(name, np.nan)) for name in _IMAGES}
    return replace(
        inner,
        **images,
        station=station,
        view=view,
        context=context,
        before={name: light(signal) for name, signal in inner.before.items()},
        delivered=light(inner.delivered),
        pose_columns=view.pose_columns,
        of_window=inner,
        _images={},
        _changes={},
        _by_light=None,
    )


def surrounded(
    predicted: Prediction,
    *,
    chain: Chain,
    light: Callable[[Station, Array], Array],
    effects: Sequence[Effect],
) -> Prediction:
    """Return a prediction of a window with the measured light around it, which effects may spread.

    ``light`` is as in `with_measured_light`; ``effects`` are those of the ``chain`` that act after light has
    spread.
    """
    station, context = predicted.station, predicted.context
    if not sees_nothing_described(station, context).any():
        return predicted
    none = np.zeros(station.count.shape, bool)

    def around(signal: Signal) -> Signal:
        return with_measured_light(signal, station, context, chain=chain, light=light, nameless=none)[0]

    before = {effect.name: around(predicted.before[effect.name]) for effect in effects}
    return replace(predicted, before=predicted.before | before, delivered=around(predicted.delivered))
