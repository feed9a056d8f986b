"""The part of the array in which the scene was measured, where that is a small one.

A board held by hand covers a twentieth of a large sensor. Light is computed of the whole array, as it may
spread; what is measured of it is compared within the window around the board alone. The numbers are the same,
but for derivatives by light that spreads: these are without light that changes where the scene has a surface
of which nothing was measured.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.effects.signal import Signal, Window
from rim_camera_ros.fit.data import Station
from rim_camera_ros.fit.light import Light
from rim_camera_ros.fit.prediction import Prediction
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
    return replace(
        light,
        context=context,
        before={name: _within(signal, window) for name, signal in light.before.items()},
        delivered=_within(light.delivered, window),
        nameless=light.nameless[window],
        undescribed=undescribed,
    )


def _within(signal: Signal, window: Window) -> Signal:
    images = {name: value[window] for name, value in vars(signal).items() if np.ndim(value) == 2}
    return replace(signal, **images)


def on_whole_array(inner: Prediction, station: Station, view: View, light: Light) -> Prediction:
    """Return the prediction of a window as one of all pixels, which keeps that of the window.

    ``light`` is that of the whole array. The columns of the pose are those of the view, without waves of
    correlated errors: `Prediction.inner` has all of them.
    """
    window = inner.context.window
    assert window is not None
    shape = view.geometry.distance.shape

    def put(name: str) -> Any:
        values = getattr(inner, name)
        if np.ndim(values) < 2:
            return values
        result = np.full(shape, _NOTHING.get(name, np.nan), np.asarray(values).dtype)
        result[window] = values
        return result

    delivered = Signal(light.delivered.distance, light.delivered.amplitude.copy())
    delivered.amplitude[window] = inner.delivered.amplitude
    return replace(
        inner,
        **{name: put(name) for name in _IMAGES},
        station=station,
        view=view,
        context=light.context,
        before=light.before,
        delivered=delivered,
        undescribed=light.undescribed,
        pose_columns=view.pose_columns,
        of_window=inner,
        _images={},
        _changes={},
        _by_light=None,
    )
