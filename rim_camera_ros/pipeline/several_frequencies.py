"""Several modulation frequencies: the chain of effects for each, and the wraps with which they agree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import FULL_SCALE, Camera
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.frame import (
    INVALID,
    CorrectedDistance,
    CorrectedFrame,
    Flag,
    Pose,
    RawFrame,
    Settings,
)
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.measurement.several_frequencies import SeveralFrequencies
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.mixed import mixed_pixels
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.pipeline.two_paths import TwoPaths
from rim_camera_ros.scene import Scene

Image = NDArray[Any]

#: Key of frame_info that states the frequencies [Hz], in the order of the images.
FREQUENCIES = "modulation_frequencies"
_MIXED = Flag.MIXED_PIXEL.value
_TUNED = 1e-3


class SeveralSimulations:
    """Simulates one distance and amplitude image for each frequency of a camera.

    Emitted power and scene are the same for all frequencies, their noise is independent. All are exposed at
    the frame's stamp. ``options``: those of `Simulation`.
    """

    def __init__(self, camera: Camera, scene: Scene, **options: Any) -> None:
        self.camera, self.scene = camera, scene
        self.notes: set[str] = set()
        first = Simulation(camera.channels[0], scene, notes=self.notes, **options)
        self.channels = [
            first,
            *(first.with_camera(channel, i) for i, channel in enumerate(camera.channels[1:], 1)),
        ]
        self._stated = " ".join(f"{channel.sensor.modulation_frequency:.10g}" for channel in camera.channels)

    def frame(self, exposure: Exposure) -> RawFrame:
        """Return one raw frame with settings and truth; its images as `RawFrame` says."""
        frames = [channel.frame(exposure) for channel in self.channels]
        settings = frames[0].settings
        extra = {**settings.extra, FREQUENCIES: self._stated}
        images = {
            f"{kind}_{i}": getattr(frame, kind)
            for i, frame in enumerate(frames[1:], 1)
            for kind in ("distance", "amplitude")
        }
        settings = replace(settings, modulation_frequency=None, extra=extra)
        return replace(frames[0], settings=settings, images=images)

    def geometry(self, poses: Mapping[str, Pose]) -> Geometry:
        """Return the geometry that the pixels see."""
        return self.channels[0].geometry(poses)

    def true_distance(self, exposure: Exposure) -> NDArray[np.float64]:
        """Return the true radial distance (H, W) in metres, NaN where nothing is seen."""
        return self.channels[0].true_distance(exposure)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedFrame(CorrectedFrame):
    """A corrected frame of several frequencies.

    ``wrong_wrap`` (H, W) float32: probability of the second most likely wraps, NaN where a frequency has no
    distance. ``two_paths`` (H, W) bool: where the distance is that of the first of two paths.
    """

    wrong_wrap: NDArray[np.float32]
    two_paths: NDArray[np.bool_] | None = None


class SeveralCorrections:
    """Corrects each frequency with its own camera, and resolves the wraps of the results.

    Terms that need the distance itself are undone once the wraps are known. Other terms are undone before, as
    the phases that are compared must be free of them. ``distance`` is the weighted mean of the distances of
    the frequencies, NaN where any of them has none. It has the flag `Flag.AMBIGUOUS` where the second most
    likely wraps are within the odds that the camera file states. Recordings with only the resolved distance
    are corrected as those of an ordinary camera.

    Raises `InputError` for an unknown name in ``without``.
    """

    def __init__(
        self, camera: Camera, *, without: Iterable[str] = (), minimum_amplitude: float | None = None
    ) -> None:
        self.camera, self.notes = camera, set[str]()
        self.measurement: SeveralFrequencies = camera.measurement
        self.without = frozenset(without)
        for name in sorted(self.without - set(camera.effects)):
            raise InputError(
                f"effect '{name}' is not in the camera file", remedy=nearest_name(name, camera.effects)
            )
        self._table = self.measurement.table(camera)
        self._least = np.float32(2 * np.log(self.measurement.odds))
        channels = [
            replace(channel, validity=replace(channel.validity, distance=None)) for channel in camera.channels
        ]
        absolute = {name for name, effect in camera.effects.items() if effect.absolute} - self.without

        def corrections(cameras: Iterable[Camera], out: Iterable[str]) -> list[Correction]:
            return [
                Correction(
                    camera, without=set(out) & set(camera.effects), minimum_amplitude=minimum_amplitude
                )
                for camera in cameras
            ]

        self._first = corrections(channels, self.without | absolute)
        self._second = (
            corrections([_beyond(channel, self._table.span[1]) for channel in channels], self.without)
            if absolute
            else None
        )
        self._ordinary = Correction(
            self.measurement.resolved(camera),
            without=self.without & set(self.measurement.resolved(camera).effects),
            minimum_amplitude=minimum_amplitude,
        )
        self._two_paths = TwoPaths(camera, self._table.span) if self.measurement.two_paths else None

    # --- public ---------------------------------------------------------------------------------

    def correct(self, frame: RawFrame) -> CorrectedFrame:
        """Return the corrected frame: `ResolvedFrame`, unless the recording holds the resolved distance.

        Raises `InputError` for a frequency without its images, and as `Correction.correct`.
        """
        frames = self.frames(frame)
        if frames is None:
            return self._ordinary.correct(frame)
        parts = self.phases(frames)
        self._collect([*self._first, *(self._second or ())])
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            resolved = self._table.resolve([part.distance for part in parts], [part.sigma for part in parts])
            distance = resolved.distance
            flags = np.bitwise_or.reduce([part.flags for part in parts]) & np.uint8(~_MIXED & 0xFF)
            if self._second is not None:
                parts = self._again(frames, parts, distance)
                flags |= np.bitwise_or.reduce([part.flags for part in parts]) & np.uint8(~_MIXED & 0xFF)
                distance = _mean(parts)
            sigma = 1 / np.sqrt(sum(1 / (part.sigma * part.sigma) for part in parts))
            amplitude = np.mean([part.amplitude for part in parts], axis=0)
            invalid = (flags & np.uint8(INVALID.value)) != 0
            flags |= (~invalid & ~(resolved.lead >= self._least)).view(np.uint8) * np.uint8(
                Flag.AMBIGUOUS.value
            )
            second_path = None
            if self._two_paths is not None:
                usable = (flags & np.uint8(INVALID.value)) == 0
                second_path = self._two_paths.correct(parts, distance, sigma, usable)
            invalid = (flags & np.uint8(INVALID.value)) != 0
            np.copyto(distance, np.nan, where=invalid)
            np.copyto(sigma, np.nan, where=invalid)
            flags |= mixed_pixels(distance, sigma).view(np.uint8) * np.uint8(_MIXED)
            limits = self.camera.validity.distance
            if limits is not None:
                outside = (distance < np.float32(limits[0])) | (distance > np.float32(limits[1]))
                flags |= outside.view(np.uint8) * np.uint8(Flag.OUTSIDE_CALIBRATION.value)
        return ResolvedFrame(
            stamp=frame.stamp,
            distance=distance,
            amplitude=amplitude.astype(np.float32, copy=False),
            sigma=sigma.astype(np.float32, copy=False),
            flags=flags,
            settings=frame.settings,
            wrong_wrap=resolved.wrong,
            two_paths=second_path,
        )

    def correct_distance(self, frame: RawFrame) -> CorrectedDistance:
        """Return the frame of `correct`: resolving wraps needs the noise of every pixel anyway."""
        return self.correct(frame)

    def cloud(
        self, frame: CorrectedDistance, *, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the organised cloud (H, W, 4) float32: x y z [m], intensity [counts]."""
        return self._ordinary.cloud(frame, out=out)

    def depth(self, frame: CorrectedDistance) -> NDArray[np.float32]:
        """Return the depth along z in metres (H, W) float32."""
        return self._ordinary.depth(frame)

    def minimum_for(self, settings: Settings) -> float:
        """Return the minimum amplitude [counts] at these settings, the greatest of all frequencies."""
        return max(correction.minimum_for(settings) for correction in self._first)

    def carry_on(self, before: Any) -> None:
        """Take over the state of another correction of this camera."""
        if isinstance(before, SeveralCorrections) and len(before._first) == len(self._first):
            mine = [*self._first, *(self._second or ())]
            for one, other in zip(mine, [*before._first, *(before._second or before._first)], strict=False):
                one.carry_on(other)

    def phases(self, frames: list[RawFrame]) -> list[CorrectedFrame]:
        """Return the distances of each frequency modulo its ambiguity range, corrected one by one."""
        return [correction.correct(its) for correction, its in zip(self._first, frames, strict=True)]

    # --- steps ----------------------------------------------------------------------------------

    def frames(self, frame: RawFrame) -> list[RawFrame] | None:
        """Return the frame of each frequency; None for a frame that holds the resolved distance only."""
        images = frame.by_role
        if "distance_0" not in images:
            return None
        stated = frame.settings.extra.get(FREQUENCIES)
        if stated is not None:
            self._check_frequencies(stated)
        roles = self.measurement.image_roles(self.camera)
        for role in roles:
            if role not in images:
                raise InputError(
                    f"a frequency without its images: there is no {role}, the camera file has "
                    f"{len(self.camera.channels)} frequencies",
                    place="sensor.modulation_frequency",
                    remedy="give the camera file of this recording",
                )
        further = [role for role in images if role.startswith("distance_") and role not in roles]
        if further:
            raise InputError(
                f"the frame has {further[-1]}, the camera file {len(self.camera.channels)} frequencies",
                place="sensor.modulation_frequency",
                remedy="give the camera file of this recording",
            )
        settings = replace(frame.settings, modulation_frequency=None)
        return [
            replace(
                frame,
                distance=images[f"distance_{i}"],
                amplitude=images[f"amplitude_{i}"],
                settings=settings,
                images={},
            )
            for i in range(len(self.camera.channels))
        ]

    def _check_frequencies(self, stated: str) -> None:
        own = [channel.sensor.modulation_frequency for channel in self.camera.channels]
        try:
            found = [float(word) for word in stated.split()]
        except ValueError:
            found = []
        if len(found) != len(own) or any(abs(a / b - 1) > _TUNED for a, b in zip(found, own, strict=True)):
            there, here = (" ".join(f"{one / 1e6:g}" for one in those) for those in (found, own))
            raise InputError(
                f"it was recorded at {there or repr(stated[:40])} MHz, the camera file says {here} MHz",
                place=f"frame_info, {FREQUENCIES}",
                remedy="give the camera file of these frequencies, in their order",
            )

    def _again(
        self, frames: list[RawFrame], parts: list[CorrectedFrame], distance: Image
    ) -> list[CorrectedFrame]:
        """Correct once more with known wraps, so that terms are evaluated at the distance itself."""
        assert self._second is not None
        result: list[CorrectedFrame] = []
        for correction, frame, part in zip(self._second, frames, parts, strict=True):
            sensor = self.camera.channels[len(result)].sensor
            period = np.float32(sensor.ambiguity)
            metres = frame.distance.astype(np.float32)
            if frame.distance.dtype.kind != "f":
                metres *= np.float32(sensor.lsb)
                metres[frame.distance == 0] = np.nan
            wrapped = part.distance + period * np.rint((distance - part.distance) / period)
            metres += period * np.rint((wrapped - metres) / period)
            result.append(correction.correct(replace(frame, distance=metres)))
        return result

    def _collect(self, corrections: Iterable[Correction]) -> None:
        for correction in corrections:
            self.notes |= correction.notes


def _mean(parts: list[CorrectedFrame]) -> Image:
    weights = [1 / (part.sigma * part.sigma) for part in parts]
    total = sum(w * part.distance for w, part in zip(weights, parts, strict=True))
    return np.asarray(total / sum(weights))


def _beyond(camera: Camera, farthest: float) -> Camera:
    """Return the camera with an ambiguity range so large that no distance up to ``farthest`` [m] wraps."""
    lsb = max(farthest + 1.0, 1.01 * camera.sensor.ambiguity) / FULL_SCALE
    return replace(camera, sensor=replace(camera.sensor, distance_lsb=lsb))
