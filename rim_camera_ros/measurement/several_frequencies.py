"""Continuous modulation at several frequencies: the group ``measurement`` of the camera file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from rim_camera_ros.bags.topics import FREQUENCIES
from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.measurement.base import Change, FrameCorrection, FrameSimulation, Part
from rim_camera_ros.measurement.wraps import WrapTable, common_range
from rim_camera_ros.noise import Noise, NoiseFactors
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import SPEED_OF_LIGHT
from rim_camera_ros.scene import Scene

#: Amplitude, in its own sigma, at which the probability of wrong wraps is stated.
STATED_AT = 10.0


@dataclass(frozen=True)
class SeveralFrequencies:
    """One distance and amplitude per frequency; the wraps are resolved by maximum likelihood.

    ``Camera.channels``: the ordinary camera of each frequency, in the order of the file.
    """

    type: ClassVar[str] = "several_frequencies"
    samples: ClassVar[tuple[str, ...]] = ()
    demodulates: ClassVar[bool] = True

    range: tuple[float, float] | None = quantity(
        "m", "least and greatest distance; null: from 0 to where all phases repeat", default=None, minimum=0.0
    )
    odds: float = quantity(
        "-", "a pixel whose next likely wraps are not that many times less likely has no distance",
        default=100.0, minimum=1.0, maximum=1e12,
    )  # fmt: skip
    wraps: tuple[tuple[int, ...], ...] | None = quantity(
        "-", "wraps of each frequency that are possible; null: all that the range allows",
        default=None, minimum=-1, most=10_000,
    )  # fmt: skip
    two_paths: bool = quantity(
        "-", "correct light by way of another surface, by two components for each pixel", default=False
    )

    # --- the camera -----------------------------------------------------------------------------

    def check(self, camera: Camera) -> None:
        """Raise ValueError where the keys do not fit the frequencies."""
        channels = camera.channels
        if len(channels) < 2:
            raise ValueError("type several_frequencies needs a list at sensor.modulation_frequency")
        if len(channels) > FREQUENCIES:
            raise ValueError(f"{len(channels)} frequencies, {FREQUENCIES} at most")
        frequencies = [channel.sensor.modulation_frequency for channel in channels]
        if len(set(frequencies)) < len(frequencies):
            raise ValueError("sensor.modulation_frequency: a frequency is given twice")
        if not all(channel.sensor.wraps for channel in channels):
            raise ValueError("sensor.distance_lsb: counts must wrap at each frequency's ambiguity range")
        low, high = self.span(camera)
        most = common_range(frequencies)
        if not low < high:
            raise ValueError("range: the first value must be less than the second")
        if high > most * (1 + 1e-9):
            raise ValueError(
                f"range: the phases of all frequencies repeat from {most:.4g} m, {high:g} m is beyond"
            )
        for row in self.wraps or ():
            if len(row) != len(channels):
                raise ValueError(f"wraps: {list(row)} has {len(row)} entries for {len(channels)} frequencies")
            if max(n * channel.sensor.ambiguity for n, channel in zip(row, channels, strict=True)) > high:
                raise ValueError(f"wraps: {list(row)} lie beyond the range of {high:.4g} m")
        if self.two_paths and len(channels) < 3:
            raise ValueError("two_paths needs three frequencies: two do not distinguish paths from noise")
        if self.wraps is not None and not self.wraps:
            raise ValueError("wraps is empty: give at least one set")

    def span(self, camera: Camera) -> tuple[float, float]:
        """Return the least and greatest distance in metres of resolved wraps."""
        if self.range is not None:
            return self.range
        return 0.0, common_range([channel.sensor.modulation_frequency for channel in camera.channels])

    def table(self, camera: Camera) -> WrapTable:
        """Return the table of possible wraps."""
        return WrapTable(
            [channel.sensor.ambiguity for channel in camera.channels], self.span(camera), self.wraps
        )

    def camera_of(self, channels: tuple[Camera, ...]) -> Camera:
        """Return the camera that delivers the resolved distance, with the cameras of its frequencies.

        It wraps where all phases repeat. Its amplitude is the mean over the frequencies. Each term of its
        noise combines those of the frequencies by their weights. Its effects are all effects of any
        frequency.
        """
        common = common_range([channel.sensor.modulation_frequency for channel in channels])
        sensor = replace(
            channels[0].sensor, modulation_frequency=SPEED_OF_LIGHT / (2 * common), distance_lsb=None
        )
        effects: dict[str, Any] = {}
        for channel in channels:
            effects = dict(channel.effects) | effects
        gains = np.array([channel.radiometry.gain for channel in channels])
        relative = gains / gains.mean()

        def combined(key: str, power: float) -> float:
            values = np.array([getattr(channel.noise, key) for channel in channels]) / relative**power
            return float(1 / np.sqrt(np.sum(values**-2.0))) if np.all(values > 0) else 0.0

        return replace(
            channels[0],
            sensor=sensor,
            radiometry=replace(channels[0].radiometry, gain=float(gains.mean())),
            noise=Noise(combined("floor", 0.0), combined("shot", 0.5), combined("amplitude", 1.0)),
            effects=MappingProxyType(effects),
            covariance=None,
            measurement=self,
            channels=channels,
        )

    def resolved(self, camera: Camera) -> Camera:
        """Return the ordinary camera of recordings with only the resolved distance.

        It has the effects that are the same at every frequency.
        """
        first = camera.channels[0].effects
        same = {
            name: one
            for name, one in first.items()
            if all(c.effects.get(name) == one for c in camera.channels)
        }
        return replace(camera, effects=MappingProxyType(same), measurement=None, channels=())

    # --- the way of measuring -------------------------------------------------------------------

    def image_roles(self, camera: Camera) -> tuple[str, ...]:
        """Return distance and amplitude of each frequency."""
        return tuple(
            f"{kind}_{i}" for i, _ in enumerate(camera.channels) for kind in ("distance", "amplitude")
        )

    def simulation(self, camera: Camera, scene: Scene, **options: Any) -> FrameSimulation:
        """Return the chain of effects, forward, for each frequency."""
        from rim_camera_ros.pipeline.several_frequencies import SeveralSimulations

        return SeveralSimulations(camera, scene, **options)

    def correction(
        self, camera: Camera, *, without: Iterable[str] = (), minimum_amplitude: float | None = None
    ) -> FrameCorrection:
        """Return the chain of effects, in reverse, for each frequency, and the resolution of the wraps."""
        from rim_camera_ros.pipeline.several_frequencies import SeveralCorrections

        return SeveralCorrections(camera, without=without, minimum_amplitude=minimum_amplitude)

    def noise_factors(self, camera: Camera, distance: Any, settings: Settings) -> NoiseFactors | None:
        """Return None, as the noise of every frequency only depends on its amplitude."""
        return None

    def camera_of_frame(self, camera: Camera, frame: RawFrame) -> Camera:
        """Return the camera of the first frequency, or of the resolved distance."""
        return self.resolved(camera) if "distance" in frame.by_role else camera.channels[0]

    def parts(self, camera: Camera) -> tuple[Part, ...]:
        """Return the cameras of the frequencies, with the images of each."""
        return tuple(
            Part(channel, f"{channel.sensor.modulation_frequency / 1e6:g}MHz", i)
            for i, channel in enumerate(camera.channels)
        )

    def joined(self, camera: Camera, parts: tuple[Camera, ...]) -> Camera:
        """Return the camera of these frequencies, under the name and with the geometry of the first."""
        made = zip(self.parts(camera), parts, strict=True)
        provenance = MappingProxyType({part.name: dict(other.provenance) for part, other in made})
        optics = parts[0].optics
        return self.camera_of(
            tuple(
                replace(other, device=camera.device, optics=optics, provenance=provenance) for other in parts
            )
        )

    def review(self, camera: Camera, frames: Iterable[RawFrame], scene: Scene) -> tuple[Camera, list[Change]]:
        """Return the camera without wrong offsets of frequencies, wrong ``wraps`` or ``range``."""
        from rim_camera_ros.pipeline.several_review import review

        return review(camera, frames, scene)

    def rows(self, camera: Camera) -> list[tuple[str, str]]:
        """Return frequencies, ranges and the probability of wrong wraps."""
        frequencies = [channel.sensor.modulation_frequency for channel in camera.channels]
        ranges = [channel.sensor.ambiguity for channel in camera.channels]
        low, high = self.span(camera)
        table = self.table(camera)
        error = table.probability_of_error([interval / (2 * np.pi * STATED_AT) for interval in ranges])
        return [
            (
                "distance",
                f"{_listed(frequencies, 1e-6)} MHz: unambiguous to {_listed(ranges)} m, "
                f"together to {common_range(frequencies):.4g} m",
            ),
            (
                "wraps",
                f"{len(table.rows)} sets within {low:g} to {high:.4g} m; wrong with a probability of "
                f"{error:.1g} at most where amplitudes are {STATED_AT:g} sigma; no distance below odds of "
                f"{self.odds:g}" + (", two paths for each pixel" if self.two_paths else ""),
            ),
        ]


def _listed(values: Iterable[float], unit: float = 1.0) -> str:
    return ", ".join(f"{value * unit:.4g}" for value in values)
