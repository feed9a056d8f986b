"""The sections on the setup and on ordinary imperfections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rim_camera_ros.reports.diagnosis.evidence import Evidence
from rim_camera_ros.reports.page import Figure, Mood, Part, Table

#: Ratio of an imperfection to its stated size up to which it is ordinary.
_ORDINARY = 3.0
#: Set-ups as rows of the table.
_HYPOTHESES = {
    "as_given": "as the scene file says",
    "turned_180": "turned by 180°",
    "turned_90": "turned by 90°",
    "mirrored": "mirrored",
    "inverted": "dark and bright exchanged",
    "other_pattern": "with another pattern",
    "other_board": "another board",
    "scale": "of another size",
    "depth": "nearer or farther",
    "pose": "poses with another sign of an angle",
    "units": "given in other units",
    "z_distance": "distances along the axis, not along the rays",
    "compensated_amplitude": "amplitudes times the square of the distance",
    "other_lens": "seen through another lens",
}


def worst_pose(found: Evidence) -> list[Part]:
    """Return recording and simulation of the worst pose side by side, where the set-up is in doubt."""
    worst = found.worst
    if worst is None:
        return []
    from rim_camera_ros.reports.diagnosis.maps import recorded_and_simulated

    far = np.abs(worst.difference[np.isfinite(worst.difference)])
    said = f"median difference {np.median(far) * 1e3:.0f} mm" if far.size else "no pixel compared"
    caption = (
        f"Pose {worst.pose}, at {worst.time:.0f} s, agrees worst ({said}). Left: the amplitude recorded and "
        "that of the simulation, on the same scale: outlines and marks must lie in the same places. Right: "
        "recorded minus simulated distance. Grey: nothing there."
    )
    alt = f"Recorded amplitude, simulated amplitude and difference of distances at pose {worst.pose}; {said}"
    return [Figure(recorded_and_simulated(worst), alt, caption)]


def hypotheses(report: Mapping[str, Any]) -> list[Part]:
    """Return the alternative set-ups, by `setup` of report.json, in its order."""
    # where the files are trusted they come first, even if others gained a little more
    ranked = list(report.get("setup") or [])
    rows = [
        [
            _words_of(setup),
            str(setup.get("surface") or "-"),
            f"{round(float(setup['gain'] or 0.0)):,}",
        ]
        for setup in ranked
    ]
    if len(rows) < 2:
        return []
    best: dict[int, Mood] = {0: "warn"} if ranked[0]["hypothesis"] != "as_given" else {0: "good"}
    return [Table(["the scene", "surface", "gain [nats]"], rows, numbers=(2,), moods=best)]


def _words_of(hypothesis: Mapping[str, Any]) -> str:
    name = str(hypothesis["hypothesis"])
    if name == "pose" and not hypothesis.get("surface"):
        return "some poses elsewhere"
    return _HYPOTHESES.get(name, name.replace("_", " "))


def imperfections(report: Mapping[str, Any]) -> list[Part]:
    """Return the estimated ordinary imperfections, by `nuisances` of report.json."""
    rows: list[list[str]] = []
    moods: dict[int, Mood] = {}
    for number, one in enumerate(report.get("nuisances") or []):
        found, stated = one.get("found"), one.get("stated")
        ordinary = found is None or not stated or abs(found) <= _ORDINARY * stated
        ratio = f"{abs(found) / stated:.1f}" if found is not None and stated else "-"
        moods[number] = "" if ordinary else "warn"
        said = "ordinary" if ordinary else "more than stated"
        rows.append(
            [
                str(one["name"]).replace("_", " "),
                "-" if found is None else f"{found:.3g}",
                "-" if stated is None else f"{stated:.3g}",
                ratio,
                said,
            ]
        )
    headings = ["imperfection", "found", "stated", "found / stated", ""]
    return [Table(headings, rows, numbers=(1, 2, 3), moods=moods)] if rows else []
