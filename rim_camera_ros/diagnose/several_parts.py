"""Diagnoses of the parts (frequencies) of one camera as one: a report of all in addition to that of each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import save_camera
from rim_camera_ros.diagnose.files import MODEL, PAGE, REPORT
from rim_camera_ros.diagnose.report import as_json
from rim_camera_ros.diagnose.result import Diagnosis
from rim_camera_ros.measurement import Change, Part
from rim_camera_ros.yaml_files import write_whole

#: Verdicts, the gravest last.
_ORDER = ("consistent", "wrong_parameters", "missing_physics", "unknown_physics", "inconsistent_setup")


def gravest(results: Sequence[tuple[Part, Diagnosis]], changes: Sequence[Change]) -> str:
    """Return the verdict on all parts; ``changes`` are errors found before any part was diagnosed."""
    verdicts = [diagnosis.verdict for _, diagnosis in results] + ["wrong_parameters"] * bool(changes)
    return max(verdicts, key=_ORDER.index)


def as_one(results: Sequence[tuple[Part, Diagnosis]], changes: Sequence[Change]) -> dict[str, Any]:
    """Return one report of all parts in the form of `rim_diagnosis/1`.

    Its numbers are those of the part with the gravest verdict (of several the one with the greatest RMS
    before); ``missing`` and ``adjusted`` are those of all parts, with the name under ``part``. ``parts`` has
    the verdict and the report of each.
    """
    worst, _ = max(results, key=lambda part: (_ORDER.index(part[1].verdict), part[1].accuracy.rms_before))
    reports = {part.name: as_json(result) for part, result in results}
    whole = {**reports[worst.name], "verdict": gravest(results, changes), "model": MODEL}
    whole["where"] = {**whole["where"], "pixels": f"{worst.name}/{whole['where']['pixels']}"}
    for key in ("missing", "adjusted"):
        whole[key] = [{**entry, "part": name} for name, its in reports.items() for entry in its[key]]
    whole["adjusted"] += [
        {"effect": change.effect, "from": dict(change.before), "to": dict(change.after), "part": change.part}
        for change in changes
    ]
    whole["parts"] = {
        name: {"verdict": its["verdict"], "report": f"{name}/{REPORT}", "page": f"{name}/{PAGE}"}
        for name, its in reports.items()
    }
    whole["notes"] = [f"{name}: {note}" for name, its in reports.items() for note in its["notes"]]
    return whole


def write_as_one(
    results: Sequence[tuple[Part, Diagnosis]],
    changes: Sequence[Change],
    camera: Camera,
    folder: Path,
    *,
    comment: str,
) -> None:
    """Write camera.yaml and report.json of all parts. Raises `RimError` where a file cannot be written."""
    save_camera(camera, folder / MODEL, comment=comment)
    text = json.dumps(as_one(results, changes), indent=1, allow_nan=False) + "\n"
    write_whole(folder / REPORT, lambda stream: stream.write(text.encode()))


def text_of(
    results: Sequence[tuple[Part, Diagnosis]], changes: Sequence[Change], texts: Sequence[str]
) -> str:
    """Return the texts of the parts under their names, after the verdict on all."""
    lines = [f"{gravest(results, changes)}, of all frequencies"]
    for change in changes:
        for key, before in change.before.items():
            whose = f"{change.effect} of {change.part}" if change.part else "measurement"
            moved = f"{key} {_shown(before)}, now {_shown(change.after[key])}"
            lines.append(f"  {whose} is not what was measured: {moved}")
    for (part, _), text in zip(results, texts, strict=True):
        lines += [part.name, text]
    return "\n".join(lines)


def _shown(value: Any) -> str:
    text = "null" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
