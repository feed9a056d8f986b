"""A camera (or its simulator, or a recording) and its correction, in one process and one namespace.

With ``people:=true`` and ``calibration:=true`` what follows people and what calibrates, too. With
``separate:=true`` each node has a process of its own.

An argument left empty leaves the matter to the parameter file, the preset and the node's own default; an
argument overrides the parameter file, which overrides the preset.

    ros2 launch rim_camera_ros camera.launch.py source:=playback recording:=/path/to/bag
"""

from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from rim_camera_ros.launch_parameters import for_node, log_levels, preset_file

PACKAGE = "rim_camera_ros"
#: Topics of camera.rviz, which are those of the namespace /camera there.
SHOWN = ("points", "amplitude/image_raw", "sigma/image", "people/markers")
#: Arguments that are parameters of a node of the same name, and those of another name.
DRIVER = {name: name for name in ("source", "scene", "recording", "camera", "frame_id", "base_frame")}
CORRECTION = {"camera": "correction_camera"}
CALIBRATION = {"camera": "correction_camera", "scene": "calibration_scene"}
SWITCH = ["true", "false", "True", "False"]
#: Name, default, choices, description.
ARGUMENTS = (
    ("namespace", "camera", None, "namespace of the nodes"),
    ("source", "", ["", "simulator", "playback", "sr3000"], "where the images come from"),
    ("scene", "", None, "scene file of the simulator"),
    ("recording", "", None, "bag that playback replays"),
    ("camera", "", None, "camera file of the driver"),
    ("correction_camera", "", None, "camera file the correction uses"),
    ("frame_id", "", None, "optical frame of the images"),
    ("base_frame", "", None, "frame the camera is mounted at"),
    ("preset", "", None, "parameters that go together: fast, precise, outdoors"),
    ("driver_parameters", "", None, "parameter file (YAML) of the driver"),
    ("correction_parameters", "", None, "parameter file (YAML) of the correction"),
    ("people", "false", SWITCH, "true: follow people who walk through the view"),
    (
        "people_parameters",
        "",
        None,
        "parameter file (YAML) of the people node: the mount, say",
    ),
    (
        "calibration",
        "false",
        SWITCH,
        "true: calibrate when asked to, by services, in a process of its own",
    ),
    ("calibration_parameters", "", None, "parameter file (YAML) of the calibration node"),
    ("calibration_scene", "", None, "scene file of what is recorded"),
    ("separate", "false", SWITCH, "true: driver, correction and people in processes of their own"),
    ("respawn", "false", SWITCH, "true: a process that has ended is started again after 2 s"),
    ("log_level", "", None, "debug, info, warn, error, fatal; or by node: driver=debug,correction=warn"),
    ("rviz", "false", SWITCH, "true: show points and amplitude"),
)


def generate_launch_description() -> LaunchDescription:
    declared = [
        DeclareLaunchArgument(name, default_value=default, choices=choices, description=description)
        for name, default, choices, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])


def start_nodes(context: LaunchContext) -> list[Node]:
    def value(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context)

    def on(argument: str) -> bool:
        return value(argument).lower() == "true"

    def files(node: str, arguments: dict[str, str]) -> list[str]:
        given = {parameter: value(argument) for parameter, argument in arguments.items() if value(argument)}
        return for_node(node, file=value(f"{node}_parameters"), values=given)

    namespace = value("namespace")
    share = Path(get_package_share_directory(PACKAGE))
    preset = preset_file(value("preset"), share / "config" / "presets")
    parameters = {"driver": files("driver", DRIVER), "correction": files("correction", CORRECTION)}
    if on("people"):
        parameters["people"] = files("people", {})
    # executables with the nodes that run in them
    started: dict[str, list[str]] = (
        {f"{node}_node": [node] for node in parameters}
        if on("separate")
        else {"camera_node": list(parameters)}
    )
    if on("calibration"):
        parameters["calibration"] = files("calibration", CALIBRATION)
        started["calibration_node"] = ["calibration"]
    common: dict[str, Any] = {"output": "screen"}
    if on("respawn"):
        common |= {"respawn": True, "respawn_delay": 2.0}
    everywhere = [preset] if preset else []
    levels = log_levels(value("log_level"), namespace=namespace, nodes=tuple(parameters))
    nodes = [
        Node(
            package=PACKAGE,
            executable=executable,
            namespace=namespace,
            parameters=[
                *everywhere,
                *(file for node in inside for file in parameters[node]),
                *([{"people": True}] if executable == "camera_node" and "people" in inside else []),
            ],
            ros_arguments=levels,
            **common,
        )
        for executable, inside in started.items()
    ]
    if on("rviz"):
        names = [("/camera/" + topic, f"/{namespace}/" + topic) for topic in SHOWN]
        nodes.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(share / "config" / "camera.rviz")],
                remappings=names,
                output="screen",
            )
        )
    return nodes
