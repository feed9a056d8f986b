"""A recording as rosbag2, in the topics of the interface."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from .images import frame_times
from .known import Camera
from .scenes import POSE_SIGMA, Scene
from .sensor import PLUMB_BOB

FRAME = "camera_optical_frame"
EPOCH = 1_000_000_000_000_000
"""Stamp of power-on, ns."""
BEFORE_FRAME = 1000
"""A pose is stamped this much before its first frame, ns."""

store = get_typestore(Stores.ROS2_JAZZY)
_types = store.types
Image, CameraInfo = _types["sensor_msgs/msg/Image"], _types["sensor_msgs/msg/CameraInfo"]
Region = _types["sensor_msgs/msg/RegionOfInterest"]
Temperature = _types["sensor_msgs/msg/Temperature"]
DiagnosticArray = _types["diagnostic_msgs/msg/DiagnosticArray"]
DiagnosticStatus, KeyValue = (
    _types["diagnostic_msgs/msg/DiagnosticStatus"],
    _types["diagnostic_msgs/msg/KeyValue"],
)
PoseStamped, Pose = _types["geometry_msgs/msg/PoseStamped"], _types["geometry_msgs/msg/Pose"]
Point, Quaternion = _types["geometry_msgs/msg/Point"], _types["geometry_msgs/msg/Quaternion"]
Header, Time = _types["std_msgs/msg/Header"], _types["builtin_interfaces/msg/Time"]


def header(stamp: int) -> Any:
    """Header of a stamp in ns."""
    return Header(stamp=Time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=FRAME)


def image(counts: "np.ndarray", stamp: int) -> Any:
    """A 16UC1 image."""
    height, width = counts.shape
    return Image(
        header=header(stamp),
        height=height,
        width=width,
        encoding="16UC1",
        is_bigendian=0,
        step=2 * width,
        data=np.ascontiguousarray(counts, "<u2").view(np.uint8).ravel(),
    )


def camera_info(camera: Camera, stamp: int) -> Any:
    """The optics of the camera file."""
    (fx, fy), (cx, cy) = camera.sensor.focal_lengths, camera.sensor.principal_point
    return CameraInfo(
        header=header(stamp),
        height=camera.sensor.height,
        width=camera.sensor.width,
        distortion_model="plumb_bob",
        d=np.array(PLUMB_BOB),
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        binning_x=0,
        binning_y=0,
        roi=Region(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def frame_info(integration_time: int, uptime: float, stamp: int) -> Any:
    """What the device says of a frame."""
    values = {
        "integration_time": str(integration_time),
        "modulation_frequency": "20000000",
        "uptime": f"{uptime:.3f}",
    }
    status = DiagnosticStatus(
        level=0,
        name="frame_info",
        message="",
        hardware_id="SR-3000",
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
    return DiagnosticArray(header=header(stamp), status=[status])


def write_recording(
    path: Path,
    camera: Camera,
    scene: Scene,
    counts: tuple["np.ndarray", "np.ndarray"],
    *,
    storage: str = "mcap",
) -> None:
    """Write distance and amplitude counts, (exposures, frames, height, width), and all that goes with them.

    `storage` is `mcap` or `sqlite3`.
    """
    exposures = scene.exposures
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    times = frame_times(exposures)
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        topics = {
            "distance": ("/camera/distance/image_raw", "sensor_msgs/msg/Image"),
            "amplitude": ("/camera/amplitude/image_raw", "sensor_msgs/msg/Image"),
            "info": ("/camera/camera_info", "sensor_msgs/msg/CameraInfo"),
            "frame": ("/camera/frame_info", "diagnostic_msgs/msg/DiagnosticArray"),
            "ambient": ("/camera/ambient_temperature", "sensor_msgs/msg/Temperature"),
        }
        for surface in scene.surfaces:
            topics[surface.name] = (f"/ground_truth/{surface.name}/pose", "geometry_msgs/msg/PoseStamped")
        connections = {
            role: writer.add_connection(topic, kind, typestore=store)
            for role, (topic, kind) in topics.items()
        }

        def send(role: str, stamp: int, message: Any) -> None:
            writer.write(connections[role], stamp, store.serialize_cdr(message, topics[role][1]))

        station = -1
        for n in range(len(exposures)):
            first = EPOCH + round(times[n, 0] * 1e9)
            if exposures.station[n] != station:
                station = exposures.station[n]
                for surface in scene.surfaces:
                    poses, stamp = exposures.told[surface.name], first - BEFORE_FRAME
                    turn = Rotation.from_matrix(poses.rotation[n]).as_quat(canonical=True)
                    x, y, z = (float(value) for value in poses.position[n])
                    qx, qy, qz, qw = (float(value) for value in turn)
                    pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
                    send(surface.name, stamp, PoseStamped(header=header(stamp), pose=pose))
            for frame in range(exposures.frames):
                stamp = EPOCH + round(times[n, frame] * 1e9)
                send("distance", stamp, image(counts[0][n, frame], stamp))
                send("amplitude", stamp, image(counts[1][n, frame], stamp))
                send("info", stamp, camera_info(camera, stamp))
                send("frame", stamp, frame_info(int(exposures.integration_time[n]), times[n, frame], stamp))
                air = Temperature(
                    header=header(stamp), temperature=float(exposures.ambient[n]), variance=0.0004
                )
                send("ambient", stamp, air)


def scene_document(scene: Scene) -> dict[str, Any]:
    """The scene file, format rim_scene/1."""
    surfaces = []
    for surface in scene.surfaces:
        entry: dict[str, Any] = {
            "name": surface.name,
            "type": "plane" if surface.size is None else "rectangle",
            "pose": "truth",
            "pose_sigma": list(surface.pose_sigma or POSE_SIGMA),
        }
        if surface.size is not None:
            entry["size"] = list(surface.size)
        entry["reflectivity"] = surface.reflectivity
        if surface.tiles is not None:
            entry["texture"] = {"cell": list(surface.cell), "values": np.round(surface.tiles, 6).tolist()}
        surfaces.append(entry)
    document: dict[str, Any] = {"format": "rim_scene/1", "surfaces": surfaces}
    if scene.exposures.twist is not None:
        linear, angular = scene.exposures.twist
        document["camera_motion"] = {"linear": linear.tolist(), "angular": angular.tolist()}
    return document


def write_yaml(path: Path, document: dict[str, Any]) -> None:
    """Write a document whose numbers are plain."""
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
