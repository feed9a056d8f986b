"""Several cameras side by side, each with its correction in one process and a namespace of its own.

Each name is a namespace; its optical frame is <name>_optical_frame. A file <name>.yaml in the folder
``parameters`` holds the parameters of that camera's driver and correction (serial_number, camera, mount).

    ros2 launch rim_camera_ros cameras.launch.py cameras:=front,rear parameters:=/path/to/folder
"""

import re
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from rim_camera_ros.launch_parameters import for_node

PACKAGE = "rim_camera_ros"


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "cameras", default_value="front,rear", description="namespaces of the cameras, joined by ,"
            ),
            DeclareLaunchArgument(
                "parameters", default_value="", description="folder with <name>.yaml of each camera"
            ),
            DeclareLaunchArgument("source", default_value="", description="where the images come from"),
            DeclareLaunchArgument(
                "separate",
                default_value="false",
                choices=["true", "false"],
                description="true: driver and correction in processes of their own",
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    def value(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context)

    nodes = []
    names = [one.strip() for one in value("cameras").split(",") if one.strip()]
    executables = ("driver_node", "correction_node") if value("separate") == "true" else ("camera_node",)
    for name in names:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or names.count(name) > 1:
            raise ValueError(f"cameras: '{name}' is no namespace, or is given twice")
        file = Path(value("parameters")).expanduser() / f"{name}.yaml" if value("parameters") else None
        if file is not None and not file.is_file():
            raise ValueError(f"{file}: no such file (parameters of the camera '{name}')")
        driver = {"frame_id": f"{name}_optical_frame"}
        if value("source"):
            driver["source"] = value("source")
        # the file comes last: what is written there for this camera holds
        given = [*for_node("driver", values=driver), *([str(file)] if file else [])]
        nodes += [
            Node(package=PACKAGE, executable=executable, namespace=name, parameters=given, output="screen")
            for executable in executables
        ]
    return nodes
