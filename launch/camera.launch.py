"""A camera (or its simulator, or a recording) and its correction, in one namespace.

With ``people:=true`` and ``calibration:=true`` the nodes that follow people and that calibrate, too.

An argument left empty leaves the matter to the parameter file and to the node's own default.

    ros2 launch rim_camera_ros camera.launch.py source:=playback recording:=/path/to/bag
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "rim_camera_ros"
#: Topics of camera.rviz, which are those of the namespace /camera there.
SHOWN = ("points", "amplitude/image_raw", "sigma/image", "people/markers")


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="camera", description="namespace of the nodes"),
            DeclareLaunchArgument(
                "source",
                default_value="",
                choices=["", "simulator", "playback", "sr3000"],
                description="where the images come from",
            ),
            DeclareLaunchArgument("scene", default_value="", description="scene file of the simulator"),
            DeclareLaunchArgument("recording", default_value="", description="bag that playback replays"),
            DeclareLaunchArgument(
                "driver_parameters", default_value="", description="parameter file (YAML) of the driver"
            ),
            DeclareLaunchArgument("camera", default_value="", description="camera file of the driver"),
            DeclareLaunchArgument(
                "correction_camera", default_value="", description="camera file the correction uses"
            ),
            DeclareLaunchArgument("frame_id", default_value="", description="optical frame of the images"),
            DeclareLaunchArgument(
                "base_frame", default_value="", description="frame the camera is mounted at"
            ),
            DeclareLaunchArgument(
                "people",
                default_value="false",
                choices=["true", "false"],
                description="true: follow people who walk through the view",
            ),
            DeclareLaunchArgument(
                "people_parameters",
                default_value="",
                description="parameter file (YAML) of the people node: how the camera is mounted, say",
            ),
            DeclareLaunchArgument(
                "calibration",
                default_value="false",
                choices=["true", "false"],
                description="true: calibrate when asked to, by services",
            ),
            DeclareLaunchArgument(
                "calibration_parameters",
                default_value="",
                description="parameter file (YAML) of the calibration node",
            ),
            DeclareLaunchArgument(
                "calibration_scene", default_value="", description="scene file of what is recorded"
            ),
            DeclareLaunchArgument(
                "rviz", default_value="false", description="true: show points and amplitude"
            ),
            OpaqueFunction(function=start_nodes),
        ]
    )


def start_nodes(context: LaunchContext) -> list[Node]:
    def value(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context)

    def given(**arguments: str) -> dict[str, ParameterValue]:
        """Node parameters from the launch arguments that are not empty; always text, also "2024"."""
        return {
            parameter: ParameterValue(value(argument), value_type=str)
            for parameter, argument in arguments.items()
            if value(argument)
        }

    driver = given(
        source="source",
        scene="scene",
        recording="recording",
        camera="camera",
        frame_id="frame_id",
        base_frame="base_frame",
    )
    # a parameter file comes before the arguments, which override it
    started = {
        "driver_node": (value("driver_parameters"), driver),
        "correction_node": ("", given(camera="correction_camera")),
    }
    if value("people") == "true":
        started["people_node"] = (value("people_parameters"), {})
    if value("calibration") == "true":
        own = given(camera="correction_camera", scene="calibration_scene")
        started["calibration_node"] = (value("calibration_parameters"), own)
    nodes = [
        Node(
            package=PACKAGE,
            executable=executable,
            namespace=value("namespace"),
            parameters=[entry for entry in entries if entry],
            output="screen",
        )
        for executable, entries in started.items()
    ]
    if value("rviz").lower() == "true":
        view = Path(get_package_share_directory(PACKAGE)) / "config" / "camera.rviz"
        names = [("/camera/" + topic, f"/{value('namespace')}/" + topic) for topic in SHOWN]
        nodes.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(view)],
                remappings=names,
                output="screen",
            )
        )
    return nodes
