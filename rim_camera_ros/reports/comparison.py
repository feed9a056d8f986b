"""Where and by how much two camera files differ: corrected distances over the image, effects, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects import known_effects
from rim_camera_ros.info.text import table
from rim_camera_ros.parameters import arrays_of, encode
from rim_camera_ros.reports.calibration_text import number_of, unit_of
from rim_camera_ros.reports.walls import Wall, difference, distances_of, setting_of
from rim_camera_ros.reports.words import joined, millimetres

Array = NDArray[Any]

#: Relative difference of two numbers below which they are the same, as files print them.
_SAME = 1e-9
#: Distances at which the difference is taken.
_DISTANCES = 5
#: Numbers that the text on a terminal shows, at most.
_MOST_NUMBERS = 20
FORMAT = "rim_comparison/1"


@dataclass(frozen=True)
class EffectDifference:
    """An effect that the files state differently: where it ``stands`` (both, first, second), and its change
    of corrected distances [m], RMS over image and distances; None where no wall shows it.
    """

    effect: str
    stands: str
    rms: float | None


@dataclass(frozen=True)
class NumberDifference:
    """A number that differs, None where a file has none; ``sigmas``: the difference in standard deviations
    of both files' covariances together, None where neither states any.
    """

    path: str
    one: float | None
    other: float | None
    unit: str
    sigmas: float | None


@dataclass(frozen=True)
class Comparison:
    """How the second of two files differs from the first.

    ``maps`` (H, W) [m]: second minus first corrected distance of each of ``walls``, NaN where a file allows
    none. ``rays`` (H, W, 2) [px]: where the second file's rays meet the first one's image plane, less the
    pixel.
    """

    walls: tuple[Wall, ...]
    maps: tuple[Array, ...]
    rays: Array
    effects: tuple[EffectDifference, ...]
    numbers: tuple[NumberDifference, ...]

    @property
    def rms(self) -> float:
        """RMS difference of corrected distances [m], NaN where nothing can be compared."""
        return rms_of(self.maps)

    @property
    def most(self) -> float:
        """Greatest difference of corrected distances [m] but for 1 % of the values."""
        values = np.abs(np.concatenate([field[np.isfinite(field)] for field in self.maps]))
        return float(np.quantile(values, 0.99)) if values.size else float("nan")


def compare(file: Camera, other: Camera) -> Comparison:
    """Compare two camera files of a sensor.

    The comparison is of a grey wall across the axis, seen by a warm camera, at distances where both are
    valid. Raises `InputError` where the sensors have other sizes or modulation frequencies.
    """
    setting = setting_of(file, other)
    walls = tuple(Wall(distance, setting) for distance in distances_of(file, other, count=_DISTANCES))
    maps = tuple(difference(file, other, wall) for wall in walls)
    effects = []
    known = known_effects()
    for name in known:
        mine, theirs = file.effects.get(name), other.effects.get(name)
        if _plain(mine) == _plain(theirs):
            continue
        stands = "both" if mine and theirs else "first" if mine else "second"
        swapped = {key: value for key, value in file.effects.items() if key != name}
        if theirs is not None:
            swapped[name] = theirs
        rms = None
        if known[name].shows_on_a_wall:
            moved = with_effects(replace(file, effects={}), swapped)
            rms = rms_of([difference(file, moved, wall) for wall in walls])
        effects.append(EffectDifference(name, stands, rms))
    effects.sort(key=lambda found: -(found.rms or 0.0))
    return Comparison(walls, maps, _rays(file, other), tuple(effects), tuple(_numbers(file, other)))


def _plain(effect: Any) -> Any:
    """Return an effect's parameters as plain data that can be compared, whatever its files are called."""
    if effect is None:
        return None
    arrays = list(arrays_of(effect))
    names = {array.file for array in arrays}

    def unnamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: unnamed(inner) for key, inner in value.items()}
        return None if isinstance(value, str) and value in names else value

    return unnamed(encode(effect)), [array.values.tolist() for array in arrays]


def rms_of(images: Sequence[Array]) -> float:
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _rays(file: Camera, other: Camera) -> Array:
    """Return where the second file's rays meet the first one's image plane, less the pixel (H, W, 2) [px]."""
    tangents = [camera.rays[..., :2] / camera.rays[..., 2:] for camera in (file, other)]
    return np.asarray((tangents[1] - tangents[0]) * np.array([file.optics.fx, file.optics.fy]))


def _numbers(file: Camera, other: Camera) -> list[NumberDifference]:
    first, second = camera_numbers(file), camera_numbers(other)
    variances = [_variances(camera) for camera in (file, other)]
    found = []
    for path in dict.fromkeys([*first, *second]):
        a, b = first.get(path), second.get(path)
        if a is not None and b is not None and abs(a - b) <= _SAME * max(abs(a), abs(b)):
            continue
        total = sum(own.get(path, 0.0) for own in variances)
        sigmas = abs(b - a) / total**0.5 if a is not None and b is not None and total > 0 else None
        found.append(NumberDifference(path, a, b, unit_of(file if a is not None else other, path), sigmas))
    return found


