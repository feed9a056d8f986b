"""Each effect as a curve over what it depends on, with the band that its covariance makes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_numbers
from rim_camera_ros.effects.base import Context, row_name
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Settings
from rim_camera_ros.reports.figures import Curve, Panel

Array = NDArray[Any]
#: Values over x for a camera.
Shape = Callable[[Camera, Array], Array]

_POINTS = 240
_STEP = 1e-4


def effect_panels(
    camera: Camera, paths: Sequence[str], covariance: Array, *, before: Camera | None = None
) -> list[Panel]:
    """Return a panel for each effect that is a curve, in mm, with its 1-sigma by the covariance of ``paths``.

    The camera's validity tells over which range. ``before`` adds the curves of another camera, dashed.
    """
    result = []
    for name in camera.effects:
        maker = _PANELS.get(name)
        if maker is not None:
            panel = maker(camera, _Bands(camera, paths, covariance, name), before)
            if panel is not None:
                result.append(panel)
    return result


class _Bands:
    """Curves of one effect with their 1-sigma."""

    def __init__(self, camera: Camera, paths: Sequence[str], covariance: Array, name: str) -> None:
        own = [i for i, path in enumerate(paths) if path.startswith(f"effects.{name}.")]
        self._camera = camera
        self._paths = [paths[i] for i in own]
        self._covariance = covariance[np.ix_(own, own)] if own else np.zeros((0, 0))

    def curve(
        self, x: Array, shape: Shape, label: str = "", scale: float = 1e3, *, points: bool = False
    ) -> Curve:
        y = shape(self._camera, x) * scale
        if not self._paths:
            return Curve(x, y, None, label, points=points)
        numbers = camera_numbers(self._camera)
        sigmas = np.sqrt(np.diag(self._covariance))
        slopes = []
        for path, sigma in zip(self._paths, sigmas, strict=True):
            step = max(float(sigma), _STEP * abs(numbers[path]), 1e-15) * 0.1
            slopes.append(self._slope(path, numbers[path], step, shape, x) * scale)
        jacobian = np.stack(slopes)
        variance = np.einsum("ix,ij,jx->x", jacobian, self._covariance, jacobian)
        return Curve(x, y, np.sqrt(np.maximum(variance, 0.0)), label, points=points)

    def _slope(self, path: str, value: float, step: float, shape: Shape, x: Array) -> Array:
        """Return the change of a curve by a parameter, to one side where the other is no possible camera."""
        sides = []
        for at in (value + step, value - step, value):
            with contextlib.suppress(InputError, ValueError):
                sides.append((at, shape(with_numbers(self._camera, {path: at}), x)))
        (a, upper), (b, lower) = sides[:2]
        return (upper - lower) / (a - b)


def _old(before: Camera | None, name: str, x: Array, shape: Shape, scale: float = 1e3) -> tuple[Curve, ...]:
    if before is None or name not in before.effects:
        return ()
    return (Curve(x, shape(before, x) * scale, None, "before", colour="#9aa5b1", dashed=True),)


def _context(camera: Camera, **settings: Any) -> Context:
    context = Context(camera=camera, settings=Settings(**settings))
    # curves are drawn for the principal point
    context.column = np.array(camera.optics.cx)
    context.row = np.array(camera.optics.cy)
    return context


def _distances(camera: Camera) -> Array:
    low, high = camera.validity.distance or (0.0, camera.sensor.ambiguity)
    return np.linspace(low, high, _POINTS)


def _amplitudes(camera: Camera) -> Array:
    low, high = camera.validity.amplitude or (50.0, 20000.0)
    return np.geomspace(max(low, 1.0), max(high, 2 * low, 2.0), _POINTS)


def _term(name: str, **settings: Any) -> Callable[[Camera, Array, Array], Array]:
    def value(camera: Camera, distance: Array, amplitude: Array) -> Array:
        effect: Any = camera.effects[name]
        context = _context(camera, **settings)
        return np.broadcast_to(np.asarray(effect.term(distance, amplitude, context), float), distance.shape)

    return value


def _over_distance(name: str, title: str) -> Any:
    def make(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
        x = _distances(camera)
        term = _term(name)

        def shape(one: Camera, d: Array) -> Array:
            return term(one, d, np.ones_like(d))

        old = _old(before, name, x, shape)
        return Panel(
            title, "distance [m]", "error [mm]", (bands.curve(x, shape, "after" if old else ""), *old)
        )

    return make


def _amplitude_offset(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    x = _amplitudes(camera)
    curves = []
    effect: Any = camera.effects["amplitude_offset"]
    for key in effect.hyperbola:
        term = _term("amplitude_offset", integration_time=key)
        lit = x[x > effect.hyperbola[key].b + 1]

        def shape(one: Camera, a: Array, term: Any = term) -> Array:
            return np.asarray(term(one, np.ones_like(a), a))

        curves.append(bands.curve(lit, shape, f"setting {row_name(key)}"))
    return Panel("amplitude", "amplitude [counts]", "error [mm]", tuple(curves), log=True)


def _incidence(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    effect: Any = camera.effects["incidence_angle"]
    degrees = np.linspace(0.0, 72.0, _POINTS)
    curves = []
    for key in effect.polynomial:

        def shape(one: Camera, x: Array, key: float = key) -> Array:
            context = _context(one, integration_time=key)
            # the polynomial is of gon
            return -np.asarray(_polynomial(one, context)(x / 0.9))

        curves.append(bands.curve(degrees, shape, f"setting {row_name(key)}"))
    return Panel("angle of incidence", "angle [deg]", "error [mm]", tuple(curves))


def _polynomial(camera: Camera, context: Context) -> Callable[[Array], Array]:
    effect: Any = camera.effects["incidence_angle"]
    a = effect.polynomial[context.integration_time]
    return lambda x: sum(c * x ** (4 - i) for i, c in enumerate(a))


def _warm_up(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    effect: Any = camera.effects["warm_up_drift"]
    x = np.linspace(0.0, 5 * max(one.time_constant for one in effect.terms), _POINTS)

    def shape(one: Camera, seconds: Array) -> Array:
        terms: Any = one.effects["warm_up_drift"]
        return np.asarray(sum(t.amplitude * np.exp(-seconds / t.time_constant) for t in terms.terms))

    old = _old(before, "warm_up_drift", x, shape)
    curves = (bands.curve(x / 60, lambda c, m: shape(c, m * 60), "after" if old else ""),)
    old = tuple(Curve(one.x / 60, one.y, None, one.label, colour=one.colour, dashed=True) for one in old)
    return Panel("warm-up", "time since power-on [min]", "error [mm]", curves + old)


def _ambient(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    effect: Any = camera.effects["ambient_temperature"]
    x = np.linspace(0.0, max(5 * effect.time_constant, 60.0), _POINTS)

    def shape(one: Camera, seconds: Array) -> Array:
        term: Any = one.effects["ambient_temperature"]
        if term.time_constant <= 0:
            return np.full_like(seconds, term.coefficient)
        return np.asarray(term.coefficient * (1 - np.exp(-seconds / term.time_constant)))

    curve = bands.curve(x / 60, lambda c, m: shape(c, m * 60))
    return Panel("ambient temperature, after a step of 1 °C", "time [min]", "error [mm]", (curve,))


def _setting(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    effect: Any = camera.effects["integration_time_offset"]
    x = np.array(sorted(effect.offset))

    def shape(one: Camera, keys: Array) -> Array:
        term: Any = one.effects["integration_time_offset"]
        return np.array([term.offset[float(key)] for key in keys])

    curve = bands.curve(x, shape, points=True)
    return Panel("integration time", "integration time", "error [mm]", (curve,))


def _emission(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    rays = camera.rays[..., 2]
    x = np.linspace(0.0, float(np.arccos(np.nanmin(rays))), _POINTS)

    def shape(one: Camera, angle: Array) -> Array:
        lobe: Any = one.effects["emission_pattern"]
        q = angle**2
        return np.asarray(1 + lobe.falloff[0] * q + lobe.falloff[1] * q**2)

    curve = bands.curve(np.degrees(x), lambda c, a: shape(c, np.radians(a)), scale=100.0)
    return Panel("emission pattern", "angle from the axis [deg]", "power [%]", (curve,))


def _scattering(camera: Camera, bands: _Bands, before: Camera | None) -> Panel:
    effect: Any = camera.effects["scattering"]
    reach = 2.5 * max(max(one.sigma) for one in effect.kernels)
    x = np.geomspace(0.5, max(reach, 2.0), _POINTS)

    def shape(one: Camera, radius: Array) -> Array:
        light: Any = one.effects["scattering"]
        parts = [
            k.weight * (1 - np.exp(-0.5 * radius**2 / max(k.sigma[0] * k.sigma[1], 1e-9)))
            for k in light.kernels
        ]
        return np.asarray(sum(parts))

    curve = bands.curve(x, shape, scale=100.0)
    return Panel("stray light within a radius", "radius [px]", "of the light [%]", (curve,), log=True)


def _empirical(camera: Camera, bands: _Bands, before: Camera | None) -> Panel | None:
    effect: Any = camera.effects["empirical"]
    if len(effect.covariates) != 1:
        return None
    x = np.asarray(effect.knots[0])
    name = effect.covariates[0]
    curve = Curve(x, np.asarray(effect.values.values) * 1e3)
    return Panel(f"smooth function of {name}", name, "error [mm]", (curve,), log=name == "amplitude")


_PANELS: dict[str, Any] = {
    "cyclic_error": _over_distance("cyclic_error", "cyclic error"),
    "distance_scale": _over_distance("distance_scale", "distance scale"),
    "amplitude_offset": _amplitude_offset,
    "incidence_angle": _incidence,
    "warm_up_drift": _warm_up,
    "ambient_temperature": _ambient,
    "integration_time_offset": _setting,
    "emission_pattern": _emission,
    "scattering": _scattering,
    "empirical": _empirical,
}
