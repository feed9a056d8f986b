"""Camera files of several frequencies: split into a file for each, and merged into one.

A value that differs between the frequencies is a list with an entry for each, in the order of
``sensor.modulation_frequency``; other values apply to all. Such lists may be given for single numbers in
``sensor``, ``radiometry`` and ``noise``, for ``minimum_amplitude``, for each effect as a whole (null: off at
that frequency) and for ``covariance``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rim_camera_ros.yaml_files import Document

_SECTIONS = ("sensor", "radiometry", "noise")
#: Keys of these sections whose value is already a list for one frequency.
_LISTS = ("pixel_pitch", "exposure")
_WHOLE = ("minimum_amplitude", "covariance")


def documents(document: Document) -> tuple[Document, ...]:
    """Return the document of each frequency; the document itself if there is only one.

    Raises `InputError` for a list of another length.
    """
    sensor = document.data.get("sensor")
    frequencies = sensor.get("modulation_frequency") if isinstance(sensor, Mapping) else None
    if not isinstance(frequencies, list):
        return (document,)
    count = len(frequencies)
    if count < 2:
        raise document.error(
            ("sensor", "modulation_frequency"), "a list of one frequency", "give the number alone, or more"
        )
    lists = [place for place in _places(document.data) if isinstance(_at(document.data, place), list)]
    for place in lists:
        found = len(_at(document.data, place))
        if found != count:
            raise document.error(
                place, f"{found} entries for {count} frequencies", "give one for each, or one for all"
            )
    return tuple(_of_one(document, lists, i) for i in range(count))


def _places(data: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the places of possible lists with an entry per frequency."""
    groups = (*_SECTIONS, "effects")
    inner = [(group, key) for group in groups if isinstance(data.get(group), Mapping) for key in data[group]]
    return [place for place in inner if place[1] not in _LISTS] + [(one,) for one in _WHOLE if one in data]


def _at(data: Any, place: Sequence[Any]) -> Any:
    for key in place:
        data = data[key]
    return data


def _of_one(document: Document, lists: Sequence[tuple[str, ...]], index: int) -> Document:
    data = {key: dict(one) if isinstance(one, Mapping) else one for key, one in document.data.items()}
    data.pop("measurement", None)
    lines = dict(document.lines)
    for *group, key in lists:
        holder = _at(data, group)
        holder[key] = holder[key][index]
        if holder[key] is None and (group or key == "covariance"):
            del holder[key]
        place = (*group, key)
        # errors in an entry are reported with its own line
        own = (*place, index)
        lines.update(
            {
                (*place, *name[len(own) :]): line
                for name, line in document.lines.items()
                if name[: len(own)] == own
            }
        )
    return replace(document, data=data, lines=lines)


def merged(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the content of one file from those of the frequencies; the inverse of `documents`."""
    result = dict(parts[0])
    for section in (*_SECTIONS, "effects"):
        keys = dict.fromkeys(key for part in parts for key in part.get(section, {}))
        result[section] = {key: _entry([part.get(section, {}).get(key) for part in parts]) for key in keys}
    for key in _WHOLE:
        if any(key in part for part in parts):
            result[key] = _entry([part.get(key) for part in parts])
    return result


def _entry(values: list[Any]) -> Any:
    return values[0] if all(one == values[0] for one in values) else values
