"""Device and settings by the driver's parameters, as one object."""

from __future__ import annotations

from dataclasses import dataclass

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.devices.base import Device
from rim_camera_ros.devices.playback import Playback
from rim_camera_ros.devices.simulator import Simulator, checked_rate
from rim_camera_ros.devices.sr3000 import SwissRanger
from rim_camera_ros.devices.swissranger_settings import AutoExposure, CameraSettings
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.phasor import Waveform, parse_waveform
from rim_camera_ros.scene import load_scene

SOURCES = ("simulator", "playback", "sr3000")
STAMPS = ("auto", "now", "recorded")


@dataclass(frozen=True, kw_only=True)
class Source:
    """The source of frames. ``camera`` and ``scene`` are files or names of shipped ones.

    ``frame_rate`` [Hz] and ``integration_time`` (device's own unit); 0: as the scene or recording says.
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
    library: str = ""
    serial_number: int = 0
    modulation_frequency: float = 0.0
    amplitude_threshold: int = 0
    auto_exposure: bool = False
    mode: str = "raw"
    pause: bool = False

    def open(self) -> Simulator | Playback | SwissRanger:
        """Return the open device. Raises `InputError` where parameters or files are wrong."""
        self.check_settings()
        device: Simulator | Playback | SwissRanger
        if self.source == "playback":
            device = self._playback()
        elif self.source == "sr3000":
            device = self._swissranger()
        else:
            device = self._simulator()
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
        if self.source == "sr3000":
            return "SwissRanger on USB"
        return f"simulation of {self.camera} in {self.scene}"

    def check_settings(self, device: Device | None = None) -> None:
        """Raise `InputError` for a setting that the device, or every device of this source, cannot take."""
        if self.pause and self.source != "playback":
            raise InputError(
                "only playback can stand still", place="pause", remedy="deactivate the node to end the frames"
            )
        if isinstance(device, Playback):
            device.set_integration_time(self.integration_time or None)
        if isinstance(device, SwissRanger):
            self._camera_settings()

    def set_settings(self, device: Device) -> None:
        """Change the settings of a running device."""
        if isinstance(device, SwissRanger):
            device.apply(self._camera_settings())
            return
        if isinstance(device, Playback):
            device.rate = checked_rate(self.playback_rate)
        device.set_integration_time(self.integration_time or None)
        device.set_frame_rate(self.frame_rate or None)

    def _camera_settings(self) -> CameraSettings:
        return CameraSettings(
            integration_time=self.integration_time or None,
            modulation_frequency=self.modulation_frequency or None,
            amplitude_threshold=self.amplitude_threshold,
            auto_exposure=AutoExposure() if self.auto_exposure else None,
            frame_rate=self.frame_rate or None,
            mode=self.mode,
        )

    def _swissranger(self) -> SwissRanger:
        return SwissRanger(
            settings=self._camera_settings(),
            library=self.library or None,
            serial=self.serial_number,
            intrinsics=load_camera(find_camera(self.camera)).intrinsics,
            wait_for_camera=True,
        )

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
