"""The process that records live topics for the calibration node, so that a slow disk does not delay the node.

Started by `rim_camera_ros.nodes.calibration.supervision` as ``python -m``; not meant to be run by hand.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import RecordingWriter, Topics
from rim_camera_ros.coverage.picture import print_report
from rim_camera_ros.errors import RimError
from rim_camera_ros.nodes.calibration.link import Link, serve
from rim_camera_ros.nodes.common.recorder import record


def work(link: Link) -> Mapping[str, Any]:
    """Record as ``link.request`` says (see `parameters.recording_of`), until asked to finish.

    Raises `RimError` where no frame came or the recording cannot be written; no files remain then.
    """
    given = link.request
    topics, frames = Topics(namespace=given["namespace"]), given["frames"] or None
    with RecordingWriter(Path(given["output"]), topics=topics) as writer:
        recorded = record(
            topics,
            writer,
            frames=frames,
            duration=None,
            show=lambda done: link.progress("frames", done, frames),
            stopped=lambda: link.finishing or link.cancelled,
            known=None if given["known"] is None else (Path(given["known"][0]), Path(given["known"][1])),
            report=print_report,
            hurried=lambda: link.cancelled,
        )
        if link.cancelled:
            raise RimError("cancelled; nothing was written")
        if recorded == 0:
            raise RimError(
                f"no frame came on {topics['distance']}",
                remedy="is a driver running, in this ROS domain and namespace?",
            )
    return {"file": given["output"], "frames": recorded}


def main() -> int:
    """Record as the node asks on standard input."""
    serve(work, keep=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
