"""YAML files <-> frozen dataclasses: types, units, bounds, places of errors.

Every parameter group of a camera or scene file is a frozen dataclass. `decode` builds it from YAML data,
`encode` is the inverse. `flatten` and `with_values` access its numbers by dotted path, as a covariance or a
diagnosis names them (``harmonics.0.amplitude``).
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import nearest_name
from rim_camera_ros.limits import fault_of
from rim_camera_ros.npy_files import read_npy
from rim_camera_ros.yaml_files import Document


@dataclass(frozen=True, eq=False)
class ArrayFile:
    """An array that lies in a ``.npy`` file beside the YAML file that names it."""

    file: str
    values: NDArray[Any]

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ArrayFile)
            and self.file == other.file
            and np.array_equal(self.values, other.values, equal_nan=True)
        )

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class NestedList:
    """A rectangular nested list of numbers, of any number of dimensions."""

    values: NDArray[np.float64]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NestedList) and np.array_equal(self.values, other.values)

    __hash__ = None  # type: ignore[assignment]


def quantity(
    unit: str,
    doc: str,
    *,
    default: Any = dataclasses.MISSING,
    minimum: float = -math.inf,
    above: float = -math.inf,
    maximum: float = math.inf,
    below: float = math.inf,
    typical: float | None = None,
    most: int = 1000,
) -> Any:
    """Declare a dataclass field with its unit, a sentence on it, and the bounds of its numbers.

    Files may only contain numbers within `limits.limits`, and lists and groups of at most ``most`` entries.
    ``typical`` is the common size among such cameras: the 1-sigma of a weak prior around 0 (or around the
    default) where a fit needs one.
    """
    metadata = {
        "unit": unit,
        "doc": doc,
        "minimum": minimum,
        "above": above,
        "maximum": maximum,
        "below": below,
        "typical": typical,
        "most": most,
    }
    return dataclasses.field(default=default, metadata=metadata)


def decode[T](cls: type[T], data: Any, document: Document, place: tuple[Any, ...] = ()) -> T:
    """Build the dataclass ``cls`` from plain YAML data.

    Raises `InputError` for an unknown key (stating where it belongs, or the nearest known one), a missing
    key, a wrong type, a number that is not finite or out of bounds, or a value ``__post_init__`` refuses.
    """
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise document.error(place, f"expected a group of keys, found {_kind(data)}")
    fields = {attribute.name: attribute for attribute in dataclasses.fields(cast(Any, cls)) if attribute.init}
    hints = typing.get_type_hints(cls)
    for key in data:
        if key not in fields:
            inner = _fields_with(key, hints)
            where = f"it is a key of {' and of '.join(inner)}" if inner else nearest_name(key, fields)
            raise document.error((*place, key), "unknown key", where)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in data:
            values[name] = _decode_value(hints[name], data[name], field.metadata, document, (*place, name))
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            unit = field.metadata.get("unit")
            remedy = field.metadata.get("doc") or None
            raise document.error(
                place, f"key '{name}' is missing" + (f" [{unit}]" if unit and unit != "-" else ""), remedy
            )
    try:
        return cls(**values)
    except ValueError as error:
        raise document.error(place, str(error)) from None


def _fields_with(key: object, hints: Mapping[str, Any]) -> list[str]:
    """Return the fields whose groups, or lists of groups, have a key of this name."""
    found = []
    for name, hint in hints.items():
        groups = [one for one in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(one)]
        if any(attribute.name == key for group in groups for attribute in dataclasses.fields(group)):
            found.append(name)
    return found


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    if isinstance(value, int | float):
        return f"the number {value}"
    if isinstance(value, str):
        return f"the text '{value[:40]}'"
    if isinstance(value, list):
        return "a list"
    return "a group of keys" if isinstance(value, dict) else f"a {type(value).__name__}"


def _decode_value(
    hint: Any, data: Any, metadata: Mapping[str, Any], document: Document, place: tuple[Any, ...]
) -> Any:
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if hint is Any:
        return data
    if origin in (typing.Union, types.UnionType):
        if data is None and type(None) in arguments:
            return None
        choices = [argument for argument in arguments if argument is not type(None)]
        words = [
            word
            for choice in choices
            if typing.get_origin(choice) is typing.Literal
            for word in choice.__args__
        ]
        if isinstance(data, str) and words:
            if data not in words:
                raise document.error(place, f"unknown value '{data}'", nearest_name(data, words))
            return data
        if str in choices and isinstance(data, str):
            return data
        choices = [choice for choice in choices if choice is not str] or choices
        return _decode_value(choices[0], data, metadata, document, place)
    if origin is typing.Literal:
        if data not in arguments:
            raise document.error(place, f"unknown value '{data}'", nearest_name(data, arguments))
        return data
    if hint is float:
        return _number(data, metadata, document, place)
    if hint is int:
        number = _number(data, metadata, document, place)
        if number != int(number):
            raise document.error(place, f"expected a whole number, found {_kind(data)}")
        return int(number)
    if hint is bool:
        if not isinstance(data, bool):
            raise document.error(place, f"expected true or false, found {_kind(data)}")
        return data
    if hint is str:
        if not isinstance(data, str):
            raise document.error(place, f"expected a text, found {_kind(data)}")
        return data
    if hint is ArrayFile:
        return _read_array(data, document, place)
    if hint is NestedList:
        return _nested_list(data, metadata, document, place)
    if origin is tuple:
        if not isinstance(data, list):
            raise document.error(place, f"expected a list, found {_kind(data)}")
        if arguments[-1] is Ellipsis:
            _check_count(data, metadata, document, place)
            return tuple(
                _decode_value(arguments[0], one, metadata, document, (*place, i))
                for i, one in enumerate(data)
            )
        if len(data) != len(arguments):
            raise document.error(place, f"expected {len(arguments)} values, found {len(data)}")
        return tuple(
            _decode_value(kind, one, metadata, document, (*place, i))
            for i, (kind, one) in enumerate(zip(arguments, data, strict=True))
        )
    if origin in (dict, Mapping) or origin is typing.get_origin(Mapping[int, int]):
        if not isinstance(data, dict):
            raise document.error(place, f"expected a group of keys, found {_kind(data)}")
        _check_count(data, metadata, document, place)
        result: dict[Any, Any] = {}
        for key, value in data.items():
            if arguments[0] is float:
                number = _number(_as_number(key), {"above": 0.0}, document, (*place, key))
                if number in result:
                    raise document.error((*place, key), "key given twice", "keep one")
                result[number] = _decode_value(arguments[1], value, metadata, document, (*place, key))
            else:
                name = _decode_value(arguments[0], key, {}, document, (*place, key))
                result[name] = _decode_value(arguments[1], value, metadata, document, (*place, key))
        return types.MappingProxyType(result)
    if dataclasses.is_dataclass(hint):
        return decode(cast(type[Any], hint), data, document, place)
    raise TypeError(f"no decoding for {hint}")


def _check_count(data: Any, metadata: Mapping[str, Any], document: Document, place: tuple[Any, ...]) -> None:
    most = metadata.get("most", 1000)
    if len(data) > most:
        raise document.error(place, f"has {len(data)} entries, {most} at most", "is this the right file?")


def _as_number(key: Any) -> Any:
    """Return a text as the number that it contains, as keys of JSON are texts."""
    try:
        return float(key) if isinstance(key, str) else key
    except ValueError:
        return key


def _number(data: Any, metadata: Mapping[str, Any], document: Document, place: tuple[Any, ...]) -> float:
    unit = metadata.get("unit", "")
    wanted = f"a number in {unit}" if unit and unit != "-" else "a number"
    if isinstance(data, bool) or not isinstance(data, int | float):
        remedy = None
        if isinstance(data, str):
            remedy = f"give {wanted}, without unit or quotes"
        raise document.error(place, f"expected {wanted}, found {_kind(data)}", remedy)
    try:
        value = float(data)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise document.error(place, f"must be finite, found {data}")
    fault = fault_of(value, metadata)
    if fault is not None:
        raise document.error(place, f"{fault}, found {data}")
    return value


def _read_array(data: Any, document: Document, place: tuple[Any, ...]) -> ArrayFile:
    if not isinstance(data, str):
        raise document.error(place, f"expected the name of a .npy file, found {_kind(data)}")
    name, shown = Path(data), data[:80]
    target = document.folder / name
    try:
        inside = not name.is_absolute() and target.resolve().is_relative_to(document.folder.resolve())
    except (OSError, RuntimeError, ValueError):  # too long, a link to itself, a character that no name has
        inside = False
    if not inside or name.suffix != ".npy":
        raise document.error(
            place, f"'{shown}' is not a .npy file in the folder of this file", "move it there and name it so"
        )
    try:
        values = read_npy(target)
    except FileNotFoundError:
        raise document.error(place, f"no such file '{shown}'", "it must lie beside this file") from None
    except (OSError, ValueError, MemoryError) as error:
        raise document.error(place, f"'{shown}' {_reason(error)}", "save floats with numpy.save") from None
    if not np.all(np.isfinite(values)):
        raise document.error(place, f"'{shown}' holds values that are not finite", "replace NaN by 0")
    values.setflags(write=False)
    return ArrayFile(data, values)


def _reason(error: Exception) -> str:
    return f"cannot be read: {error.strerror}" if isinstance(error, OSError) else str(error) or "is too large"


def _nested_list(
    data: Any, metadata: Mapping[str, Any], document: Document, place: tuple[Any, ...]
) -> NestedList:
    if not isinstance(data, list):
        raise document.error(place, f"expected a list, found {_kind(data)}")

    def check(one: Any, where: tuple[Any, ...]) -> None:
        if isinstance(one, list):
            for i, inner in enumerate(one):
                check(inner, (*where, i))
        else:
            _number(one, metadata, document, where)

    check(data, place)
    try:
        values = np.array(data, dtype=np.float64)
    except (ValueError, TypeError):
        raise document.error(place, "rows of different lengths", "give every row the same length") from None
    values.setflags(write=False)
    return NestedList(values)


def encode(value: Any) -> Any:
    """Return plain YAML data for a parameter dataclass, without absent values; the inverse of `decode`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type | ArrayFile | NestedList):
        given = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        absent = {field.name for field in dataclasses.fields(value) if field.default is None}
        return {name: encode(one) for name, one in given.items() if one is not None or name not in absent}
    if isinstance(value, ArrayFile):
        return value.file
    if isinstance(value, NestedList):
        return value.values.tolist()
    if isinstance(value, Mapping):
        return {_plain_number(key): encode(one) for key, one in value.items()}
    if isinstance(value, tuple | list):
        return [encode(one) for one in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def _plain_number(key: Any) -> Any:
    return int(key) if isinstance(key, float) and key == int(key) else key


def arrays_of(value: Any) -> Iterator[ArrayFile]:
    """Yield every array file that a parameter dataclass names."""
    if isinstance(value, ArrayFile):
        yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type | NestedList):
        for field in dataclasses.fields(value):
            yield from arrays_of(getattr(value, field.name))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from arrays_of(inner)
    elif isinstance(value, tuple):
        for inner in value:
            yield from arrays_of(inner)


