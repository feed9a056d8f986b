"""The files of a calibration: the camera file, and the report where matplotlib is installed."""

from __future__ import annotations

from pathlib import Path

from rim_camera_ros.calibrate.run import Calibration
from rim_camera_ros.camera_file import save_camera_apart
from rim_camera_ros.errors import RimError
from rim_camera_ros.info.text import several
from rim_camera_ros.measurement import Part
from rim_camera_ros.yaml_files import write_whole


def page_of(result: Calibration, *, title: str) -> tuple[bytes | None, list[str]]:
    """Return the report (HTML), None where it cannot be drawn, and notes on the reason."""
    try:
        from rim_camera_ros.reports.calibration import calibration_page

        return calibration_page(result, title=title).encode(), []
    except ImportError as error:
        why = str(error)
        if error.name is not None and error.name.startswith("matplotlib"):
            why = "matplotlib is not installed"
        remedy = "pip install 'rim_camera_ros[reports]', or apt install python3-matplotlib"
        return None, [f"no report was written: {why} ({remedy})"]
    except Exception as error:
        # the work of minutes is not lost with its picture
        fault = f"{type(error).__name__}: {error}"
        return None, [f"no report was written: {fault} (this is a fault of the program: please report it)"]


def require_a_good_one(result: Calibration, *, remedy: str) -> None:
    """Raise `RimError` with the reasons where a calibration should not be used; nothing was written."""
    if result.refused:
        raise RimError(f"the calibration is refused: {'; '.join(result.refused)}", remedy=remedy)


def write_calibration(
    result: Calibration, *, out: Path, report: Path | None, page: bytes | None, author: str
) -> None:
    """Write the camera file with its arrays, then the report; ``result.camera`` becomes what was written.

    ``author`` is the program, as ``rim calibrate``. Raises `OSError` where the disk refuses.
    """
    accuracy = result.accuracy
    if result.integral and result.integral_accuracy is not None:
        accuracy = result.integral_accuracy
    whose = "held-out poses" if accuracy.held_out else "the fitted poses (too few to hold any out)"
    comment = (
        f"Calibrated by {author} from {several(result.frames, 'frame')} of "
        f"{several(result.poses, 'pose')}.\n"
        f"Corrected distances of {whose}: {accuracy.after * 1e3:.2f} mm RMS, of which noise "
        f"{accuracy.noise * 1e3:.2f} mm; see provenance below."
    )
    result.camera = save_camera_apart(result.camera, out, comment=comment)
    write_page(report, page)


def write_page(report: Path | None, page: bytes | None) -> None:
    """Write a report, where there is one. Raises `OSError` where the disk refuses."""
    if report is not None and page is not None:
        content = page
        write_whole(report, lambda stream: stream.write(content))


def report_of_part(report: Path, part: Part) -> Path:
    """Return the report's name for one part of a camera: its own where the part has no name."""
    if not part.name:
        return report
    return report.with_name(report.name.removesuffix(".report.html") + f".{part.name}.report.html")
