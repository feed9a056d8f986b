"""The process that calibrates for the calibration node, which stays responsive meanwhile; no ROS in here.

Started by `rim_camera_ros.nodes.calibration.supervision` as ``python -m``; not meant to be run by hand.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rim_camera_ros.calibrate.run import Calibration, Request, calibrate
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.nodes.calibration.link import Link, serve
from rim_camera_ros.reports.calibration_files import page_of, require_a_good_one, write_calibration
from rim_camera_ros.scene import load_scene

#: Options of the command that errors name; the node's parameters have the same names.
_OPTION = re.compile(r"--(?=(effects|scene|geometry)\b)")


def work(link: Link) -> Mapping[str, Any]:
    """Calibrate as ``link.request`` says (see `parameters.calibration_of`) and return the figures.

    Where `RimError` is raised nothing has been written.
    """
    try:
        return _work(link)
    except RimError as error:
        raise RimError(_OPTION.sub("", str(error))) from None


def _work(link: Link) -> Mapping[str, Any]:
    given = link.request
    camera, scenes, out = given["camera"], given["scene"], Path(given["output"])
    report = out.with_name(f"{out.stem}.report.html")
    effects = given["effects"]
    link.progress("reading files")
    request = Request(
        recordings=tuple(Path(one) for one in given["recordings"]),
        camera=load_camera(find_camera(camera)),
        scene=tuple(load_scene(find_scene(scene)) for scene in scenes) or None,
        effects=tuple(effects) if effects else None,
        geometry=given["geometry"],
        camera_name=camera,
        scene_name=", ".join(scenes) or None,
        command=given["command"],
    )
    result = calibrate(request, progress=link.progress, cancelled=lambda: link.cancelled)
    require_a_good_one(result, remedy="choose other effects, or record more different poses")
    link.progress("report")
    page, notes = page_of(result, title=out.name)
    if link.cancelled:
        raise RimError("cancelled; nothing was written")
    # such a file may have been written meanwhile: it is not replaced
    for path in (out, report):
        if path.exists():
            raise InputError("exists already", file=path, place="output", remedy="give another name")
    write_calibration(result, out=out, report=report, page=page, author="calibration_node")
    return _figures(result, out, report if page is not None else None, [*result.notes, *notes])


def _figures(result: Calibration, out: Path, report: Path | None, notes: list[str]) -> dict[str, Any]:
    """Return the figures of the result that the node reports; lengths in m."""
    accuracy = result.accuracy
    if result.integral and result.integral_accuracy is not None:
        accuracy = result.integral_accuracy
    return {
        "file": str(out),
        "report": None if report is None else str(report),
        "frames": result.frames,
        "poses": result.poses,
        "held_out_poses": accuracy.poses if accuracy.held_out else 0,
        "rms_before_m": accuracy.before,
        "rms_m": accuracy.after,
        "noise_m": accuracy.noise,
        "systematic_m": accuracy.systematic,
        "chi_square": result.chi_square,
        "effects": sorted(status.effect for status in result.statuses if status.status == "fitted"),
        "notes": sorted(set(notes)),
    }


def main() -> int:
    """Calibrate as the node asks on standard input."""
    serve(work, keep=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
