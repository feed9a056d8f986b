"""Camera files (``rim_camera/1``): read with all checks, written completely or not at all."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from rim_camera_ros.camera import Camera, Covariance, Radiometry, Sensor, Validity
from rim_camera_ros.effects import SECTIONS, Effect, known_effects
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.measurement import TYPES, Measurement, measurement_of
from rim_camera_ros.measurement.per_frequency import documents, merged
from rim_camera_ros.measurement.several_frequencies import SeveralFrequencies
from rim_camera_ros.noise import Noise
from rim_camera_ros.optics import Optics
from rim_camera_ros.parameters import ArrayFile, arrays_of, decode, encode, flatten, quantity, with_values
from rim_camera_ros.yaml_files import Document, read_yaml, write_whole, write_yaml

CAMERA_FORMAT = "rim_camera/1"

_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class _File:
    """The keys of a camera file."""

    sensor: Sensor
    optics: Optics
    format: str = CAMERA_FORMAT
    device: str = "unnamed"
    radiometry: Radiometry = field(default_factory=Radiometry)
    noise: Noise = field(default_factory=Noise)
    minimum_amplitude: float | None = quantity(
        "counts",
        "below it flag 1 and no point; null: where the amplitude term's noise exceeds the range noise",
        default=None,
        minimum=0.0,
    )
    effects: Any = None
    validity: Validity = field(default_factory=Validity)
    covariance: Covariance | None = None
    provenance: Any = None
    measurement: Any = None


def load_camera(path: str | os.PathLike[str]) -> Camera:
    """Read a camera file with the arrays that it names.

    Raises `InputError` (file, place with line, problem, remedy) for any error in it, such as maps of the
    wrong shape or outside the file's folder, and lens models that cannot be inverted.
    """
    document = read_yaml(path)
    if not isinstance(document.data, dict):
        raise document.error((), "not a camera file", f"expected format: {CAMERA_FORMAT}")
    if document.data.get("format") != CAMERA_FORMAT:
        place = ("format",) if "format" in document.data else ()
        raise document.error(
            place,
            f"not a camera file: format is {document.data.get('format')!r}",
            f"expected format: {CAMERA_FORMAT}",
        )
    parts = documents(document)
    if len(parts) == 1:
        return _checked(_camera(document), document)
    stated = document.data.get("measurement") or {"type": SeveralFrequencies.type}
    measurement = _decode_measurement(stated, document)
    if not isinstance(measurement, SeveralFrequencies):
        raise document.error(
            ("measurement", "type"), "has one modulation frequency", f"give type: {SeveralFrequencies.type}"
        )
    return _checked(measurement.camera_of(tuple(_camera(part) for part in parts)), document)


def _checked(camera: Camera, document: Document) -> Camera:
    try:
        measurement_of(camera).check(camera)
    except ValueError as error:
        raise document.error(("measurement",), str(error)) from None
    return camera


def _camera(document: Document) -> Camera:
    """Return the camera of a document with one modulation frequency."""
    content = decode(_File, document.data, document)
    provenance = content.provenance if content.provenance is not None else {}
    if not isinstance(provenance, dict):
        raise document.error(("provenance",), "expected a group of keys")
    values = {
        attribute.name: getattr(content, attribute.name)
        for attribute in fields(_File)
        if attribute.name != "format"
    }
    values["effects"] = _EMPTY
    values["provenance"] = MappingProxyType(provenance)
    values["measurement"] = _decode_measurement(content.measurement, document)
    camera = Camera(**values)
    try:
        camera.rays  # noqa: B018 -- the lens model must be invertible
    except ValueError as error:
        raise document.error(("optics", "d"), str(error).removeprefix("optics.d: ")) from None
    camera = replace(camera, effects=_decode_effects(content.effects, camera, document))
    if camera.covariance is not None:
        known = camera_numbers(camera)
        for i, name in enumerate(camera.covariance.parameters):
            if name not in known:
                raise document.error(
                    ("covariance", "parameters", i), f"unknown parameter '{name}'", nearest_name(name, known)
                )
    return camera


def _decode_effects(data: Any, camera: Camera, document: Document) -> Mapping[str, Effect]:
    if data is None:
        return _EMPTY
    if not isinstance(data, dict):
        raise document.error(("effects",), "expected a group of effects by name")
    known = known_effects()
    for name in data:
        if name in SECTIONS:
            raise document.error(
                ("effects", name),
                "has no parameters here",
                f"they belong to the section '{SECTIONS[name].section}'",
            )
        if name not in known:
            raise document.error(("effects", name), "unknown effect", nearest_name(name, known))
    effects: dict[str, Effect] = {}
    for name, kind in known.items():
        if name in data:
            effects[name] = decode(kind, data[name], document, ("effects", name))
            try:
                effects[name].check(camera)
            except ValueError as error:
                raise document.error(("effects", name), str(error)) from None
    return MappingProxyType(effects)


def _decode_measurement(data: Any, document: Document) -> Measurement | None:
    if data is None:
        return None
    if not isinstance(data, dict) or "type" not in data:
        raise document.error(("measurement",), "expected a group of keys with a type", f"one of: {_types()}")
    if data["type"] not in TYPES:
        raise document.error(("measurement", "type"), "unknown type", f"one of: {_types()}")
    keys = {key: value for key, value in data.items() if key != "type"}
    return decode(TYPES[data["type"]], keys, document, ("measurement",))


def _types() -> str:
    return ", ".join(TYPES)


def with_effects(camera: Camera, effects: Mapping[str, Effect]) -> Camera:
    """Return the camera with these effects, ordered along the light and checked.

    Raises `InputError` for an unknown name or parameters that do not fit the camera.
    """
    known = known_effects()
    for name in effects:
        if name not in known:
            raise InputError(f"unknown effect '{name}'", remedy=nearest_name(name, known))
    ordered = {name: effects[name] for name in known if name in effects}
    for name, effect in ordered.items():
        try:
            effect.check(camera)
        except ValueError as error:
            raise InputError(str(error), place=f"effects.{name}") from None
    return replace(camera, effects=MappingProxyType(ordered))


def in_order(camera: Camera) -> Camera:
    """Return the camera with its effects ordered along the light and checked, as `with_effects` does."""
    return with_effects(camera, camera.effects)


def added(camera: Camera, effect: Effect) -> Camera:
    """Return the camera with one effect more, in the order along the light. Raises as `with_effects`."""
    return with_effects(camera, {**camera.effects, effect.name: effect})


def lean_camera(camera: Camera) -> Camera:
    """Return the camera without parts of its effects that do nothing; itself if there are none."""
    lean = {name: effect.lean() for name, effect in camera.effects.items()}
    same = all(lean[name] is effect for name, effect in camera.effects.items())
    return camera if same else with_effects(camera, lean)


def camera_numbers(camera: Camera) -> dict[str, float]:
    """Return every float of a camera by dotted path, effects as ``effects.NAME.PATH``."""
    numbers: dict[str, float] = {}
    for section in ("sensor", "optics", "radiometry", "noise"):
        numbers.update(flatten(getattr(camera, section), f"{section}."))
    for name, effect in camera.effects.items():
        numbers.update(flatten(effect, f"effects.{name}."))
    return numbers


def with_numbers(camera: Camera, numbers: Mapping[str, float]) -> Camera:
    """Return the camera with the numbers at dotted paths replaced. Raises KeyError for an unknown path."""
    by_section: dict[str, dict[str, float]] = {}
    for path, value in numbers.items():
        section, _, rest = path.partition(".")
        if section == "effects":
            name, _, rest = rest.partition(".")
            section = f"effects.{name}"
        by_section.setdefault(section, {})[rest] = value
    effects = dict(camera.effects)
    sections: dict[str, Any] = {}
    for section, values in by_section.items():
        if section.startswith("effects."):
            name = section.removeprefix("effects.")
            if name not in effects:
                raise KeyError(section)
            effects[name] = with_values(effects[name], values)
        elif section in ("sensor", "optics", "radiometry", "noise"):
            sections[section] = with_values(getattr(camera, section), values)
        else:
            raise KeyError(section)
    return with_effects(replace(camera, **sections), effects)


def draw_parameters(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return the camera with its parameters drawn from the stated covariance around their values.

    Raises `InputError` where the file states no covariance.
    """
    if camera.covariance is None:
        raise InputError("the camera file states no covariance", place="covariance")
    numbers = camera_numbers(camera)
    names = camera.covariance.parameters
    mean = np.array([numbers[name] for name in names])
    drawn = rng.multivariate_normal(mean, camera.covariance.matrix.values, method="eigh")
    return with_numbers(camera, dict(zip(names, drawn.tolist(), strict=True)))


