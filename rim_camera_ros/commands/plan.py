"""``rim plan``: the shortest set of experiments that determines everything."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from rim_camera_ros.commands.common import Stages, add_command, camera_of

_EXAMPLES = """
rim plan --camera sr3000
rim plan --camera camera.yaml --json
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "plan",
        "Find the recordings that determine a camera. Says before recording which of the shipped experiments "
        "determine which effects, all of them estimated jointly, and prints the shortest set that "
        "determines as much as all together.",
        _EXAMPLES,
    )
    parser.add_argument("--camera", required=True, help="camera file, or the name of a shipped one")
    parser.add_argument("--json", action="store_true", help="print the plan as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Analyse the experiments and print the plan."""
    camera = camera_of(given.camera)
    from rim_camera_ros.calibrate.plan import plan, shipped_experiments, table

    with Stages(quiet=given.quiet) as stages:
        result = plan(camera, shipped_experiments(), progress=stages.show)
    print(json.dumps(asdict(result), indent=1) if given.json else table(result))
    return 0
