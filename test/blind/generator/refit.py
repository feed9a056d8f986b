"""The known terms refitted by weighted least squares by somebody who does not know of the hidden effect."""

from dataclasses import replace

import numpy as np

from .known import Camera, Cyclic, gon, per_setting
from .sensor import Array, axis_angle_squared
from .strength import Size
from .world import World

RADIOMETRIC_SCATTER = 0.01
POSITION_SCATTER = 0.003
"""What the calibrator assumes beside noise: texture and power [-], pose and pattern [m]."""


def columns_of(camera: Camera, world: World, amplitude: Array) -> list[tuple[str, int, Array]]:
    """Derivatives of the distance by the linear parameters: name, setting, (n, height, width)."""
    told, settings = world.told, world.exposures.integration_time
    distance = np.where(told.seen, told.range, 0.0)
    columns: list[tuple[str, int, Array]] = []
    for setting in sorted(set(settings.tolist())):
        mine = per_setting({T: float(setting == T) for T in (16, 60, 100)}, settings)
        if camera.hyperbola is not None:
            columns.append(("a", setting, mine / np.maximum(amplitude - camera.hyperbola[setting][1], 1.0)))
        if camera.offset is not None:
            columns.append(("offset", setting, mine * np.ones_like(distance)))
        if camera.incidence is not None:
            columns.append(("incidence", setting, -mine * gon(told.incidence)))
    if camera.cyclic is not None:
        angle = camera.cyclic_angle(distance, camera.cyclic)
        columns += [("sine", 0, np.sin(angle)), ("cosine", 0, np.cos(angle))]
    return columns


def refit(
    world: World, distances: "np.ndarray", amplitudes: "np.ndarray", hidden: Size | None
) -> tuple[Camera, float | None]:
    """The refitted camera, and the share of the hidden effect's weighted RMS that the refit leaves.

    `distances` and `amplitudes` are counts, (n, frames, height, width).
    """
    camera = world.camera
    interval = camera.sensor.ambiguity
    delivered = (
        np.all(distances > 0, axis=1) & np.all(amplitudes < camera.saturation, axis=1) & world.told.seen
    )
    amplitude = np.maximum(amplitudes.mean(axis=1), 1.0)
    near = np.where(world.told.seen, world.told.range, 0.0)
    predicted = near + camera.metres(near, amplitude, world.told.incidence, world.exposures.integration_time)
    residual = distances / 65536.0 * interval - predicted[:, None]
    residual = (np.mod(residual + interval / 2.0, interval) - interval / 2.0).mean(axis=1)
    weight = 1.0 / (camera.sigma(amplitude) ** 2 / distances.shape[1] + POSITION_SCATTER**2)
    columns = columns_of(camera, world, amplitude)
    left = None
    if columns:
        matrix = np.stack([column for _, _, column in columns], axis=-1)
        used, solution = delivered, np.zeros(len(columns))
        for _ in range(3):
            solution = _solve(matrix[used], residual[used], weight[used])
            rest = residual - matrix @ solution
            middle = np.median(rest[used])
            spread = 1.4826 * np.median(np.abs(rest[used] - middle))
            used = delivered & (np.abs(rest - middle) < 6.0 * spread)
        camera = _moved(camera, [(name, setting) for name, setting, _ in columns], solution)
        if hidden is not None:
            there = hidden.valid & delivered
            share = _solve(matrix[there], hidden.metres[there], weight[there])
            rest = hidden.metres[there] - matrix[there] @ share
            whole = float(np.sum(weight[there] * hidden.metres[there] ** 2))
            left = float(np.sqrt(np.sum(weight[there] * rest**2) / whole)) if whole > 0.0 else None
    return _radiometry(camera, world, amplitude, delivered), left


def _radiometry(camera: Camera, world: World, amplitude: Array, delivered: "np.ndarray") -> Camera:
    """Gain and emission pattern refitted to the ratio of measured to evenly lit amplitude."""
    told = world.told
    near = np.where(told.seen, told.range, 1.0)
    settings = world.exposures.integration_time[:, None, None]
    even = camera.gain * settings * told.reflectivity * told.cosine / near**2
    ratio = amplitude / np.maximum(even, 1e-6)
    q = axis_angle_squared(world.rays)
    model = camera.pattern(q)
    used = delivered & (np.abs(ratio / model - 1.0) < 0.5)
    noise = 2.0 * np.pi / camera.sensor.ambiguity * camera.sigma(amplitude)
    weight = 1.0 / (model**2 * (noise**2 + RADIOMETRIC_SCATTER**2))
    orders = 3 if camera.falloff is not None else 1
    matrix = np.stack(
        [np.broadcast_to(q**k if camera.falloff else model, ratio.shape)[used] for k in range(orders)], 1
    )
    solution = _solve(matrix, ratio[used], weight[used])
    scale = float(solution[0])
    if camera.falloff is None:
        return replace(camera, gain=camera.gain * scale)
    return replace(
        camera,
        gain=camera.gain * scale,
        falloff=(float(solution[1]) / scale, float(solution[2]) / scale),
    )


def _solve(matrix: Array, right: Array, weight: Array) -> Array:
    """Weighted least squares by normal equations with columns scaled to 1."""
    scale = np.sqrt(np.einsum("ij,ij,i->j", matrix, matrix, weight))
    scale[scale == 0.0] = 1.0
    scaled = matrix / scale
    normal = scaled.T @ (scaled * weight[:, None])
    return np.asarray(np.linalg.lstsq(normal, scaled.T @ (weight * right), rcond=1e-10)[0] / scale)


def _moved(camera: Camera, names: list[tuple[str, int]], solution: Array) -> Camera:
    hyperbola, offset = dict(camera.hyperbola or {}), dict(camera.offset or {})
    incidence = dict(camera.incidence or {})
    cyclic = camera.cyclic
    change = {name: float(value) for name, value in zip(names, solution, strict=True)}
    for (name, setting), value in change.items():
        if name == "a":
            hyperbola[setting] = (hyperbola[setting][0] + value, hyperbola[setting][1])
        elif name == "offset":
            offset[setting] += value
        elif name == "incidence":
            a1, a2, a3, a4 = incidence[setting]
            incidence[setting] = (a1, a2, a3, a4 + value)
    if cyclic is not None:
        phasor = cyclic.amplitude + change["sine", 0] + 1j * change["cosine", 0]
        cyclic = Cyclic(float(abs(phasor)), cyclic.phase + float(np.angle(phasor)), cyclic.gradient)
    return replace(
        camera,
        hyperbola=hyperbola or None,
        offset=offset or None,
        incidence=incidence or None,
        cyclic=cyclic,
    )
