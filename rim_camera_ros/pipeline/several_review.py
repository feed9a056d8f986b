"""Several frequencies compared with true poses: offsets between frequencies, and wrong wraps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import PixelMap, SettingOffset
from rim_camera_ros.effects.base import effect_of
from rim_camera_ros.frame import INVALID, Flag, RawFrame
from rim_camera_ros.geometry import see
from rim_camera_ros.measurement import Change
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.pipeline.several_frequencies import ResolvedFrame, SeveralCorrections
from rim_camera_ros.scene import Scene

Image = NDArray[Any]

#: Most poses that are used.
_POSES = 40
#: Standard deviations up to which a result may be due to chance.
_CHANCE = 5.0
#: Offset [m] of a frequency below which nothing is changed.
_LEAST = 0.001
#: A key is dropped only if the share of wrong wraps falls at least to this fraction.
_FEWER = 0.1


@dataclass(frozen=True)
class _Seen:
    frame: RawFrame
    truth: Image


def review(camera: Camera, frames: Iterable[RawFrame], scene: Scene) -> tuple[Camera, list[Change]]:
    """Return the camera without statements that true poses contradict, and the changes.

    An offset that is the same at all poses but differs from that of other frequencies cannot come from the
    set-up, which all share. It is added to the offsets of that frequency in the camera file. ``wraps`` and
    ``range`` are dropped where more wraps are wrong than their probabilities allow, and fewer are wrong
    without these keys, by the frequencies alone.
    """
    seen: dict[Any, _Seen] = {}
    for frame in frames:
        key = tuple(sorted(frame.pose_stamps.items()))
        if key not in seen and len(seen) < _POSES and "distance" not in frame.by_role:
            seen[key] = _Seen(frame, see(scene, scene.poses_for(frame.truth), camera.rays).distance)
    if not seen:
        return camera, []
    camera, changes = _without_offsets(camera, [*seen.values()], scene)
    camera, further = _without_wrong_wraps(camera, [*seen.values()])
    return camera, changes + further


# --- offsets ------------------------------------------------------------------------------------


def _without_offsets(camera: Camera, seen: Sequence[_Seen], scene: Scene) -> tuple[Camera, list[Change]]:
    correction = SeveralCorrections(camera)
    periods = [channel.sensor.ambiguity for channel in camera.channels]
    found = np.full((len(seen), len(periods)), np.nan)
    for row, view in zip(found, seen, strict=True):
        parts = correction.phases(correction.frames(view.frame) or [])
        for i, (part, period) in enumerate(zip(parts, periods, strict=True)):
            apart = wrap_residual(part.distance - view.truth, period)
            # around the mean direction, as an offset may be near half the range
            turn = np.exp(2j * np.pi / period * apart[np.isfinite(apart)])
            row[i] = np.angle(turn.mean()) * period / (2 * np.pi) if turn.size else np.nan
    mean = np.nanmean(found, axis=0)
    spread = np.nanstd(found, axis=0, ddof=1) / np.sqrt(len(seen)) if len(seen) > 2 else np.inf
    poses = max(surface.pose_sigma[0] for surface in scene.surfaces)
    apart = mean - np.array([np.median(np.delete(mean, i)) for i in range(len(mean))])
    far = np.maximum(_LEAST, _CHANCE * np.hypot(spread, poses))
    channels, changes = list(camera.channels), list[Change]()
    for i, part in enumerate(camera.measurement.parts(camera)):
        if abs(mean[i]) > far[i] and abs(apart[i]) > far[i]:
            moved = _with_offset(channels[i], float(mean[i]), part.name)
            if moved is not None:
                channels[i], name, before = moved
                after = {key: value + float(mean[i]) for key, value in before.items()}
                changes.append(Change(name, part.name, before, after))
    return camera.measurement.camera_of(tuple(channels)) if changes else camera, changes


def _with_offset(camera: Camera, metres: float, part: str) -> tuple[Camera, str, dict[str, float]] | None:
    """Return the camera with its own offset longer by so much, its name and what it was; None without one."""
    effects = dict(camera.effects)
    pattern, times = effect_of(camera, PixelMap), effect_of(camera, SettingOffset)
    if pattern is not None:
        values = (pattern.map.values + np.float32(metres)).astype(np.float32)
        name, before = pattern.name, {"mean": float(np.mean(pattern.map.values))}
        # another frequency may have the file as it was
        file = f"{pattern.map.file.removesuffix('.npy')}.{part}.npy"
        effects[name] = replace(pattern, map=ArrayFile(file, values))
    elif times is not None:
        name = times.name
        before = {f"offset.{key:g}": value for key, value in times.offset.items()}
        rows = {key: value + metres for key, value in times.offset.items()}
        effects[name] = replace(times, offset=MappingProxyType(rows))
    else:
        return None
    return replace(camera, effects=MappingProxyType(effects)), name, before


# --- wraps --------------------------------------------------------------------------------------


def _without_wrong_wraps(camera: Camera, seen: Sequence[_Seen]) -> tuple[Camera, list[Change]]:
    wrong, allowed = _wrong_wraps(camera, seen)
    given = [key for key in ("wraps", "range") if getattr(camera.measurement, key) is not None]
    tried = [[key] for key in given] + ([given] if len(given) > 1 else [])
    for keys in tried if wrong > allowed else ():
        other = replace(camera, measurement=replace(camera.measurement, **dict.fromkeys(keys)))
        fewer, allowed = _wrong_wraps(other, seen)
        if fewer <= max(allowed, _FEWER * wrong):
            changes = [Change(key, "", {key: getattr(camera.measurement, key)}, {key: None}) for key in keys]
            return other, changes
    return camera, []


def _wrong_wraps(camera: Camera, seen: Iterable[_Seen]) -> tuple[int, float]:
    """Return the number of pixels with wrong or no wraps, and the greatest number that chance explains."""
    correction = SeveralCorrections(camera)
    least = min(channel.sensor.ambiguity for channel in camera.channels)
    wrong, expected = 0, 0.0
    # pixels without wraps in the span are flagged as not measured; raw images show which were measured
    dark = np.uint8((INVALID & ~Flag.AMBIGUOUS & ~Flag.NO_MEASUREMENT).value)
    for view in seen:
        found = correction.correct(view.frame)
        assert isinstance(found, ResolvedFrame)
        usable = np.isfinite(view.truth) & ((found.flags & dark) == 0)
        for its in correction.frames(view.frame) or ():
            usable &= its.distance > 0
        flagged = usable & ((found.flags & np.uint8(Flag.AMBIGUOUS.value)) != 0)
        away = usable & ~flagged & ~(np.abs(found.distance - view.truth) < least / 2)
        wrong += int(away.sum())
        expected += float(np.nansum(np.where(usable & ~flagged, found.wrong_wrap, 0.0)))
    return wrong, expected + _CHANCE * np.sqrt(expected + 1.0)
