"""``rim import``: a recording of another driver becomes one of this package."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

from rim_camera_ros.bags.topics import Topics
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    check_outputs,
    positive,
    say,
)
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.imports.convert import convert
from rim_camera_ros.imports.profile import Profile, load_profile, shipped_profiles
from rim_camera_ros.imports.reading import DriverRecording, Given
from rim_camera_ros.imports.sources import find_sources, recognise, with_options
from rim_camera_ros.info.text import several, table

#: Roles whose topics the options may name.
_ROLES = ("distance", "amplitude", "camera_info")

_EXAMPLES = """
rim import --list                                     # the drivers that are known
rim import kinect_bag --out bag                       # the driver is recognised by its topics
rim import bag_of_a_femto --profile orbbec_femto --out bag
rim import other.bag --profile my_driver.yaml --integration-time 12 --out bag
rim import other.bag --topic distance=/depth --topic amplitude=/ir --distance-kind radial --out bag
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "import",
        "Turn another driver's recording into one that rim reads. A profile says what the driver's topics "
        "mean; depth along z becomes radial distance, lens models become plumb_bob (with the residual), "
        "compressed images are unpacked, images up to half a period apart are paired.",
        _EXAMPLES,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, nargs="?", help="recording: rosbag2 or ROS 1")
    parser.add_argument("--out", type=Path, metavar="BAG", help="recording to write (mcap)")
    parser.add_argument("--profile", metavar="NAME|FILE", help="driver's profile (recognised by the topics)")
    parser.add_argument("--list", action="store_true", help="list the profiles, and what each was read from")
    parser.add_argument("--namespace", help="namespace of the topics (the one below which both images lie)")
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="ROLE=NAME",
        help="topic of distance, amplitude or camera_info instead of the profile's",
    )
    parser.add_argument("--distance-kind", choices=("z", "radial", "points"), help="instead of the profile's")
    parser.add_argument(
        "--distance-unit", type=positive(float), metavar="M", help="metres per count of a 16-bit distance"
    )
    parser.add_argument("--distance-offset", type=float, metavar="M", help="metres of count 0")
    parser.add_argument(
        "--amplitude-counts",
        type=positive(float),
        metavar="COUNTS",
        help="counts of one grey value of an 8-bit amplitude (1)",
    )
    parser.add_argument(
        "--camera-info",
        type=Path,
        metavar="FILE",
        help="calibration as camera_calibration writes it, instead of the recorded camera_info",
    )
    parser.add_argument(
        "--rectified", action="store_true", help="the images are rectified: P of camera_info holds"
    )
    parser.add_argument(
        "--integration-time",
        type=positive(float),
        metavar="T",
        help="setting of all frames, in the device's own unit, instead of the recorded one",
    )
    parser.add_argument(
        "--modulation-frequency", type=positive(float), metavar="HZ", help="instead of the profile's"
    )
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Find the driver, read, write."""
    if given.list:
        print(_listed())
        return 0
    if given.bag is None:
        raise InputError("no recording is given", place="BAG", remedy="rim import BAG --out BAG2")
    if given.out is None:
        raise InputError("nothing says where to write", place="--out", remedy="rim import BAG --out BAG2")
    check_outputs({"--out": given.out}, [given.bag, given.camera_info])
    named = _named(given)
    stated = Given(
        integration_time=given.integration_time,
        modulation_frequency=given.modulation_frequency,
        camera_info=given.camera_info,
    )
    with DriverRecording(given.bag, stated) as recording:
        try:
            profile = _profile(given, recording.types, named)
            namespace = None if given.namespace is None else given.namespace.rstrip("/")
            sources = find_sources(profile, recording.types, namespace=namespace, named=named)
        except RimError as error:
            raise error.located(given.bag) from None
        total = recording.prepare(sources)
        with Progress("imported", total, quiet=given.quiet) as progress:
            done = convert(recording, given.out, force=given.force, counted=progress.over)
    skipped = [f"excluded: {number} {why}" for why, number in recording.skipped.items() if number]
    say(given, [*recording.notes, *skipped])
    if not given.quiet:
        poses = f" and {several(done.poses, 'true pose')}" if done.poses else ""
        print(f"{several(done.frames, 'frame')}{poses} imported from {profile.driver}: {given.out}")
    return 0


def _profile(given: argparse.Namespace, types: dict[str, str], named: dict[str, str]) -> Profile:
    if given.profile is not None:
        profile = load_profile(given.profile)
    elif {"distance", "amplitude"} <= named.keys() and given.distance_kind is not None:
        profile = replace(load_profile("template"), driver="topics named by --topic", name="", notes=())
    else:
        own = Topics()
        if own["distance"] in types and own["amplitude"] in types:
            raise InputError(
                "the topics are this package's own already", remedy="no import is needed: rim info BAG"
            )
        profile = recognise(types, namespace=given.namespace)
    if given.distance_offset is not None and not math.isfinite(given.distance_offset):
        raise InputError("must be finite", place="--distance-offset")
    if given.rectified:
        profile = replace(profile, camera_info=replace(profile.camera_info, rectified=True))
    return with_options(
        profile,
        kind=given.distance_kind,
        unit=given.distance_unit,
        offset=given.distance_offset,
        counts=given.amplitude_counts,
    )


def _named(given: argparse.Namespace) -> dict[str, str]:
    """Return the topics that --topic names; the checks of names are those of all commands."""
    overrides = Topics.parse(given.topic).overrides
    for role in overrides:
        if role not in _ROLES:
            raise InputError(
                f"the role {role} is not imported", place="--topic", remedy=f"roles: {', '.join(_ROLES)}"
            )
    return dict(overrides)


def _listed() -> str:
    rows, sources = [], []
    for name in shipped_profiles():
        profile = load_profile(name)
        meaning = {"z": "depth along z", "radial": "radial", "points": "points"}[profile.distance.kind]
        rows.append([name, profile.device, profile.distance.topics[0], meaning, profile.amplitude.topics[0]])
        sources += [f"  {name}: {source}" for source in profile.source]
    head = ["profile", "camera", "distance", "is", "amplitude"]
    return f"{table(head, rows, left=5)}\n\nread from\n" + "\n".join(sources)
