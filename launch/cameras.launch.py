"""Several cameras side by side, each with its correction in one process and a namespace of its own.

Each name is a namespace; its optical frame is <name>_optical_frame. A file <name>.yaml in the folder
``parameters`` holds the parameters of that camera's nodes (serial_number, camera, mount). The arguments hold
for all cameras; what is written in a camera's file overrides them.

    ros2 launch rim_camera_ros cameras.launch.py cameras:=front,rear parameters:=/path/to/folder
"""

import re
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import launch_config
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from rim_camera_ros.errors import InputError
from rim_camera_ros.launch_files import SHARED, Argument, processes, said_plainly
from rim_camera_ros.launch_parameters import for_node

ARGUMENTS = (
    *SHARED,
    Argument("cameras", "namespaces of the cameras, joined by ,", default="front,rear"),
    Argument("parameters", "folder with <name>.yaml of each camera"),
)


def generate_launch_description() -> LaunchDescription:
    declared = [DeclareLaunchArgument(argument.name, **argument.declared) for argument in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])


@said_plainly()
def start_nodes(context: LaunchContext) -> list[Node]:
    values = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in ARGUMENTS}
    folder = launch_config.log_dir
    nodes = []
    names = [name.strip() for name in values["cameras"].split(",") if name.strip()]
    for name in names:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or names.count(name) > 1:
            raise InputError(f"'{name}' is no namespace, or is given twice", place="cameras")
        file = Path(values["parameters"]).expanduser() / f"{name}.yaml" if values["parameters"] else None
        if file is not None and not file.is_file():
            raise InputError(f"no such file, of the camera '{name}'", file=file, place="parameters")
        driver = {"frame_id": f"{name}_optical_frame"}
        if values["source"]:
            driver["source"] = values["source"]
        files = {"driver": for_node("driver", folder=folder, values=driver), "correction": []}
        last = [str(file)] if file else []
        started = processes(values, files, namespace=name, folder=folder, last=last)
        nodes += [Node(**process) for process in started]
    return nodes
