"""The driver's diagnostics: whether frames come, from which device, in which state; no ROS in here."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from rim_camera_ros.devices.base import Device
from rim_camera_ros.errors import RimError
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.nodes.common.findings import Finding, Flow, Hysteresis, Level, Tally
from rim_camera_ros.nodes.common.lifecycle import ACTIVE

#: Share [-] of the nominal frame rate below which frames are missing, and above which they are complete
#: again. Rates over five seconds vary by a few percent on a machine that does other work.
_FEW, _COMPLETE = 0.9, 0.95
#: No frames come if none has come for this time [s] and for so many periods.
_SILENT, _SILENT_PERIODS = 1.0, 3.0
#: Further keys of frame_info that stay the same while a camera is connected.
_IDENTITY = ("serial_number", "firmware", "library")


@dataclass
class DriverStatus:
    """State of the driver's device and counts of its frames; written by the acquisition's thread."""

    phase: str = ""
    source: str = ""
    paused: bool = False
    waiting: bool = False
    ended: bool = False
    faults: int = 0
    recoveries: int = 0
    failing: str = ""
    last_fault: str = ""
    not_published: int = 0
    flow: Flow = field(default_factory=Flow)
    last: RawFrame | None = None
    begun: float = 0.0
    _lost: Tally = field(default_factory=Tally)
    _few: Hysteresis = field(default_factory=lambda: Hysteresis(begin=_FEW, end=_COMPLETE))

    def begin(self) -> None:
        """Take note that a device begins to deliver."""
        self.begun = time.monotonic()
        self.ended, self.failing = False, ""

    def published(self, frame: RawFrame, *, processing: float) -> None:
        """Count a frame that was published; ``processing`` in s."""
        self.flow.add(
            time.monotonic(),
            stamp=frame.stamp,
            latency=(time.time_ns() - frame.stamp) / 1e9,
            processing=processing,
        )
        self.last = frame

    def fault(self, error: RimError) -> None:
        """Take note that the device failed."""
        self.faults += 1
        self.failing = self.last_fault = str(error)

    def recovered(self) -> None:
        """Take note that the device delivers again."""
        self.recoveries += 1
        self.failing = ""

    # --- findings -------------------------------------------------------------------------------

    def frames(self, device: Device | None) -> Finding:
        """Return whether frames come at the nominal rate."""
        now = time.monotonic()
        finding = Finding(values=self.flow.values(now))
        nominal = 0.0 if device is None else device.frame_rate
        finding.values["nominal_rate_hz"] = f"{nominal:.2f}"
        counts = {"skipped": int(getattr(device, "skipped", 0)), "not_published": self.not_published}
        finding.values |= {name: str(count) for name, count in counts.items()}
        lost = self._lost.recent(counts, now)
        if self.phase != ACTIVE:
            finding.note(f"no frames: the node is {self.phase}")
        elif self.failing:
            finding.worse(Level.ERROR, "no frames: the device failed")
        elif self.ended:
            finding.note("the source is at its end")
        elif self.paused:
            finding.note("playback stands still")
        elif self.waiting:
            finding.note("waiting for subscribers")
        else:
            self._come(finding, nominal, now)
            if lost["skipped"]:
                finding.worse(
                    Level.WARN, f"{lost['skipped']} frames skipped lately: this computer is too slow"
                )
            if lost["not_published"]:
                finding.worse(Level.WARN, f"{lost['not_published']} frames could not be published lately")
        return finding

    def _come(self, finding: Finding, nominal: float, now: float) -> None:
        since = now - max(self.flow.last or 0.0, self.begun)
        rate = self.flow.rate(now)
        limit = max(_SILENT, _SILENT_PERIODS / nominal if nominal > 0 else 0.0)
        if since > limit:
            finding.worse(Level.ERROR, f"no frame for {since:.1f} s")
        elif min(rate, nominal) > 0 and now - self.begun > 2.0 and self._few.holds(rate / nominal):
            finding.worse(Level.WARN, f"{rate:.1f} frames per second, not {nominal:.1f}")
        else:
            finding.note(f"{rate:.1f} frames per second")

    def device(self, device: Device | None) -> Finding:
        """Return which device it is, and its state."""
        finding = Finding(values={"state": self.phase, "source": self.source})
        frame = self.last
        if frame is not None:
            settings = frame.settings
            finding.values |= {"device": frame.device, **{k: str(v) for k, v in settings.extra.items()}}
            for name, value in (
                ("integration_time", settings.integration_time),
                ("modulation_frequency_hz", settings.modulation_frequency),
                ("uptime_s", settings.uptime),
                ("body_temperature_degC", settings.body_temperature),
                ("ambient_temperature_degC", settings.ambient_temperature),
            ):
                if value is not None:
                    finding.values[name] = f"{value:g}"
        finding.values |= {
            "faults": str(self.faults),
            "recoveries": str(self.recoveries),
            "last_fault": self.last_fault,
        }
        short = getattr(device, "short_frames", None)
        if short is not None:
            finding.values["short_frames"] = str(short)
        if self.failing:
            finding.worse(Level.ERROR, self.failing)
        else:
            finding.note(f"{self.source}, {self.phase}")
        return finding

    def identity(self) -> dict[str, str]:
        """Return what identifies this camera, as far as its frames state it."""
        found = {"source": self.source}
        if self.last is not None:
            settings = self.last.settings
            found |= {key: settings.extra[key] for key in _IDENTITY if key in settings.extra}
            if settings.modulation_frequency is not None:
                found["modulation_frequency"] = f"{settings.modulation_frequency:.10g}"
        return found

    def hardware(self) -> str:
        """Return the device's name and serial number."""
        if self.last is None:
            return self.source
        serial = self.last.settings.extra.get("serial_number")
        return f"{self.last.device} {serial}" if serial else self.last.device
