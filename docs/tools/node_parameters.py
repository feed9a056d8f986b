#!/usr/bin/env python3
"""Write docs/node_parameters.md from what the nodes declare; ``--check`` says whether it is up to date."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pages import DOCS, run

from rim_camera_ros.nodes.calibration import parameters as calibration_parameters
from rim_camera_ros.nodes.common.parameters import Spec
from rim_camera_ros.nodes.correction import parameters as correction_parameters
from rim_camera_ros.nodes.driver import parameters as driver_parameters
from rim_camera_ros.nodes.people import parameters as people_parameters

PAGE = DOCS / "node_parameters.md"
#: The nodes by their executables' first word, with what they declare.
NODES: dict[str, Sequence[Spec]] = {
    "driver": driver_parameters.SPECS,
    "correction": correction_parameters.SPECS,
    "calibration": calibration_parameters.SPECS,
    "people": people_parameters.SPECS,
}
_EFFECTS = Spec("effects.<name>", True, "undo this effect of the camera file, one parameter for each effect")


def row(spec: Spec) -> str:
    """Return the table's row of a parameter."""
    default = str(spec.default).lower() if isinstance(spec.default, bool) else str(spec.default) or "empty"
    allowed = ", ".join(spec.choices)
    if spec.limits is not None:
        low, high = spec.limits
        allowed = f"{low:.10g} to {high:.10g}"
    when = "at start" if spec.read_only else "any time"
    return f"| `{spec.name}` | {default} | {allowed} | {spec.description} | {when} |"


def pages() -> dict[Path, str]:
    """Return the content of the page by its path."""
    lines = [
        "# Parameters of the nodes",
        "",
        "Those that are set *any time* can be changed while the node runs. An effect that the camera file",
        "lacks cannot be switched on. Topics, services, diagnostics: [nodes.md](nodes.md).",
    ]
    for name, specs in NODES.items():
        lines += ["", f"## `{name}_node` (node `{name}`)", ""]
        lines += ["| parameter | default | range or choices | | set |", "|---|---|---|---|---|"]
        lines += [row(one) for one in (*specs, *([_EFFECTS] if name == "correction" else []))]
    lines += ["", "This page is written by `docs/tools/node_parameters.py` (`make docs`).", ""]
    return {PAGE: "\n".join(lines)}


if __name__ == "__main__":
    sys.exit(run(__doc__ or "", pages))
