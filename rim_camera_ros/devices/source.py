"""Which device, with which settings: what the driver's parameters say, as one object."""

from __future__ import annotations

from dataclasses import dataclass

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.base import Device
from rim_camera_ros.devices.playback import Playback
from rim_camera_ros.devices.simulator import Simulator
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.phasor import Waveform, parse_waveform
from rim_camera_ros.scene import load_scene

SOURCES = ("simulator", "playback")
STAMPS = ("auto", "now", "recorded")


@dataclass(frozen=True, kw_only=True)
class Source:
    """What to take frames from. ``camera`` and ``scene`` are files or names of shipped ones.

    ``frame_rate`` [Hz] and ``integration_time`` (device's own unit): 0 as the scene or recording says.
    """

    source: str = "simulator"
    camera: str = "sr3000"
    scene: str = "room"
    recording: str = ""
    frame_rate: float = 0.0
    integration_time: float = 0.0
    as_fast_as_possible: bool = False
    loop: bool = True
    seed: int = 0
    waveform: str = ""
    playback_rate: float = 1.0
    stamps: str = "auto"

    def open(self) -> Simulator | Playback:
        """Return the open device. Raises `InputError` for whatever is wrong with it."""
        device = self._playback() if self.source == "playback" else self._simulator()
        device.open()
        return device

    @property
    def retries(self) -> bool:
        """Whether a device that failed may deliver again: a recording that is played once does not."""
        return self.source != "playback" or self.loop

    def describe(self) -> str:
        """Return the source in words."""
        if self.source == "playback":
            return f"recording {self.recording}"
        return f"simulation of {self.camera} in {self.scene}"

    def check_settings(self, device: Device) -> None:
        """Raise `InputError` for a setting that the device cannot take."""
        if isinstance(device, Playback):
            device.set_integration_time(self.integration_time or None)

    def set_settings(self, device: Device) -> None:
        """Change the settings of a device that runs."""
        device.set_integration_time(self.integration_time or None)
        device.set_frame_rate(self.frame_rate or None)

    def _simulator(self) -> Simulator:
        if self.source not in SOURCES:
            raise InputError(
                f"no source '{self.source}'", place="source", remedy=nearest_name(self.source, SOURCES)
            )
        return Simulator(
            load_scene(find_scene(self.scene)),
            load_camera(find_camera(self.camera)),
            seed=self.seed,
            frame_rate=self.frame_rate or None,
            integration_time=self.integration_time or None,
            real_time=not self.as_fast_as_possible,
            waveform=self._waveform(),
            repeat=self.loop,
        )

    def _playback(self) -> Playback:
        if not self.recording:
            raise InputError(
                "source playback needs a recording",
                place="recording",
                remedy="set the parameter recording to a bag",
            )
        device = Playback(
            self.recording,
            real_time=not self.as_fast_as_possible,
            loop=self.loop,
            rate=self.playback_rate,
            frame_rate=self.frame_rate or None,
            stamps="now" if self.stamps == "now" else "recorded" if self.stamps == "recorded" else None,
        )
        device.set_integration_time(self.integration_time or None)
        return device

    def _waveform(self) -> Waveform | None:
        if not self.waveform:
            return None
        try:
            return parse_waveform(self.waveform)
        except ValueError as error:
            raise InputError(str(error), place="waveform") from None
