"""The correction's diagnostics: frames, pixels, calibration, warm-up, consistency; no ROS in here."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.frame import CorrectedFrame, Flag, RawFrame
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.nodes.common.findings import Finding, Flow, Hysteresis, Level, Tally
from rim_camera_ros.nodes.common.lifecycle import ACTIVE
from rim_camera_ros.pipeline.consistency import GREATEST, LEAST, NoiseWatch

#: Seconds between two checks of the pixels of a frame and of the noise.
_SAMPLING = 1.0
#: Shares of pixels [-] at which a state begins and ends. Between the two it does not change: with motion or
#: alternating exposures shares vary by a few percent.
#: Almost no pixel is valid: the valid ones are noise that passed the tests.
_BLIND = (0.01, 0.02)
#: So many pixels are saturated that surfaces are missing.
_SATURATED = (0.2, 0.15)
#: So many pixels are too dark that surfaces are missing.
_TOO_DARK = (0.8, 0.7)
#: Drift [m/s] above which a camera counts as warming up, and below which it counts as warm. With 1 mm/min the
#: drift over the minutes of a task is below the noise of one frame; an SR-3000 reaches 0.8 mm/min half a
#: minute later.
_DRIFTS = (1e-3 / 60, 0.8e-3 / 60)
#: Logarithm [-] of the ratio of measured to predicted noise, in absolute value, above which a camera counts
#: as different from the calibrated camera, and below which as the same again (ratios 0.83 to 1.2).
_DEPARTS = (math.log(GREATEST), math.log(1.2))
_DAY = 86400.0
#: Most pixels from which medians are computed.
_MEDIAN_PIXELS = 40_000


class CorrectionStatus:
    """Counts and samples of the correction, and their findings; the node reports everything to it.

    ``off``: effects of the camera file that are switched off.
    """

    def __init__(self) -> None:
        self.phase = ""
        self.flow = Flow()
        self.refused: Counter[str] = Counter()
        self.uncorrected = 0
        self.last: RawFrame | None = None
        self._begun = time.monotonic()
        self._sample: CorrectedFrame | None = None
        self._sampled = 0.0
        self._watch: NoiseWatch | None = None
        self._camera: Camera
        self._file = ""
        self._off: set[str] = set()
        self._made: datetime | None = None
        self._pairs_left = 0
        self._tally = Tally()
        self._judge_anew()

    def begin(self) -> None:
        """Expect frames from now on."""
        self._begun = time.monotonic()

    def use(self, camera: Camera, file: str, *, off: set[str]) -> None:
        """Use another camera file from now on; ``file`` is its name as given."""
        if self._watch is None or camera is not self._camera:
            # the noise is that of the images that every raw frame has, those of its first part
            self._watch = NoiseWatch(measurement_of(camera).parts(camera)[0].camera)
            self._made = _made(camera, file)
            self._sample = None
            self._judge_anew()
        self._camera, self._file, self._off = camera, file, set(off)

    def _judge_anew(self) -> None:
        """Forget which states hold."""
        limits = {
            "blind": _BLIND,
            "saturated": _SATURATED,
            "dark": _TOO_DARK,
            "drifts": _DRIFTS,
            "departs": _DEPARTS,
        }
        self._states = {name: Hysteresis(begin=begin, end=end) for name, (begin, end) in limits.items()}

    # --- while it runs --------------------------------------------------------------------------

    def take(self, frame: RawFrame) -> bool:
        """Take note of a raw frame; return True once a second, where its pixels are to be checked."""
        self.last = frame
        now = time.monotonic()
        wanted = False
        if now - self._sampled >= _SAMPLING:
            self._sampled = now
            self._pairs_left = 2
            wanted = True
            if self._watch is not None:
                self._watch.forget_last()
        if self._pairs_left and self._watch is not None:
            self._pairs_left -= 1
            self._watch.take(frame)
        return wanted

    def corrected(self, frame: RawFrame, *, processing: float, sample: CorrectedFrame | None) -> None:
        """Count a frame that was corrected (or has no subscribers); ``processing`` in s."""
        latency = (time.time_ns() - frame.stamp) / 1e9
        self.flow.add(time.monotonic(), stamp=frame.stamp, latency=latency, processing=processing)
        if sample is not None:
            self._sample = sample

    # --- findings -------------------------------------------------------------------------------

    def frames(self, dropped: Mapping[str, int]) -> Finding:
        """Return whether frames come complete and in time; ``dropped``: counts by reason."""
        now = time.monotonic()
        finding = Finding(values=self.flow.values(now))
        counts = {
            **{f"refused {role}": count for role, count in self.refused.items()},
            **{f"dropped: {reason}": count for reason, count in dropped.items()},
            "not corrected": self.uncorrected,
        }
        finding.values |= {
            "refused_messages": str(self.refused.total()),
            "dropped_frames": str(sum(dropped.values())),
            **{name: str(count) for name, count in counts.items()},
        }
        lately = self._tally.recent(counts, now)
        if self.phase != ACTIVE:
            finding.note(f"no frames: the node is {self.phase}")
            return finding
        if silent := self.flow.silent(now, begun=self._begun):
            missing = not self.flow.total and not sum(dropped.values())
            never = " (is a driver running in this namespace, with fitting QoS?)" if missing else ""
            finding.worse(Level.ERROR, f"no frame for {silent:.1f} s{never}")
        for reason, count in sorted(lately.items()):
            if count:
                finding.worse(Level.WARN, f"{reason}: {count} lately")
        finding.note(f"{self.flow.rate(now):.1f} frames per second")
        return finding

    def pixels(self) -> Finding:
        """Return the shares of pixels by flag in the frame that was checked last."""
        finding = Finding()
        sample = self._sample
        if sample is None or self.phase != ACTIVE:
            finding.note("no frame")
            return finding
        shares = {flag.name: float(np.mean((sample.flags & flag.value) != 0)) for flag in Flag}
        valid = float(np.mean(np.isfinite(sample.distance)))
        finding.values["valid"] = f"{valid:.4f}"
        finding.values |= {str(name).lower(): f"{share:.4f}" for name, share in shares.items()}
        if valid > 0:
            # of some pixels of a large sensor: medians of all take longer than a frame's correction
            lit = np.isfinite(sample.distance)
            distance, sigma = sample.distance[lit], sample.sigma[lit]
            some = slice(None, None, -(-distance.size // _MEDIAN_PIXELS))
            finding.values["median_distance_m"] = f"{float(np.median(distance[some])):.3f}"
            finding.values["median_sigma_mm"] = f"{1e3 * float(np.median(sigma[some])):.2f}"
        if self._states["blind"].holds(valid):
            finding.worse(
                Level.ERROR, f"{100 * valid:.1f} % of the pixels are valid: the camera sees nothing"
            )
        if self._states["saturated"].holds(shares["SATURATED"]):
            finding.worse(
                Level.WARN,
                f"{100 * shares['SATURATED']:.0f} % of the pixels are saturated: shorten the exposure",
            )
        if self._states["dark"].holds(shares["LOW_AMPLITUDE"]):
            finding.worse(
                Level.WARN,
                f"{100 * shares['LOW_AMPLITUDE']:.0f} % of the pixels are too dark: lengthen the exposure",
            )
        finding.note(f"{100 * valid:.0f} % of the pixels are valid")
        return finding

    def calibration(self) -> Finding:
        """Return which camera file is used, and whether it is valid for the camera in its present state."""
        camera, provenance = self._camera, self._camera.provenance
        finding = Finding(values={"file": self._file, "device": camera.device})
        finding.values["effects"] = " ".join(effect for effect in camera.effects if effect not in self._off)
        finding.values["switched_off"] = " ".join(sorted(self._off))
        if "fitted_by" in provenance:
            finding.values["fitted_by"] = " ".join(str(provenance["fitted_by"]).split())[:200]
        age = None if self._made is None else (datetime.now(UTC) - self._made).total_seconds() / _DAY
        finding.values["age_days"] = "unknown" if age is None else f"{age:.1f}"
        validity = camera.validity
        for name in ("distance", "amplitude", "integration_time", "temperature"):
            limits = getattr(validity, name)
            if limits is not None:
                finding.values[f"valid_{name}"] = f"{limits[0]:g} to {limits[1]:g}"
        frame = self.last
        if frame is not None:
            self._outside(finding, frame)
            if frame.device and frame.device != camera.device:
                finding.worse(Level.WARN, f"the file is of a {camera.device}, the frames of a {frame.device}")
        finding.note(f"{self._file} ({camera.device})")
        return finding

    def _outside(self, finding: Finding, frame: RawFrame) -> None:
        validity = self._camera.validity
        for name, limits, value in (
            (
                "integration time",
                validity.integration_time,
                self._camera.stated_integration_time(frame.settings),
            ),
            ("ambient temperature", validity.temperature, frame.settings.ambient_temperature),
        ):
            if limits is not None and value is not None and not limits[0] <= value <= limits[1]:
                finding.worse(
                    Level.WARN,
                    f"{name} {value:g} is outside of the calibrated {limits[0]:g} to {limits[1]:g}",
                )

    def warm_up(self) -> Finding:
        """Return temperatures, and whether the camera still drifts after power-on."""
        finding = Finding()
        frame = self.last
        if frame is None:
            finding.note("no frame")
            return finding
        settings = frame.settings
        for name, value in (
            ("uptime_s", settings.uptime),
            ("body_temperature_degC", settings.body_temperature),
            ("ambient_temperature_degC", settings.ambient_temperature),
        ):
            finding.values[name] = "unknown" if value is None else f"{value:.2f}"
        effect = next((one for one in self._camera.effects.values() if one.settles), None)
        if effect is None or settings.uptime is None:
            why = "the camera file has none" if effect is None else "the uptime is unknown"
            finding.note(f"drift after power-on not known: {why}")
            return finding
        drift = effect.rate(settings.uptime)
        finding.values["drift_mm_per_min"] = f"{6e4 * drift:.2f}"
        if self._states["drifts"].holds(abs(drift)):
            undone = "not corrected" if effect.name in self._off else "corrected by its mean law"
            finding.worse(Level.WARN, f"still drifting {6e4 * abs(drift):.0f} mm/min, {undone}")
        finding.note("warm")
        return finding

    def consistency(self) -> Finding:
        """Return whether the noise of the frames is that of the camera file."""
        finding = Finding()
        verdict = None if self._watch is None else self._watch.verdict
        if verdict is None:
            finding.note("not enough frames at rest to compare the noise with the camera file")
            return finding
        finding.values |= {
            "noise_ratio": f"{verdict.ratio:.3f}",
            "noise_ratio_dark": f"{verdict.dark:.3f}",
            "noise_ratio_bright": f"{verdict.bright:.3f}",
            "amplitude_between": f"{verdict.amplitude:.0f}",
            "comparisons": str(verdict.comparisons),
            "limits": f"{LEAST:g} to {GREATEST:g}",
        }
        text = f"the noise is {verdict.ratio:.2f} times the predicted one"
        if not self._states["departs"].holds(verdict.departure):
            finding.note(text)
        else:
            finding.worse(
                Level.WARN,
                f"{text} (dark {verdict.dark:.2f}, bright {verdict.bright:.2f}): the camera no longer "
                "matches its calibration; record a known scene and run "
                f"`rim diagnose BAG --camera {self._file} --scene SCENE --out DIR`",
            )
        return finding

    def hardware(self) -> str:
        """Return the device's name."""
        return self.last.device if self.last is not None and self.last.device else self._camera.device


def _made(camera: Camera, file: str) -> datetime | None:
    """Return when a camera file was made, as it states itself, or else when it was written."""
    stated: Any = camera.provenance.get("date")
    if isinstance(stated, str):
        try:
            stated = datetime.fromisoformat(stated)
        except ValueError:
            stated = None
    if isinstance(stated, datetime):
        return stated if stated.tzinfo else stated.replace(tzinfo=UTC)
    path = Path(file)
    try:
        return datetime.fromtimestamp(path.stat().st_mtime, UTC) if path.is_file() else None
    except OSError:
        return None
