#!/usr/bin/env python3
"""Write a scene file of a distance calibration on a track line: a plate that a trolley moves along the optical axis.

As in Kahlmann 2007, sec. 3.3.8: equidistant stations forth and back, at 20 degC, after the camera has warmed up. The thesis took 50
frames a station with the SR-3000 (10 with the SR-2), forth and back three times; the shipped file has 2 frames and one round trip to
keep the recording small.
"""

import argparse
import sys

import numpy as np


def scene(
    *, start, stop, step, frames, rate, rounds, integration_time, warm_up, pause, size, reflectivity, command
):
    """Return the text of the scene file."""
    forth = start + step * np.arange(int(np.floor((stop - start) / step + 1e-9)) + 1)
    distances = np.concatenate([forth, forth[::-1]] * rounds)
    lines = [
        "# Track line: the distance calibration of Kahlmann 2007, sec. 3.3.8, figs. 3.43 and 3.44. A white plate on a motorised trolley stands",
        f"# perpendicular to the optical axis, {start:g} to {distances.max():g} m away in steps of {step:g} m, forth and back, {len(distances)} stations of {frames} frames.",
        "# The laboratory is at 20 degC and behind the plate is nothing that returns light. The camera has been on for "
        f"{warm_up:g} s: drift",
        f"# is over (sec. 3.3.7). {pause:g} s pass from station to station. Metres, seconds, degrees Celsius; positions in the optical frame",
        "# (x right, y down, z forward). What it is for: cyclic_error, amplitude_offset, distance_scale, integration_time_offset. Below about",
        "# 1 m a white plate saturates at setting 100.",
        "#",
        f"# Generated: {command}",
        "format: rim_scene/1",
        "surfaces:",
        "- name: plate",
        "  type: rectangle",
        f"  size: [{size:.3f}, {size:.3f}]",
        f"  reflectivity: {reflectivity:.3f}",
        f"  pose: {{position: [0.0, 0.0, {distances[0]:.3f}], orientation: [0.0, 0.0, 0.0, 1.0]}}",
        "  pose_sigma: [5.0e-5, 0.0005]   # the trolley keeps its position to about 50 microns (fig. 3.43); tilt assumed",
        "schedule:",
    ]
    for i, distance in enumerate(distances):
        settings = f"integration_time: {integration_time:g}, uptime: {warm_up + i * pause:.1f}, ambient: 20.0"
        lines.append(
            f"- {{frames: {frames}, rate: {rate:.1f}, {settings}, poses: {{plate: {{position: [0.0, 0.0, {distance:.3f}], orientation: [0.0, 0.0, 0.0, 1.0]}}}}}}"
        )
    return "\n".join(lines) + "\n"


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("out", help="scene file to write, - for standard output")
    parser.add_argument("--start", type=float, default=0.3, help="first distance, m")
    parser.add_argument("--stop", type=float, default=7.3, help="last distance, m")
    parser.add_argument("--step", type=float, default=0.05, help="m")
    parser.add_argument("--frames", type=int, default=2, help="frames a station")
    parser.add_argument("--rate", type=float, default=10.0, help="frames a second")
    parser.add_argument("--rounds", type=int, default=1, help="times forth and back")
    parser.add_argument("--integration-time", type=float, default=100, help="in the device's own unit")
    parser.add_argument("--warm-up", type=float, default=360.0, help="uptime at the first station, s")
    parser.add_argument("--pause", type=float, default=10.0, help="from station to station, s")
    parser.add_argument("--size", type=float, default=1.0, help="of the square plate, m")
    parser.add_argument("--reflectivity", type=float, default=0.85, help="of the plate")
    options = vars(parser.parse_args(arguments))
    if (
        options["step"] <= 0
        or options["start"] <= 0
        or options["stop"] < options["start"]
        or min(options["frames"], options["rounds"]) < 1
    ):
        parser.error("start, step, frames and rounds must be positive, stop not below start")
    out = options.pop("out")
    given = " ".join(
        f"--{name.replace('_', '-')} {value:g}"
        for name, value in options.items()
        if value != parser.get_default(name)
    )
    text = scene(**options, command=f"calibration/tools/make_track_line.py {given}".strip())
    if out == "-":
        sys.stdout.write(text)
    else:
        with open(out, "w", encoding="utf-8") as file:
            file.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
