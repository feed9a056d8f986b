"""The diagnosis as files: report.json, where.npy, camera.yaml."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.camera_file import save_camera
from rim_camera_ros.diagnose.files import MODEL, REPORT, WHERE
from rim_camera_ros.diagnose.result import Diagnosis, Missing
from rim_camera_ros.diagnose.smooth import UNKNOWN
from rim_camera_ros.parameters import encode
from rim_camera_ros.yaml_files import write_whole

FORMAT = "rim_diagnosis/1"


def as_json(result: Diagnosis) -> dict[str, Any]:
    """Return the report in the form of `rim_diagnosis/1`; further fields follow the required ones."""
    measure = result.accuracy
    report: dict[str, Any] = {
        "format": FORMAT,
        "verdict": result.verdict,
        "missing": [_missing(effect, result) for effect in result.missing],
        "adjusted": [
            {"effect": term.effect, "from": dict(term.before), "to": dict(term.after)}
            for term in result.adjusted
        ],
        "ranking": [
            {
                "effect": rival.effect,
                "probability": rival.probability,
                "held_out_gain": rival.gain,
                "identifiability": rival.identifiability,
                "expected_gain": rival.expected_gain,
            }
            for rival in result.ranking
        ],
        "indistinguishable": result.indistinguishable,
        "where": {
            "covariates": [{"name": name, "share": share} for name, share in result.where.covariates],
            "pixels": WHERE,
            "times": [list(time) for time in result.where.times],
        },
        "fit": {
            "rms_before": measure.rms_before,
            "rms_after": measure.rms_after,
            "noise_floor": measure.noise_floor,
            "chi2_before": measure.chi2_before,
            "chi2_after": measure.chi2_after,
            "held_out": measure.held_out,
            "chi2_all_before": measure.all_before,
            "chi2_all_after": measure.all_after,
        },
        "next_recording": result.next_recording,
        "model": MODEL,
        "threshold": result.baseline.threshold,
        "variance_ratio": result.variance.ratio if result.variance.repeated else None,
        "not_visible_here": result.unseen,
        "nuisances": [
            {"name": nuisance.name, "found": nuisance.found, "stated": nuisance.stated, "unit": nuisance.unit}
            for nuisance in result.nuisances
        ],
        "setup": [
            {"hypothesis": setup.hypothesis, "surface": setup.surface, "gain": setup.gain}
            for setup in result.setups
        ],
        "notes": result.notes,
    }
    if result.reason is not None:
        report["reason"] = result.reason
    plain: dict[str, Any] = _plain(report)
    return plain


def _missing(effect: Missing, result: Diagnosis) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "effect": effect.effect,
        "probability": effect.probability,
        "parameters": _parameters(effect, result),
        "interval": {path: [low, high] for path, (low, high) in effect.interval.items()},
        "sentence": effect.sentence,
    }
    if effect.magnitude is not None or effect.effect == UNKNOWN:
        entry["magnitude"] = effect.magnitude
    if effect.distance_sigma is not None:
        entry["distance_sigma"] = effect.distance_sigma
    if effect.covariates or effect.effect == UNKNOWN:
        entry["covariates"] = list(effect.covariates)
        entry["closed_form"] = effect.formula
    return entry


def _parameters(named: Missing, result: Diagnosis) -> Any:
    """Return the parameters as in the camera file."""
    if named.effect == UNKNOWN and named.model is None:
        return {}
    effect = result.camera.effects.get(named.model or named.effect)
    return encode(effect) if effect is not None else _nested(named.parameters)


def _nested(values: Mapping[str, float]) -> dict[str, Any]:
    """Return parameters by path as groups and lists: d.0, d.1 are the list d."""
    groups: dict[str, dict[str, float]] = {}
    for path, value in values.items():
        name, _, rest = path.partition(".")
        groups.setdefault(name, {})[rest] = value
    result: dict[str, Any] = {}
    for name, own in groups.items():
        inner: Any = own[""] if "" in own else _nested(own)
        # a curve's angles or settings are numbers as well, and no list
        numbered = isinstance(inner, dict) and set(inner) == {str(i) for i in range(len(inner))}
        result[name] = [inner[key] for key in sorted(inner, key=int)] if numbered else inner
    return result


def _plain(value: Any) -> Any:
    """Return what JSON can hold: numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def write_report(result: Diagnosis, folder: Path, *, comment: str = "") -> None:
    """Write report.json, where.npy and camera.yaml into an existing folder, the report last.

    Raises `RimError` where a file cannot be written.
    """
    pixels = np.asarray(result.where.pixels, np.float32)
    write_whole(folder / WHERE, lambda stream: np.save(stream, pixels, allow_pickle=False))
    # a covariance that was stated for the camera as it was does not hold for the new one
    same = result.verdict in ("consistent", "inconsistent_setup")
    camera = result.camera if same else replace(result.camera, covariance=None)
    save_camera(camera, folder / MODEL, comment=comment)
    text = json.dumps(as_json(result), indent=1, allow_nan=False) + "\n"
    write_whole(folder / REPORT, lambda stream: stream.write(text.encode()))