def _variances(camera: Camera) -> dict[str, float]:
    if camera.covariance is None:
        return {}
    diagonal = np.diag(camera.covariance.matrix.values).tolist()
    return dict(zip(camera.covariance.parameters, diagonal, strict=True))


# --- words -----------------------------------------------------------------------------------------


def first_sentence(found: Comparison) -> str:
    """Return in a sentence by how much the files differ, where, and by which effect most."""
    if not found.numbers and not found.effects:
        return "The camera files say the same."
    near, far = found.walls[0].distance, found.walls[-1].distance
    if not np.isfinite(found.rms):
        return f"No pixel of a wall between {near:.2g} and {far:.2g} m is valid by both files."
    words = (
        f"Corrected distances differ by {millimetres(found.rms)} (RMS; 99 % by less than "
        f"{millimetres(found.most)}) between {near:.2g} and {far:.2g} m"
    )
    led = [
        effect
        for effect in found.effects
        if effect.rms is not None and effect.rms > 0.1 * max(found.rms, 1e-9)
    ][:2]
    if led:
        most = [f"{change.effect} ({millimetres(change.rms)})" for change in led if change.rms]
        words += f", most by {joined(most)}"
    aside = float(np.sqrt(np.nanmean(np.sum(found.rays**2, axis=-1))))
    if aside > 1e-3:
        words += f"; rays by {aside:.2g} px (RMS)"
    return f"{words}."


def effect_rows(found: Comparison, names: Sequence[str]) -> list[list[str]]:
    """Return the effects that differ; ``names`` are those of the files."""
    stands = {"both": "in both, with other parameters", "first": f"only in {names[0]}"}
    stands["second"] = f"only in {names[1]}"
    known = known_effects()
    return [
        [
            f"{known[effect.effect].title} ({effect.effect})",
            stands[effect.stands],
            "not seen on a wall" if effect.rms is None else f"{effect.rms * 1e3:.3f} mm",
        ]
        for effect in found.effects
    ]


def number_rows(found: Comparison) -> list[list[str]]:
    """Return the numbers that differ."""
    return [
        [
            number.path.removeprefix("effects."),
            number_of(number.one),
            number_of(number.other),
            number_of(number.other - number.one)
            if number.one is not None and number.other is not None
            else "-",
            "-" if number.sigmas is None else f"{number.sigmas:.1f}",
            number.unit,
        ]
        for number in found.numbers
    ]


def distance_rows(found: Comparison) -> list[list[str]]:
    """Return the differences [mm] at each distance."""
    rows = []
    for wall, image in zip(found.walls, found.maps, strict=True):
        values = image[np.isfinite(image)] * 1e3
        if values.size:
            spread = [f"{x:+.2f}" for x in np.quantile(values, [0.01, 0.5, 0.99])]
            rms = float(np.sqrt(np.mean(values**2)))
            rows.append([f"{wall.distance:.2f} m", f"{rms:.2f}", *spread, f"{values.size / image.size:.0%}"])
        else:
            rows.append([f"{wall.distance:.2f} m", "-", "-", "-", "-", "0%"])
    return rows


DISTANCE_HEADINGS = ("wall at", "RMS [mm]", "1 % below", "median", "99 % below", "valid pixels")
EFFECT_HEADINGS = ("effect", "stands", "changes distances by (RMS)")
NUMBER_HEADINGS = ("number", "first", "second", "difference", "in sigmas", "unit")


def comparison_text(found: Comparison, names: Sequence[str]) -> str:
    """Return the comparison for a terminal."""
    parts = [first_sentence(found), f"second minus first; first: {names[0]}, second: {names[1]}"]
    parts.append(table(DISTANCE_HEADINGS, distance_rows(found)))
    if found.effects:
        parts.append(table(EFFECT_HEADINGS, effect_rows(found, ("first", "second")), left=2))
    rows = number_rows(found)
    if rows:
        parts.append(table(NUMBER_HEADINGS, rows[:_MOST_NUMBERS]))
        if len(rows) > _MOST_NUMBERS:
            parts[-1] += f"\n  and {len(rows) - _MOST_NUMBERS} numbers more, see --out or --json"
    return "\n\n".join(parts)


def comparison_json(found: Comparison, names: Sequence[str]) -> dict[str, Any]:
    """Return the comparison for a program; lengths in metres, numbers that are not finite as None."""

    def finite(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return {
        "format": FORMAT,
        "files": list(names),
        "rms": finite(found.rms),
        "most": finite(found.most),
        "walls": [
            {"distance": wall.distance, "setting": wall.integration_time, "rms": finite(rms_of([image]))}
            for wall, image in zip(found.walls, found.maps, strict=True)
        ],
        "rays_px": finite(float(np.sqrt(np.nanmean(np.sum(found.rays**2, axis=-1))))),
        "effects": [vars(effect) for effect in found.effects],
        "numbers": [vars(number) for number in found.numbers],
    }
