"""A diagnosis of every k-th pixel, told in pixels of the whole sensor."""

from __future__ import annotations

from dataclasses import replace

from rim_camera_ros.calibrate.coarser import finer_camera, finer_image, finer_number
from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.result import Diagnosis, Missing


def on_full_grid(result: Diagnosis, camera: Camera, step: int) -> Diagnosis:
    """Restate a diagnosis of every ``step``-th pixel for the ``camera`` of all of them; in place."""
    small, full = result.camera, finer_camera(result.camera, camera, step)
    result.missing = [_missing(one, small, full, step) for one in result.missing]
    result.adjusted = [_adjusted(one, step) for one in result.adjusted]
    result.looked_at, result.camera = small, full
    result.where = replace(result.where, pixels=finer_image(result.where.pixels, camera.shape, step))
    result.notes.append(f"of every {step} x {step} pixels one was looked at")
    return result


def _missing(one: Missing, small: Camera, full: Camera, step: int) -> Missing:
    prefix = _prefix(one.effect, small)
    low_and_high = {
        path: (finer_number(prefix + path, low, step), finer_number(prefix + path, high, step))
        for path, (low, high) in one.interval.items()
    }
    values = {path: finer_number(prefix + path, value, step) for path, value in one.parameters.items()}
    sentence = one.sentence
    if one.effect in small.effects:
        sentence = sentence.replace(small.effects[one.effect].sentence(), full.effects[one.effect].sentence())
    return replace(one, parameters=values, interval=low_and_high, sentence=sentence)


def _adjusted(one: Adjusted, step: int) -> Adjusted:
    def told(values: dict[str, float]) -> dict[str, float]:
        return {path: finer_number(f"effects.{one.effect}.{path}", v, step) for path, v in values.items()}

    return Adjusted(one.effect, told(dict(one.before)), told(dict(one.after)))


def _prefix(name: str, camera: Camera) -> str:
    return f"effects.{name}." if name in camera.effects else "optics."