def save_camera(camera: Camera, path: str | os.PathLike[str], *, comment: str = "") -> None:
    """Write a camera file, and its arrays in the same folder; the YAML file is written last, and atomically.

    Raises `RimError` where it cannot be written; new arrays are removed then.
    """
    path = Path(path)
    arrays = list(arrays_of(camera.measurement))
    for part in camera.channels or (camera,):
        arrays += [array_file for effect in part.effects.values() for array_file in arrays_of(effect)]
        if part.covariance is not None:
            arrays.append(part.covariance.matrix)
    new = [path.parent / array.file for array in arrays if not (path.parent / array.file).exists()]
    try:
        for array in arrays:
            _write_array(path.parent, array)
        write_yaml(path, _document(camera), comment=comment)
    except BaseException:
        for written in new:
            written.unlink(missing_ok=True)
        raise


def save_camera_apart(camera: Camera, path: str | os.PathLike[str], *, comment: str = "") -> Camera:
    """Write a camera file whose arrays are its own: no other file in the folder names them.

    They are called ``STEM.PLACE.CHECKSUM.npy`` after the camera file, so that neither another camera file nor
    the replaced one is damaged, even if writing is interrupted. Arrays of this form that remain from the
    replaced file, and that no YAML file in the folder names, are removed. Returns the camera as written.
    Raises `RimError` where it cannot be written.
    """
    path = Path(path)
    camera = _with_own_arrays(camera, path.stem)
    save_camera(camera, path, comment=comment)
    own = re.compile(re.escape(path.stem) + r"\.[a-z_]+\.[0-9a-f]{8}\.npy")
    stale = [one for one in path.parent.glob("*.npy") if own.fullmatch(one.name)]
    # a copy of the replaced file may be in the same folder
    for other in path.parent.glob("*.y*ml") if stale else ():
        try:
            text = other.read_bytes()
        except OSError:
            # a file that cannot be read may name any of them
            return camera
        stale = [one for one in stale if one.name.encode() not in text]
    for one in stale:
        one.unlink(missing_ok=True)
    return camera


