"""Effects put into real recordings by the forward chain: does a diagnosis name them with what is there?

`python -m test.blind.planted FOLDER --out DIR` takes FOLDER/recording with FOLDER/camera.yaml and a scene
file. Its even frames make a camera file by calibration; its odd frames are diagnosed with that file as
they are (the null), and once with each effect in them. One line a case goes to DIR/results.jsonl, the
table to DIR/summary.md.

The smallest visible size of an effect is that at which it adds as much to chi-square, given offsets of
pixels and offset and tilts of each pose, as stays unexplained without it; effects are put in at 1.5 times it.
Where that is more than any camera has, the recording does not show the effect, which is said and not judged.
Counts are whole numbers already: those of the changed distances are rounded with a dither of half a count, or
codes would be missing where an effect stretches distances.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.frame import RawFrame

from .imperfect.__main__ import RESULTS, SUMMARY, diagnose

Array = NDArray[Any]

#: Effects in multiples of their smallest visible size.
MULTIPLE = 1.5
#: Least mean square, in units of the noise, that counts as unexplained.
_LEAST = 0.02
#: Rounds of offsets of pixels and poses, by turns.
_ROUNDS = 4


def _amplitude(size: float, camera: Camera, level: float) -> Effect:
    return AmplitudeOffset({1.0: Hyperbola(size * level, 0.0)})


def _scattered(size: float, camera: Camera, level: float) -> Effect:
    width = camera.sensor.width / 12
    return Scattering((Kernel(min(size, 0.9), (width, width)),))


#: By name: the effect at a size (m, or relative), for a median amplitude [counts]; a small size, and the
#: largest that a camera may have.
EFFECTS: Mapping[str, tuple[Callable[[float, Camera, float], Effect], float, float]] = {
    "amplitude_offset": (_amplitude, 0.001, 0.1),
    "cyclic_error": (lambda size, camera, level: CyclicError((Harmonic(4, size, 0.7),)), 0.001, 0.1),
    "scattering": (_scattered, 0.01, 0.9),
    "emitter_offset": (lambda size, camera, level: EmitterOffset((size, -0.6 * size, 0.0)), 0.01, 0.3),
    "distance_scale": (lambda size, camera, level: DistanceScale(size), 0.001, 0.05),
}
_DITHER = 20261126


def half_of(folder: Path, half: int, step: int, every: int) -> Iterator[RawFrame]:
    """Yield every ``every``-th frame of a half (0: even) with every ``step``-th pixel."""
    pick = np.s_[step // 2 :: step, step // 2 :: step]
    with Recording(folder / "recording") as bag:
        for number, frame in enumerate(bag.frames()):
            if number % 2 == half and number // 2 % every == 0:
                yield replace(
                    frame,
                    distance=np.ascontiguousarray(frame.distance[pick]),
                    amplitude=np.ascontiguousarray(frame.amplitude[pick]),
                    intrinsics=None,
                )


def planted(frame: RawFrame, effect: Effect, camera: Camera) -> RawFrame:
    """Return a frame as the camera had recorded it with an effect more."""
    seen, light = _signal(frame, camera)
    after = effect.simulate(light, _context(frame, camera))
    with np.errstate(invalid="ignore"):
        dither = np.random.default_rng([_DITHER, frame.stamp]).uniform(-0.5, 0.5, seen.shape)
        distance = np.round(after.measured / camera.sensor.lsb + dither)
        amplitude = np.round(after.published_amplitude)
        usable = seen & (distance >= 1) & (distance <= 65535) & (amplitude >= 1)
    return replace(
        frame,
        distance=np.where(usable, distance, 0).astype(np.uint16),
        amplitude=np.where(usable, np.minimum(amplitude, camera.sensor.saturation), 0).astype(np.uint16),
    )


def _signal(frame: RawFrame, camera: Camera) -> tuple[Array, Signal]:
    seen = (frame.distance > 0) & (frame.amplitude > 0)
    distance = np.where(seen, frame.distance * camera.sensor.lsb, np.nan)
    return seen, Signal(distance, np.where(seen, frame.amplitude, 0).astype(float))


def _context(frame: RawFrame, camera: Camera) -> Context:
    return Context(replace(camera, effects={}), frame.settings, stamp=frame.stamp)


def visible(frames: Sequence[RawFrame], name: str, camera: Camera) -> float:
    """Return the mean square of an effect at its small size, in sigmas, given offsets and tilts."""
    make, small, _ = EFFECTS[name]
    effect = make(small, camera, level_of(frames))
    parts = []
    for frame in frames:
        seen, light = _signal(frame, camera)
        change = (effect.simulate(light, _context(frame, camera)).measured - light.distance)[seen]
        rays = camera.rays[seen] * light.distance[seen][:, None]
        weight = camera.noise.sigma_distance(light.amplitude[seen]) ** -2.0
        design = np.c_[np.ones(len(rays)), rays[:, :2]]
        parts.append((np.flatnonzero(seen), change, design, weight))
    offsets = np.zeros(camera.rays[..., 0].size)
    for _ in range(_ROUNDS):
        total, weights = np.zeros((2, offsets.size))
        square, count = 0.0, 0
        for pixels, change, design, weight in parts:
            root = np.sqrt(weight)
            rest = change - offsets[pixels]
            rest = rest - design @ np.linalg.lstsq(design * root[:, None], rest * root, rcond=None)[0]
            square, count = square + float(np.sum(weight * rest**2)), count + len(rest)
            np.add.at(total, pixels, weight * (rest + offsets[pixels]))
            np.add.at(weights, pixels, weight)
        offsets = total / np.maximum(weights, 1e-300)
    return square / count


def level_of(frames: Sequence[RawFrame]) -> float:
    """Return the median amplitude [counts]."""
    return float(np.median(np.concatenate([one.amplitude[one.amplitude > 0] for one in frames])))


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate, put effects in, diagnose, and write the table."""
    parser = argparse.ArgumentParser(
        prog="python -m test.blind.planted", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folder", type=Path, help="folder with recording and camera.yaml")
    parser.add_argument("--scene", type=Path, help="scene file (FOLDER/scene.yaml)")
    parser.add_argument("--out", type=Path, required=True, help="folder for results.jsonl and summary.md")
    parser.add_argument("--step", type=int, default=1, help="every so many pixels of a row and a column (1)")
    parser.add_argument("--every", type=int, default=1, help="every so many frames of a half (1)")
    parser.add_argument("--calibrated", default="amplitude_offset", help="--effects of the calibration")
    parser.add_argument("--effects", default=",".join(EFFECTS), help=f"of {','.join(EFFECTS)} (all)")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    scene = given.scene or given.folder / "scene.yaml"
    camera = _calibrated(given, scene)
    frames = list(half_of(given.folder, 1, given.step, given.every))
    results = given.out / RESULTS
    done = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    left = [one for one in ("null", *given.effects.split(",")) if one not in {line["name"] for line in done}]
    for name in left:
        line: dict[str, Any] = {"name": name}
        shown = frames
        if name != "null":
            rest = max(_all_errors(done[0]["fit"]) - 1.0, _LEAST)
            make, small, largest = EFFECTS[name]
            line["size"] = MULTIPLE * small * float(np.sqrt(rest / visible(frames, name, camera)))
            if line["size"] > largest:
                line |= {"verdict": "not visible", "missing": [], "adjusted": [], "tied": []}
                _keep(done, line, results)
                continue
            effect = make(line["size"], camera, level_of(frames))
            shown = [planted(one, effect, camera) for one in frames]
        line |= _said(given.out / name, shown, scene)
        _keep(done, line, results)
    table = summary(done)
    (given.out / SUMMARY).write_text(table)
    print(table)
    return 0


def _all_errors(fit: Mapping[str, Any]) -> float:
    """Return chi-square per value given what `visible` allows for, not given smooth errors of the poses."""
    every = fit["chi2_all_after"]
    return float(fit["chi2_after"] if every is None else every)


def _keep(done: list[dict[str, Any]], line: dict[str, Any], results: Path) -> None:
    done.append(line)
    with results.open("a") as file:
        file.write(json.dumps(line) + "\n")
    said = "+".join(line["missing"]) or line["verdict"]
    print(f"{line['name']:18s} {said}  {line.get('cpu_seconds', 0.0):.0f} s", flush=True)


def _calibrated(given: argparse.Namespace, scene: Path) -> Camera:
    """Return the camera of the even half, made by `rim calibrate`, with every step-th pixel."""
    made = given.out / "camera.yaml"
    if not made.exists():
        small = given.out / "given"
        small.mkdir(exist_ok=True)
        save_camera(
            decimated_camera(load_camera(given.folder / "camera.yaml"), given.step), small / "camera.yaml"
        )
        with RecordingWriter(given.out / "even", force=True) as writer:
            for frame in half_of(given.folder, 0, given.step, given.every):
                writer.write_raw(frame)
        words = [
            sys.executable,
            "-m",
            "rim_camera_ros.cli",
            "calibrate",
            given.out / "even",
            "--scene",
            scene,
        ]
        words += ["--camera", small / "camera.yaml", "--out", made, "--effects", given.calibrated]
        subprocess.run([*map(str, words), "--force-result", "--quiet"], check=True)
    return load_camera(made)


def _said(folder: Path, frames: Sequence[RawFrame], scene: Path) -> dict[str, Any]:
    """Diagnose frames with the calibrated camera, which lies in the folder above; return what was said."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for one in folder.parent.glob("camera*"):
        shutil.copy(one, folder)
    for one in folder.parent.glob("*.npy"):
        shutil.copy(one, folder)
    shutil.copy(scene, folder / "scene.yaml")
    with RecordingWriter(folder / "recording") as writer:
        for frame in frames:
            writer.write_raw(frame)
    report, error, seconds = diagnose(folder, folder / "diagnosis", Path(__file__).resolve().parents[2])
    if report is None:
        return {
            "verdict": "failed",
            "error": error,
            "missing": [],
            "tied": [],
            "adjusted": [],
            "cpu_seconds": seconds,
        }
    return {
        "verdict": report["verdict"],
        "missing": [one["effect"] for one in report["missing"]],
        "adjusted": [one["effect"] for one in report["adjusted"]],
        "tied": [list(one) for one in report["indistinguishable"]],
        "reason": report.get("reason"),
        "fit": report["fit"],
        "cpu_seconds": seconds,
    }


def judged(line: Mapping[str, Any], null: Mapping[str, Any]) -> tuple[str, list[str]]:
    """Return how an effect was named ("named", "tied", "no") and the wrong names that the null has not.

    A known term that moved is named as well: what was put in may be of its kind.
    """
    names = set(line["missing"]) | set(line["adjusted"])
    true = line["name"]
    alike = {one for group in line["tied"] if true in group for one in group}
    before = set(null["missing"]) | set(null["adjusted"])
    how = "named" if true in names else "tied" if names & alike else "no"
    return how, sorted(set(line["missing"]) - before - alike - {true, "unknown"})


def summary(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a run as a page."""
    null = next(one for one in lines if one["name"] == "null")
    cases = [one for one in lines if one["name"] != "null"]
    text = [
        "| put in | size | said | named | wrong names | chi-square |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    right = wrong = 0
    for one in [null, *cases]:
        judge = one is not null and one["verdict"] != "not visible"
        how, others = judged(one, null) if judge else ("", [])
        right, wrong = right + (how in ("named", "tied")), wrong + bool(others)
        said = "+".join(one["missing"]) or one["verdict"]
        size = f"{one['size']:.3g}" if "size" in one else ""
        square = f"{one['fit']['chi2_after']:.2f}" if "fit" in one else ""
        text.append(f"| {one['name']} | {size} | {said} | {how} | {', '.join(others)} | {square} |")
    count = sum(one["verdict"] != "not visible" for one in cases)
    return "\n".join([*text, "", f"named {right} of {count}, wrong names beside in {wrong}", ""])


if __name__ == "__main__":
    sys.exit(main())
