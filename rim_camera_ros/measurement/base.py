"""The interface of a way of measuring, and the ordinary one: distance and amplitude at one frequency."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import CorrectedDistance, CorrectedFrame, RawFrame, Settings
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.noise import NoiseFactors
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.scene import Scene

if TYPE_CHECKING:
    from rim_camera_ros.pipeline.simulate import Exposure


class FrameSimulation(Protocol):
    """Makes raw frames of a scene; `rim_camera_ros.pipeline.simulate.Simulation` is the ordinary one."""

    camera: Camera
    scene: Scene
    notes: set[str]

    def frame(self, exposure: Exposure) -> RawFrame:
        """Return one raw frame with settings and truth."""

    def geometry(self, poses: Mapping[str, Any]) -> Geometry:
        """Return the geometry that the pixels see."""

    def true_distance(self, exposure: Exposure) -> NDArray[np.float64]:
        """Return the true radial distance (H, W) in metres, NaN where nothing is seen."""


class FrameCorrection(Protocol):
    """Corrects raw frames; `rim_camera_ros.pipeline.correct.Correction` is the ordinary one."""

    camera: Camera
    notes: set[str]

    def correct(self, frame: RawFrame) -> CorrectedFrame:
        """Return the corrected frame."""

    def correct_distance(self, frame: RawFrame) -> CorrectedDistance:
        """Return distance and amplitude as `correct` does, without sigma and flags."""

    def cloud(
        self, frame: CorrectedDistance, *, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Return the organised cloud (H, W, 4) float32: x y z [m], intensity [counts]."""

    def depth(self, frame: CorrectedDistance) -> NDArray[np.float32]:
        """Return the depth along z in metres (H, W) float32."""

    def minimum_for(self, settings: Settings) -> float:
        """Return the minimum amplitude in counts at these settings."""

    def carry_on(self, before: Any) -> None:
        """Take over the state of another correction of this camera."""


@dataclass(frozen=True)
class Part:
    """Images of a camera that are calibrated and diagnosed on their own, as those of an ordinary camera.

    ``name`` is empty where there is only one part; ``frequency``: the number of its frequency.
    """

    camera: Camera
    name: str = ""
    frequency: int | None = None


@dataclass(frozen=True)
class Change:
    """A change of a camera file by true poses: effect or key, its part (empty: all), before, after."""

    effect: str
    part: str
    before: Mapping[str, Any]
    after: Mapping[str, Any]


class Measurement(Protocol):
    """A way of measuring: the images of an exposure, their simulation and their correction.

    The object is the group ``measurement`` of a camera file, by its ``type``.
    """

    #: name in a camera file
    type: ClassVar[str]
    #: roles of images with several values a pixel, from which distances are evaluated anew if present
    samples: ClassVar[tuple[str, ...]]
    #: whether distances are phases: effects of a demodulation (`Effect.demodulates`) can act on them
    demodulates: ClassVar[bool]

    def check(self, camera: Camera) -> None:
        """Raise ValueError where the keys, or effects of the file, do not fit this way of measuring."""

    def image_roles(self, camera: Camera) -> tuple[str, ...]:
        """Return the roles of the images that every raw exposure has."""

    def simulation(
        self,
        camera: Camera,
        scene: Scene,
        *,
        seed: int = 0,
        waveform: Waveform | None = None,
        noise: bool = True,
        quantised: bool = True,
    ) -> FrameSimulation:
        """Return the simulation of the camera. Raises `InputError` for options that it does not support."""

    def correction(
        self, camera: Camera, *, without: Iterable[str] = (), minimum_amplitude: float | None = None
    ) -> FrameCorrection:
        """Return the correction of the camera's frames."""

    def noise_factors(
        self, camera: Camera, distance: NDArray[Any], settings: Settings
    ) -> NoiseFactors | None:
        """Return factors on the noise by distance [m] and settings; None if it does not depend on them."""

    def camera_of_frame(self, camera: Camera, frame: RawFrame) -> Camera:
        """Return the ordinary camera of a raw frame's distance and amplitude."""

    def parts(self, camera: Camera) -> tuple[Part, ...]:
        """Return the images that are calibrated and diagnosed, with the ordinary camera of each."""

    def joined(self, camera: Camera, parts: tuple[Camera, ...]) -> Camera:
        """Return the camera with these parts in place of its own `parts`."""

    def review(self, camera: Camera, frames: Iterable[RawFrame], scene: Scene) -> tuple[Camera, list[Change]]:
        """Return the camera without statements that true poses contradict, before its parts are diagnosed.

        These are errors that one part alone does not show: offsets between parts, keys of the group.
        """

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return labels and texts of `rim info` on the way of measuring."""


@dataclass(frozen=True)
class OneFrequency:
    """Continuous modulation at one frequency (Kahlmann 2007, sec. 2.3.1), or a distance already resolved."""

    type: ClassVar[str] = "one_frequency"
    samples: ClassVar[tuple[str, ...]] = ()
    demodulates: ClassVar[bool] = True

    def check(self, camera: Camera) -> None:
        """Accept every camera."""

    def image_roles(self, camera: Camera) -> tuple[str, ...]:
        """Return distance and amplitude."""
        return ("distance", "amplitude")

    def simulation(self, camera: Camera, scene: Scene, **options: Any) -> FrameSimulation:
        """Return the chain of effects, forward."""
        from rim_camera_ros.pipeline.simulate import Simulation

        return Simulation(camera, scene, **options)

    def correction(self, camera: Camera, **options: Any) -> FrameCorrection:
        """Return the chain of effects, in reverse."""
        from rim_camera_ros.pipeline.correct import Correction

        return Correction(camera, **options)

    def noise_factors(
        self, camera: Camera, distance: NDArray[Any], settings: Settings
    ) -> NoiseFactors | None:
        """Return None, as the noise only depends on the amplitude."""
        return None

    def camera_of_frame(self, camera: Camera, frame: RawFrame) -> Camera:
        """Return the camera itself."""
        return camera

    def parts(self, camera: Camera) -> tuple[Part, ...]:
        """Return the camera itself."""
        return (Part(camera),)

    def joined(self, camera: Camera, parts: tuple[Camera, ...]) -> Camera:
        """Return the only part."""
        return parts[0]

    def review(self, camera: Camera, frames: Iterable[RawFrame], scene: Scene) -> tuple[Camera, list[Change]]:
        """Return the camera as it is: it has one part."""
        return camera, []

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return no rows, as those of the sensor are enough."""
        return []
