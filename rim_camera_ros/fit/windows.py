"""The part of the array in which the scene was measured, where that is a small one.

A board held by hand covers a twentieth of a large sensor. Outside of it there is nothing to compare, so that
what acts on each pixel by itself is computed within the window around it alone. The numbers are the same.
Light that spreads is computed of the whole array, its derivatives within the window: they are without light
that changes where the scene has a surface but the camera measured nothing, and exact where it has none.
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
from rim_camera_ros.fit.light import Light
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.undescribed import sees_nothing_described, with_measured_light
from rim_camera_ros.fit.views import LARGEST_WINDOW, View
from rim_camera_ros.geometry import Geometry

Array = NDArray[Any]

#: Pixels of which the sides of windows are multiples: effects keep what they need for images of one size.
_STEP = 8

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


def window_of(view: View, measured: tuple[Array, Array], *, margin: int = 0) -> Window | None:
    """Return the rows and columns in which the scene was measured; None where they are most of the array.

    ``measured`` are those with a measurement, as `Dataset.measured`. Where the array has them, ``margin``
    pixels around are included. Few sizes occur.
    """
    hit = view.geometry.hit
    sides = [np.flatnonzero(hit.any(axis=axis) & seen) for axis, seen in zip((1, 0), measured, strict=True)]
    if not all(side.size for side in sides):
        return None
    rows, columns = (_around(side, margin, size) for side, size in zip(sides, hit.shape, strict=True))
    covered = (rows.stop - rows.start) * (columns.stop - columns.start)
    return (rows, columns) if covered <= LARGEST_WINDOW * hit.size else None


def _around(side: Array, margin: int, size: int) -> slice:
    """Return the numbers from first to last of a ``side`` (N,) with a margin, multiples of `_STEP`."""
    first, last = max(int(side[0]) - margin, 0), min(int(side[-1]) + margin + 1, size)
    number = min(-(-(last - first) // _STEP) * _STEP, size)
    first = min(first, size - number)
    return slice(first, first + number)


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


def light_within(light: Light, view: View, window: Window) -> Light:
    """Return the light of a window, of whose pixels ``view`` is, from that of the whole array.

    The images before and after what spreads light remain those of the whole array.
    """
    around = light.context.geometry_at

    def geometry_at(seconds: float) -> tuple[Geometry, Array]:
        # where there are windows nothing moves
        assert around is not None
        return view.geometry, around(seconds)[1][window]

    context = replace(
        light.context,
        geometry=view.geometry,
        geometry_at=geometry_at,
        incidence=view.geometry.incidence,
        saturated=None if light.context.saturated is None else light.context.saturated[window],
        window=window,
    )
    undescribed = light.undescribed
    if undescribed is not None:
        images = {name: getattr(undescribed, name)[window] for name in ("image", "nameless", "outside")}
        undescribed = replace(undescribed, **images)
    return Light(
        context,
        {name: _within(signal, window) for name, signal in light.before.items()},
        _within(light.delivered, window),
        light.nameless[window],
        undescribed,
        light.spread,
    )


def _within(signal: Signal, window: Window) -> Signal:
    images = {name: value[window] for name, value in vars(signal).items() if np.ndim(value) == 2}
    return replace(signal, **images)


def put(values: Any, window: Window, shape: tuple[int, ...], nothing: float | bool = np.nan) -> Any:
    """Return the images of a window as those of an array of a ``shape``, with ``nothing`` around it."""
    if np.ndim(values) < 2:
        return values
    result = np.full(shape, nothing, np.asarray(values).dtype)
    result[window] = values
    return result


def on_whole_array(
    inner: Prediction, station: Station, view: View, around: Light | None = None
) -> Prediction:
    """Return the prediction of a window as one of all pixels, which keeps that of the window.

    ``around`` is the light of the whole array (None: it was computed within the window alone). The columns of
    the pose are those of the view, without waves of correlated errors: `Prediction.inner` has all of them.
    """
    window = inner.context.window
    assert window is not None
    shape = view.geometry.distance.shape
    images = {name: put(getattr(inner, name), window, shape, _NOTHING.get(name, np.nan)) for name in _IMAGES}
    if around is not None:
        delivered = around.delivered
        delivered = Signal(delivered.distance, delivered.amplitude.copy())
        delivered.amplitude[window] = inner.delivered.amplitude
        return replace(
            inner,
            **images,
            station=station,
            view=view,
            context=around.context,
            before=around.before,
            delivered=delivered,
            undescribed=around.undescribed,
            pose_columns=view.pose_columns,
            of_window=inner,
            _images={},
            _changes={},
            _by_light=None,
        )

    def light(signal: Signal) -> Signal:
        dark = (np.nan, 0.0, np.nan, 0.0)
        parts = (signal.distance, signal.amplitude, signal.offset, signal.published)
        return Signal(*(put(part, window, shape, none) for part, none in zip(parts, dark, strict=True)))

    def geometry_at(seconds: float) -> tuple[Geometry, Array]:
        # where there are windows nothing moves
        assert inner.context.geometry_at is not None
        return view.geometry, put(inner.context.geometry_at(seconds)[1], window, shape, 0.0)

    context = replace(
        inner.context,
        geometry=view.geometry,
        geometry_at=geometry_at,
        incidence=put(inner.context.incidence, window, shape),
        saturated=station.saturated > 0,
        window=None,
    )
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
