"""Common parts of the launch files: arguments, and the processes of a camera; no ROS in here."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rim_camera_ros.errors import InputError
from rim_camera_ros.files import share_folder
from rim_camera_ros.launch_parameters import for_node, log_levels, preset_file

_PACKAGE = "rim_camera_ros"
#: Nodes that always have their own process.
_APART = ("calibration",)
#: Seconds until a process that has ended is started again.
_RESPAWN_DELAY = 2.0


@dataclass(frozen=True)
class Argument:
    """An argument of a launch file; if it is empty, parameter files and the node decide."""

    name: str
    description: str
    default: str = ""
    choices: tuple[str, ...] | None = None

    @property
    def declared(self) -> dict[str, Any]:
        """Return the arguments of ``DeclareLaunchArgument`` in addition to the name."""
        return {
            "default_value": self.default,
            "choices": None if self.choices is None else list(self.choices),
            "description": self.description,
        }


def switch(name: str, description: str) -> Argument:
    """Return an argument that is true or false, false by default."""
    return Argument(name, description, default="false", choices=("true", "false", "True", "False"))


def switched_on(text: str) -> bool:
    """Return whether the text of a `switch` means true."""
    return text.lower() == "true"


#: Arguments of every launch file.
SHARED = (
    Argument("source", "where the images come from", choices=("", "simulator", "playback", "sr3000")),
    Argument("preset", "parameters that go together: fast, precise, outdoors"),
    switch("people", "true: follow people who walk through the view"),
    switch("separate", "true: driver, correction and people in processes of their own"),
    switch("respawn", "true: a process that has ended is started again after 2 s"),
    Argument("log_level", "debug, info, warn, error, fatal; or by node: driver=debug,correction=warn"),
)


@contextmanager
def said_plainly() -> Iterator[None]:
    """Let launch report an `InputError` that is raised inside by its sentence alone.

    Launch puts "Caught exception in launch (see debug for traceback)" before errors of any type. The error
    itself is not changed: launch ends the processes that it has started, and its status is 1.
    """
    try:
        yield
    except InputError as error:
        sentence = str(error)

        def alone(record: logging.LogRecord) -> bool:
            if str(record.msg).endswith(f": {sentence}"):
                record.msg = sentence
            return True

        logging.getLogger("launch").addFilter(alone)
        raise


def processes(
    values: Mapping[str, str],
    files: Mapping[str, Sequence[str]],
    *,
    namespace: str,
    folder: str | Path,
    last: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Return the arguments of ``Node`` of launch_ros, for each process of a camera.

    ``values``: values of the arguments `SHARED` by name; ``files``: parameter files by node, which override
    the preset; ``last``: parameter files for all nodes, which override ``files``; ``folder``: where a further
    file is written, see `for_node`. Raises `InputError` where a value is wrong.
    """
    files = dict(files)
    if switched_on(values["people"]):
        files.setdefault("people", ())
    preset = preset_file(values["preset"], share_folder() / "config" / "presets")
    common: dict[str, Any] = {
        "package": _PACKAGE,
        "namespace": namespace,
        "ros_arguments": log_levels(values["log_level"], namespace=namespace, nodes=tuple(files)),
        "output": "screen",
    }
    if switched_on(values["respawn"]):
        common |= {"respawn": True, "respawn_delay": _RESPAWN_DELAY}
    separate = switched_on(values["separate"])
    together = [node for node in files if not separate and node not in _APART]
    nodes_of = {"camera_node": together} if together else {}
    nodes_of |= {f"{node}_node": [node] for node in files if node not in together}
    if "people" in together:
        # not as a dictionary, which launch_ros would write to a file in /tmp and leave there
        asked = for_node("correction", folder=folder, values={"people": True})
        files["people"] = [*files["people"], *asked]
    return [
        common
        | {
            "executable": executable,
            "parameters": [
                *([preset] if preset else []),
                *(file for node in nodes for file in files[node]),
                *last,
            ],
        }
        for executable, nodes in nodes_of.items()
    ]
