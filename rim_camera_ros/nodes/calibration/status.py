"""Progress and results of the calibration node, in words and values; no ROS in here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rim_camera_ros.info.text import several
from rim_camera_ros.nodes.common.findings import Finding, Level
from rim_camera_ros.nodes.common.lifecycle import UNCONFIGURED

_DOING = {"calibration": "calibrating", "recording": "recording"}
#: Figures of a result in m, which are reported in mm.
_LENGTHS = ("rms_before", "rms", "noise", "systematic")


class CalibrationStatus:
    """The work that runs, by `begin`, `advance` and `end`; ``result`` is that of the last work.

    ``phase`` is the state of the node's lifecycle.
    """

    def __init__(self) -> None:
        self.phase = UNCONFIGURED
        self.result = Finding(values={"state": "idle"})
        self.result.note("idle")
        self._work: str | None = None
        self._asked = ""
        self._progress: dict[str, Any] = {}
        self._pid = 0

    def begin(self, work: str, *, pid: int) -> None:
        """Take note that ``work`` (``calibration``, ``recording``) has begun."""
        self._work, self._pid, self._asked = work, pid, ""
        self._progress = {"stage": "starting", "done": None, "total": None}

    def asked(self, what: str) -> None:
        """Take note of a request to the work: ``cancelling`` or ``finishing``."""
        self._asked = what

    def advance(self, progress: Mapping[str, Any]) -> None:
        """Take note of a progress, a message of `link`."""
        self._progress = dict(progress)

    def end(self, end: Mapping[str, Any], *, seconds: float) -> Finding:
        """Take the last message of `link`, and return the result as a finding."""
        work, self._work = self._work, None
        assert work is not None
        finding = Finding(values={"work": work, "seconds": f"{seconds:.1f}"})
        if "result" in end:
            report = _recorded if work == "recording" else _calibrated
            report(finding, end["result"])
        elif "cancelled" in end:
            finding.values["state"] = "cancelled"
            finding.note(f"the {work} was cancelled; nothing was written")
        else:
            finding.values["state"] = "failed"
            finding.values["reason"] = str(end["failed"])
            finding.worse(Level.ERROR, f"the {work} failed: {end['failed']}")
        self.result = finding
        return finding

    def progress(self, seconds: float) -> Finding:
        """Return the progress of the work that has run for ``seconds``."""
        assert self._work is not None
        state, stage = self._asked or _DOING[self._work], str(self._progress["stage"])
        done, total = self._progress["done"], self._progress["total"]
        count = "" if done is None else f" {done}" + ("" if total is None else f" of {total}")
        finding = Finding(values={"state": state, "work": self._work, "stage": stage})
        if done is not None:
            finding.values["done"] = str(done)
        if total is not None:
            finding.values["total"] = str(total)
        finding.values |= {"seconds": f"{seconds:.1f}", "pid": str(self._pid)}
        finding.note(f"{state}: {stage}{count}, {seconds:.0f} s")
        return finding

    def look(self, seconds: float | None) -> Finding:
        """Return the state for the diagnostics; ``seconds``: for how long work has run, None if none runs."""
        finding = self.result if seconds is None or self._work is None else self.progress(seconds)
        finding.values["lifecycle"] = self.phase
        return finding


def _recorded(finding: Finding, result: Mapping[str, Any]) -> None:
    finding.values |= {"state": "recorded", "file": result["file"], "frames": str(result["frames"])}
    finding.note(f"recorded: {result['file']}, {several(result['frames'], 'frame')}")


def _calibrated(finding: Finding, result: Mapping[str, Any]) -> None:
    chi_square, effects = result["chi_square"], ", ".join(result["effects"]) or "none"
    values = {"state": "done", "file": result["file"], "report": result["report"] or "", "effects": effects}
    values |= {f"{name}_mm": f"{1e3 * result[f'{name}_m']:.3f}" for name in _LENGTHS}
    values["chi_square"] = "" if chi_square is None else f"{chi_square:.4f}"
    values |= {name: str(result[name]) for name in ("frames", "poses", "held_out_poses")}
    finding.values |= values
    where = "held-out" if result["held_out_poses"] else "the fitted"
    judged = "" if chi_square is None else f", chi-square per value {chi_square:.3f}"
    finding.note(
        f"done: {result['file']}, systematic error {values['systematic_mm']} mm on {where} poses{judged}, "
        f"effects {effects}"
    )