def _with_own_arrays(camera: Camera, stem: str) -> Camera:
    def name(place: str, array_file: ArrayFile) -> ArrayFile:
        values = np.ascontiguousarray(array_file.values)
        text = hashlib.sha256(f"{values.dtype.str}{values.shape}".encode() + values.tobytes()).hexdigest()
        return ArrayFile(f"{stem}.{place}.{text[:8]}.npy", array_file.values)

    effects = {effect: _with_arrays(one, effect, name) for effect, one in camera.effects.items()}
    covariance = camera.covariance
    if covariance is not None:
        covariance = replace(covariance, matrix=name("covariance", covariance.matrix))
    channels = tuple(_with_own_arrays(channel, stem) for channel in camera.channels)
    return replace(camera, effects=MappingProxyType(effects), covariance=covariance, channels=channels)


def _with_arrays(effect: Effect, place: str, name: Callable[[str, ArrayFile], ArrayFile]) -> Effect:
    found = {
        attribute.name: getattr(effect, attribute.name) for attribute in fields(effect) if attribute.init
    }
    renamed = {
        key: name(place, array_file) for key, array_file in found.items() if isinstance(array_file, ArrayFile)
    }
    return replace(effect, **renamed) if renamed else effect


def _document(camera: Camera) -> dict[str, Any]:
    """Return a camera file's content as plain data."""
    if camera.channels:
        data = merged([_document(channel) for channel in camera.channels])
        return {**data, "measurement": {"type": camera.measurement.type, **encode(camera.measurement)}}
    data = {"format": CAMERA_FORMAT, "device": camera.device}
    for section in ("sensor", "optics", "radiometry", "noise"):
        data[section] = encode(getattr(camera, section))
    data["minimum_amplitude"] = camera.minimum_amplitude
    data["effects"] = {name: encode(effect) for name, effect in camera.effects.items()}
    validity = {key: value for key, value in encode(camera.validity).items() if value is not None}
    if validity:
        data["validity"] = validity
    if camera.covariance is not None:
        data["covariance"] = encode(camera.covariance)
    if camera.provenance:
        data["provenance"] = encode(camera.provenance)
    if camera.measurement is not None:
        data["measurement"] = {"type": camera.measurement.type, **encode(camera.measurement)}
    return data


def _write_array(folder: Path, array_file: ArrayFile) -> None:
    path = folder / array_file.file
    if folder.is_dir() and not path.parent.exists():
        path.parent.mkdir(parents=True)
    values = array_file.values
    write_whole(path, lambda stream: np.save(stream, values, allow_pickle=False))
