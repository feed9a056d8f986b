"""Corrected distances of a flat wall over the image: their uncertainty, and the difference of two files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects, with_numbers
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.covariate_table import LABEL, with_empirical_changes
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.frame import Pose, RawFrame, Settings
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, Surface

Array = NDArray[Any]

#: Seconds after power-on at which nothing warms up any more.
_WARM = 1e6
_REFLECTIVITY = 0.5
#: Pixels at which the uncertainty, which is smooth, is computed.
_ENOUGH = 4000


@dataclass(frozen=True)
class Wall:
    """A flat wall perpendicular to the optical axis, and the setting of the camera.

    ``distance`` along the axis [m], diffuse ``reflectivity`` [-], ``integration_time`` in the device's unit.
    The camera is warm and at its reference temperature.
    """

    distance: float
    integration_time: float | None = None
    reflectivity: float = _REFLECTIVITY


def setting_of(*cameras: Camera) -> float | None:
    """Return an integration time that all cameras have rows for, the longest; None where none states any."""
    keys = [set(_settings(camera)) for camera in cameras]
    stated = [times for times in keys if times]
    common = set.intersection(*stated) if stated else set()
    if common:
        return max(common)
    for camera in cameras:
        if camera.sensor.integration_time is not None:
            return camera.sensor.integration_time
        if camera.validity.integration_time is not None:
            return camera.validity.integration_time[1]
    return max((max(times) for times in stated), default=None)


def _settings(camera: Camera) -> list[float]:
    return [key for effect in camera.effects.values() for key in effect.rows()]


def distances_of(*cameras: Camera, count: int = 3) -> list[float]:
    """Return distances [m] over the range in which all cameras are valid, or within their ambiguity."""
    low, high = 0.15 * cameras[0].sensor.ambiguity, 0.9 * cameras[0].sensor.ambiguity
    ranges = [camera.validity.distance for camera in cameras if camera.validity.distance is not None]
    if ranges:
        inside = max(interval[0] for interval in ranges), min(interval[1] for interval in ranges)
        if inside[0] < inside[1]:
            low, high = inside
    return [float(x) for x in np.linspace(low, high, count)]


def raw_wall(camera: Camera, wall: Wall) -> RawFrame:
    """Return the measurement of a wall by a camera, without noise: distance in metres, amplitude in counts.

    Raises `InputError` where the camera needs an integration time and none is given.
    """
    steady = {name: effect for name, effect in camera.effects.items() if effect.shows_on_a_wall}
    quiet = with_effects(replace(camera, radiometry=replace(camera.radiometry, gain_sigma=0.0)), steady)
    pose = Pose((0.0, 0.0, wall.distance))
    surface = Surface("wall", "plane", ScenePose(pose.position), reflectivity=wall.reflectivity)
    simulation = Simulation(quiet, Scene((surface,)), noise=False, quantised=False)
    time = wall.integration_time
    settings = Settings(integration_time=1.0 if time is None else time, uptime=_WARM)
    return simulation.frame(Exposure(0, settings, {"wall": pose}))


def corrected_walls(camera: Camera, raw: Sequence[RawFrame]) -> Array:
    """Return corrected distances (N, H, W) [m] of N raw frames, NaN where a camera file allows none."""
    steady = {name: effect for name, effect in camera.effects.items() if effect.shows_on_a_wall}
    correction = Correction(with_effects(camera, steady), minimum_amplitude=0.0, exact=True)
    return np.stack([np.asarray(correction.correct(raw_frame).distance, float) for raw_frame in raw])


def difference(file: Camera, other: Camera, wall: Wall) -> Array:
    """Return the corrected distances of a wall by ``other`` minus those by ``file`` (H, W) [m].

    The raw frame is the measurement of the wall by ``file``; both correct it. NaN where either has none.
    Raises `InputError` where the sensors have other sizes or modulation frequencies.
    """
    same = (file.shape, file.sensor.modulation_frequency) == (other.shape, other.sensor.modulation_frequency)
    if not same:
        raise InputError(
            "the camera files are of sensors of other sizes or modulation frequencies",
            remedy="compare two files of one camera",
        )
    raw = [raw_wall(file, wall)]
    moved = corrected_walls(other, raw)[0] - corrected_walls(file, raw)[0]
    return np.asarray(wrap_residual(moved, file.sensor.ambiguity))


def uncertainty(
    camera: Camera,
    paths: Sequence[str],
    covariance: Array,
    walls: Sequence[Wall],
    *,
    pattern: Array | None = None,
) -> list[Array]:
    """Return the 1-sigma (H, W) [m] of corrected distances of each wall by the uncertainty of the camera.

    The covariance (N, N) of the parameters at dotted ``paths`` is propagated through the correction, J C J^T
    with J by differences, and the variance ``pattern`` (H, W) [m^2] of the offsets of pixels is added. It is
    the error of the calibration, which averaging frames does not reduce, like the projection uncertainty of
    mrcal for a lens model. It contains neither noise nor errors of the model. On large sensors it is computed
    at some pixels and interpolated.
    """
    step = _coarseness(camera)
    small = decimated_camera(camera, step) if step > 1 else camera
    raw = [raw_wall(small, wall) for wall in walls]
    base = corrected_walls(small, raw)
    sigmas = np.sqrt(np.diag(covariance))
    # in units of each sigma, for numerical accuracy
    scaled = covariance / sigmas[:, None] / sigmas[None, :]
    slopes = np.zeros((len(paths), *base.shape))
    for slope, path, sigma in zip(slopes, paths, sigmas, strict=True):
        slope[:] = _slopes(camera, path, float(sigma), raw, base, step)
    variances = np.einsum("inhw,ij,jnhw->nhw", slopes, scaled, slopes, optimize=True)
    variances = np.where(np.isfinite(base), np.maximum(variances, 0.0), np.nan)
    full = [_finer(variance, camera.shape) if step > 1 else variance for variance in variances]
    return [np.asarray(np.sqrt(one if pattern is None else one + pattern)) for one in full]


def _coarseness(camera: Camera) -> int:
    if any(effect.stated_by_pixels for effect in camera.effects.values()):
        return 1
    return max(1, int(np.ceil(np.sqrt(camera.sensor.width * camera.sensor.height / _ENOUGH))))


def _finer(image: Array, shape: tuple[int, int]) -> Array:
    """Return an image of a coarser grid on the full one, linear between its pixels."""
    import cv2

    return np.asarray(cv2.resize(image, shape[::-1], interpolation=cv2.INTER_LINEAR))


def _moved(camera: Camera, path: str, change: float) -> Camera:
    """Return the camera with one number changed; values of a table have no path of a camera file."""
    if path.startswith(LABEL):
        return with_empirical_changes(camera, {path: change})
    return with_numbers(camera, {path: camera_numbers(camera)[path] + change})


def _slopes(
    camera: Camera, path: str, sigma: float, raw: Sequence[RawFrame], base: Array, step: int
) -> Array:
    """Return the change of corrected distances by one sigma, to the side where the camera is valid."""
    for change in (sigma, -sigma, 0.1 * sigma, -0.1 * sigma):
        try:
            moved = _moved(camera, path, change)
        except (InputError, ValueError):
            continue
        other = corrected_walls(decimated_camera(moved, step) if step > 1 else moved, raw)
        shift = wrap_residual(other - base, camera.sensor.ambiguity)
        return np.asarray(np.nan_to_num(shift) * (sigma / change))
    return np.zeros_like(base)