def flatten(value: Any, prefix: str = "") -> dict[str, float]:
    """Return every float of a parameter dataclass by dotted path, without arrays and whole numbers."""
    result: dict[str, float] = {}
    for name, one in _children(value):
        path = f"{prefix}{name}"
        if isinstance(one, float):
            result[path] = one
        else:
            result.update(flatten(one, f"{path}."))
    return result


def with_values[T](value: T, values: Mapping[str, float]) -> T:
    """Return the dataclass with the numbers at the given dotted paths replaced.

    Raises KeyError for a path that `flatten` does not list.
    """
    known = flatten(value)
    for path in values:
        if path not in known:
            raise KeyError(path)
    return cast(T, _replaced(value, values, ""))


def _replaced(value: Any, values: Mapping[str, float], prefix: str) -> Any:
    if isinstance(value, float):
        return float(values.get(prefix[:-1], value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type | ArrayFile | NestedList):
        changes = {name: _replaced(one, values, f"{prefix}{name}.") for name, one in _children(value)}
        return dataclasses.replace(cast(Any, value), **changes)
    if isinstance(value, tuple):
        return tuple(_replaced(one, values, f"{prefix}{i}.") for i, one in enumerate(value))
    if isinstance(value, Mapping):
        return types.MappingProxyType(
            {key: _replaced(one, values, f"{prefix}{_plain_number(key)}.") for key, one in value.items()}
        )
    return value


def _children(value: Any) -> Iterator[tuple[str, Any]]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type | ArrayFile | NestedList):
        for field in dataclasses.fields(value):
            if field.init:
                yield field.name, getattr(value, field.name)
    elif isinstance(value, tuple):
        for i, inner in enumerate(value):
            yield str(i), inner
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield str(_plain_number(key)), inner
