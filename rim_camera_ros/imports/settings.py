"""Numbers in messages of settings, by a dotted path, also in JSON texts and lists of keys and values."""

from __future__ import annotations

import json
import math
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rim_camera_ros.bags import messages
from rim_camera_ros.errors import InputError, nearest_name


class Definitions:
    """Decodes messages, also those of a driver's own types, by the definition in its profile."""

    def __init__(self, *, ros1: bool) -> None:
        self._ros1 = ros1
        self._store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        self._own: set[str] = set()

    def add(self, msgtype: str, definition: str | None, place: str) -> None:
        """Add a definition. Raises `InputError` for a type that neither ROS nor a definition describes."""
        if msgtype in self._store.fielddefs:
            return
        if definition is None:
            raise InputError(
                f"the message type {msgtype} is not known",
                place=place,
                remedy="state its definition in the profile, as `ros2 interface show` prints it",
            )
        try:
            self._store.register(get_types_from_msg(definition, msgtype))
        except Exception as error:  # the parser of rosbags may raise anything for a wrong text
            reason = " ".join(str(error).split())[:120]
            raise InputError(f"the definition of {msgtype} is wrong: {reason}", place=place) from None
        self._own.add(msgtype)

    def decode(self, raw: bytes, msgtype: str, place: str) -> Any:
        """Return the message object. Raises `InputError` for bytes that are not such a message."""
        if msgtype not in self._own:
            return messages.decode(raw, msgtype, ros1=self._ros1, place=place)
        try:
            if self._ros1:
                return self._store.deserialize_ros1(raw, msgtype)
            return self._store.deserialize_cdr(raw, msgtype)
        except Exception as error:  # the generated decoders may raise anything for damaged bytes
            raise InputError(
                f"a message of type {msgtype} cannot be decoded: {type(error).__name__} {error}",
                place=place,
                remedy="does the profile state the definition of the recorded version?",
            ) from None


def number_at(message: Any, path: str, place: str) -> float | None:
    """Return the number at a dotted path of a message, None where it is not finite.

    Parts of the path are fields, indices of lists, keys of a JSON text, or keys of a list of keys and values
    (diagnostic_msgs). Raises `InputError` for a path that does not exist.
    """
    value = message
    for part in path.split("."):
        value = _part(value, part, path, place)
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{path} is no number but '{str(value)[:40]}'", place=place) from None
    return number if math.isfinite(number) else None


def _part(value: Any, part: str, path: str, place: str) -> Any:
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except ValueError:
            raise InputError(f"{path}: the text before '{part}' is not JSON", place=place) from None
    if isinstance(value, dict):
        if part not in value:
            raise InputError(f"{path}: no key '{part}'", place=place, remedy=nearest_name(part, value))
        return value[part]
    if hasattr(value, "__len__") and not hasattr(value, "__msgtype__"):
        if part.isdigit() and int(part) < len(value):
            return value[int(part)]
        for one in value:  # KeyValue of a DiagnosticStatus
            if getattr(one, "key", None) == part:
                return one.value
        raise InputError(f"{path}: no element '{part}'", place=place, remedy="an index, or a key in the list")
    if not hasattr(value, part):
        known = [name for name in getattr(value, "__dataclass_fields__", {}) if not name.startswith("_")]
        raise InputError(f"{path}: no field '{part}'", place=place, remedy=nearest_name(part, known))
    return getattr(value, part)
