"""``rim camera``: a recording makes a first camera file."""

from __future__ import annotations

import argparse
import datetime
from pathlib import Path

from rim_camera_ros import __version__
from rim_camera_ros.bags import Recording
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.commands.common import (
    Progress,
    add_command,
    add_output,
    add_profile,
    add_topics,
    check_file,
    check_outputs,
    positive,
    reading_notes,
    say,
    topics_of,
)
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.first_camera.estimate import FirstCamera, Stated, first_camera
from rim_camera_ros.first_camera.text import camera_text
from rim_camera_ros.imports.profile import load_profile
from rim_camera_ros.info.text import section, several
from rim_camera_ros.yaml_files import write_whole

_HEADING = """Camera file made by rim camera from {bag}.
It says how the camera counts, looks and trembles; what is wrong with its distances is not known yet:
rim calibrate finds that. What is marked ASSUMED should be looked up and changed."""

_EXAMPLES = """
rim camera bag --out camera.yaml
rim camera bag --out camera.yaml --reflectivity 0.9 --region 80 60 110 90    # a white wall there
rim camera bag --out camera.yaml --modulation-frequency 30e6 --integration-time 30
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Describe the command."""
    parser = add_command(
        commands,
        "camera",
        "Make a first camera file from a recording. Geometry from camera_info, step and saturation of the "
        "counts, noise from repeated frames with its uncertainty, gain from a surface of known reflectivity; "
        "every key has a comment that says where its value is from.",
        _EXAMPLES,
    )
    parser.add_argument(
        "bag", metavar="BAG", type=Path, help="recording, as rim import or rim record writes it"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="camera file to write")
    parser.add_argument("--device", help="name of the camera (the recording's)")
    for option, metavar, text in (
        ("--modulation-frequency", "HZ", "instead of the recorded one"),
        ("--integration-time", "T", "setting of recordings that state none, in the device's own unit"),
        ("--distance-lsb", "M", "metres per count"),
        ("--saturation", "COUNTS", "amplitude at which a pixel saturates"),
    ):
        parser.add_argument(option, type=positive(float), metavar=metavar, help=text)
    parser.add_argument(
        "--reflectivity",
        type=positive(float),
        metavar="R",
        help="diffuse reflectivity (0..1) of the surface in the region (0.5 is assumed)",
    )
    parser.add_argument(
        "--reflectivity-sigma",
        type=positive(float),
        default=0.1,
        metavar="S",
        help="its relative 1-sigma (0.1)",
    )
    parser.add_argument(
        "--region",
        type=int,
        nargs=4,
        metavar=("U0", "V0", "U1", "V1"),
        help="pixels on that surface, a plane (the middle of the image)",
    )
    add_topics(parser)
    add_profile(parser)
    add_output(parser)
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Read the recording, write the file, and print the sources of its values."""
    check_outputs({"--out": given.out}, [given.bag])
    check_file(given.out, force=given.force)
    if given.reflectivity is not None and given.reflectivity > 1:
        raise InputError(f"must be at most 1, found {given.reflectivity:g}", place="--reflectivity")
    lsb = given.distance_lsb
    if lsb is None and given.profile is not None:
        lsb = load_profile(given.profile).distance.unit
    stated = Stated(
        device=given.device,
        modulation_frequency=given.modulation_frequency,
        integration_time=given.integration_time,
        distance_lsb=lsb,
        saturation=given.saturation,
        reflectivity=given.reflectivity,
        reflectivity_sigma=given.reflectivity_sigma,
        region=None if given.region is None else tuple(given.region),
    )
    provenance = {
        "program": f"rim_camera_ros {__version__}",
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": "rim camera",
        "recording": given.bag.name,
    }
    with (
        Recording(given.bag, topics=topics_of(given)) as bag,
        Progress("read", bag.frame_count, quiet=given.quiet) as progress,
    ):
        try:
            found = first_camera(progress.over(bag.frames()), stated, provenance=provenance)
        except RimError as error:
            raise error.located(given.bag) from None
    text = camera_text(found.camera, why=found.why, heading=_HEADING.format(bag=given.bag.name))
    write_whole(given.out, lambda stream: stream.write(text.encode()))
    load_camera(given.out)
    # notes of the reader on absent settings are replaced by notes with a remedy
    say(given, [*found.notes, *(note for note in reading_notes(bag) if "camera file" not in note)])
    if not given.quiet:
        print(_summary(found, given.out))
    return 0


def _summary(found: FirstCamera, out: Path) -> str:
    camera = found.camera
    noise, rows = found.noise, []
    o, s = camera.optics, camera.sensor
    rows.append(("camera", f"{camera.device}, {s.width} x {s.height} px, focal length {o.fx:.1f} px"))
    step = "c / (2 f) / 65536" if s.distance_lsb is None else f"{s.distance_lsb * 1e3:.4g} mm"
    rows.append(
        ("step", f"{step}; distances {'wrap at' if s.wraps else 'do not wrap at'} {s.ambiguity:.3g} m")
    )
    rows.append(("saturation", f"{s.saturation:g} counts"))
    if noise is not None:
        n, e = noise.noise, noise.sigma
        rows.append(
            (
                "noise",
                f"floor {n.floor * 1e3:.2f} +- {e.floor * 1e3:.2f} mm, shot {n.shot:.3g} +- {e.shot:.2g} "
                f"m sqrt(counts), amplitude {n.amplitude:.3g} +- {e.amplitude:.2g} m counts",
            )
        )
    rows.append(("gain", f"{found.gain.value:.4g} +- {found.gain.relative_sigma:.0%}"))
    frames = several(int(camera.provenance["frames"]), "frame")
    return f"{section('', rows)}\n{frames} read, camera file written: {out}"
