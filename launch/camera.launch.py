"""A camera (or its simulator, or a recording) and its correction, in one process and one namespace.

With ``people:=true`` and ``calibration:=true`` what follows people and what calibrates, too. With
``separate:=true`` each node has a process of its own.

An argument left empty leaves the matter to the parameter file, the preset and the node's own default; an
argument overrides the parameter file, which overrides the preset.

    ros2 launch rim_camera_ros camera.launch.py source:=playback recording:=/path/to/bag
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import launch_config
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from rim_camera_ros.files import share_folder
from rim_camera_ros.launch_files import SHARED, Argument, processes, said_plainly, switch, switched_on
from rim_camera_ros.launch_parameters import for_node

#: Topics of camera.rviz, which are those of the namespace /camera there.
SHOWN = ("points", "amplitude/image_raw", "sigma/image", "people/markers")
#: Arguments that are parameters of a node of the same name, and those of another name.
DRIVER = {name: name for name in ("source", "scene", "recording", "camera", "frame_id", "base_frame")}
CORRECTION = {"camera": "correction_camera"}
CALIBRATION = {"camera": "correction_camera", "scene": "calibration_scene"}
ARGUMENTS = (
    *SHARED,
    Argument("namespace", "namespace of the nodes", default="camera"),
    Argument("scene", "scene file of the simulator"),
    Argument("recording", "bag that playback replays"),
    Argument("camera", "camera file of the driver"),
    Argument("correction_camera", "camera file the correction uses"),
    Argument("frame_id", "optical frame of the images"),
    Argument("base_frame", "frame the camera is mounted at"),
    Argument("driver_parameters", "parameter file (YAML) of the driver"),
    Argument("correction_parameters", "parameter file (YAML) of the correction"),
    Argument("people_parameters", "parameter file (YAML) of the people node: the mount, say"),
    switch("calibration", "true: calibrate when asked to, by services, in a process of its own"),
    Argument("calibration_parameters", "parameter file (YAML) of the calibration node"),
    Argument("calibration_scene", "scene file of what is recorded"),
    switch("rviz", "true: show points and amplitude"),
)


def generate_launch_description() -> LaunchDescription:
    declared = [DeclareLaunchArgument(argument.name, **argument.declared) for argument in ARGUMENTS]
    return LaunchDescription([*declared, OpaqueFunction(function=start_nodes)])


@said_plainly()
def start_nodes(context: LaunchContext) -> list[Node]:
    values = {argument.name: LaunchConfiguration(argument.name).perform(context) for argument in ARGUMENTS}
    folder = launch_config.log_dir

    def files(node: str, arguments: dict[str, str]) -> list[str]:
        given = {parameter: values[name] for parameter, name in arguments.items() if values[name]}
        return for_node(node, folder=folder, file=values[f"{node}_parameters"], values=given)

    parameters = {"driver": files("driver", DRIVER), "correction": files("correction", CORRECTION)}
    if switched_on(values["people"]):
        parameters["people"] = files("people", {})
    if switched_on(values["calibration"]):
        parameters["calibration"] = files("calibration", CALIBRATION)
    namespace = values["namespace"]
    started = processes(values, parameters, namespace=namespace, folder=folder)
    nodes = [Node(**process) for process in started]
    if switched_on(values["rviz"]):
        names = [("/camera/" + topic, f"/{namespace}/" + topic) for topic in SHOWN]
        nodes.append(
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(share_folder() / "config" / "camera.rviz")],
                remappings=names,
                output="screen",
            )
        )
    return nodes
