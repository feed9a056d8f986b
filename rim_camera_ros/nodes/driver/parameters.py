"""The driver's parameters, and the source of frames that they describe."""

from __future__ import annotations

from dataclasses import fields

from rim_camera_ros.bags.image_transport import JPEG, PNG
from rim_camera_ros.devices.source import SOURCES, STAMPS, Source
from rim_camera_ros.devices.swissranger_settings import modes
from rim_camera_ros.nodes.common.folders import FOLDERS
from rim_camera_ros.nodes.common.lifecycle import AUTOSTART
from rim_camera_ros.nodes.common.parameters import Spec, Values
from rim_camera_ros.nodes.common.qos import CHOICES, SENSOR_DATA

SPECS = (
    Spec("source", "simulator", "where frames come from", choices=SOURCES),
    Spec(
        "camera",
        "sr3000",
        "camera that is simulated: a camera file, or the name of a shipped one",
        is_path=True,
    ),
    Spec(
        "scene", "room", "scene that is simulated: a scene file, or the name of a shipped one", is_path=True
    ),
    Spec(
        "recording",
        "",
        "recording that is played back: rosbag2 (folder, mcap, sqlite3) or a ROS 1 bag",
        is_path=True,
    ),
    Spec(
        "frame_rate",
        0.0,
        "frames per second [Hz]; 0: as the scene or the stamps of the recording say",
        limits=(0.0, 1000.0),
    ),
    Spec(
        "integration_time",
        0.0,
        "integration time in the camera's own unit (SwissRanger: register, PMD: ms); 0: as the scene says",
        limits=(0.0, 1e6),
    ),
    Spec(
        "as_fast_as_possible",
        False,
        "frames are not paced; stamps advance by the frame rate (simulator) or are the recorded ones",
    ),
    Spec("loop", True, "the scene's schedule, or the recording, begins anew at its end"),
    Spec("seed", 0, "seed of the simulated noise", limits=(0, 2**62)),
    Spec(
        "waveform",
        "",
        "empty: the camera file's cyclic error; or the modulation that makes it: sinusoid, square:DUTY, "
        "harmonics:3=0.1,5=-0.02",
    ),
    Spec("playback_rate", 1.0, "speed of playback, 1: as recorded", limits=(0.01, 100.0)),
    Spec(
        "stamps", "auto", "stamps of playback; auto: now, or recorded if as_fast_as_possible", choices=STAMPS
    ),
    Spec(
        "library",
        "",
        "file of the vendor's library libmesasr; empty: RIM_LIBMESASR, or the system's",
        read_only=True,  # code of whoever can set parameters would run
        is_path=True,
    ),
    Spec("serial_number", 0, "serial number of the camera on USB; 0: the first", limits=(0, 2**32 - 1)),
    Spec(
        "modulation_frequency",
        0.0,
        "modulation frequency of the camera [Hz]; 0: the camera's",
        limits=(0.0, 1e8),
    ),
    Spec("amplitude_threshold", 0, "counts below which the camera delivers no distance", limits=(0, 65535)),
    Spec("auto_exposure", False, "the camera's library sets the integration time"),
    Spec("mode", "raw", "processing in camera and library", choices=tuple(modes())),
    Spec("pause", False, "playback stands still"),
    Spec(
        "publish_clock", False, "publish the stamps of the frames to /clock, for use_sim_time of other nodes"
    ),
    Spec(
        "camera_info",
        "",
        "camera file whose geometry camera_info states; empty: that of the simulated or recorded camera",
        is_path=True,
    ),
    Spec(
        "watchdog",
        5.0,
        "seconds [s] without a frame after which the device is opened anew, three periods at least; 0: never",
        limits=(0.0, 3600.0),
    ),
    Spec("frame_id", "camera_optical_frame", "optical frame (REP 103) in the headers"),
    Spec(
        "base_frame",
        "",
        "frame of the robot at which the camera is mounted: its transform is published; empty: none",
    ),
    *(
        Spec(f"mount.{name}", 0.0, f"camera in base_frame: {words}", limits=limits)
        for name, words, limits in (
            ("x", "forward [m]", (-1e3, 1e3)),
            ("y", "to the left [m]", (-1e3, 1e3)),
            ("z", "up [m]", (-1e3, 1e3)),
            ("roll", "about the viewing direction [rad]", (-6.3, 6.3)),
            ("pitch", "looking down is positive [rad]", (-6.3, 6.3)),
            ("yaw", "looking to the left is positive [rad]", (-6.3, 6.3)),
        )
    ),
    Spec("publish_truth", True, "publish the poses of the scene's surfaces to ground_truth/<surface>/pose"),
    Spec("frames", 0, "number of frames to publish; 0: no limit", limits=(0, 2**62), read_only=True),
    Spec(
        "exit_at_end",
        False,
        "end the process after the last frame, status 0 (1: the device failed)",
        read_only=True,
    ),
    Spec(
        "wait_for_subscribers",
        0,
        "publish nothing until distance, amplitude and frame_info have that many subscribers each",
        limits=(0, 100),
        read_only=True,
    ),
    Spec("qos.images", SENSOR_DATA, "delivery of distance and amplitude", choices=CHOICES, read_only=True),
    Spec(
        "qos.info",
        SENSOR_DATA,
        "delivery of camera_info, frame_info, temperatures, reference",
        choices=CHOICES,
        read_only=True,
    ),
    Spec(
        "compressed.format",
        PNG,
        "amplitude/image_raw/compressed: png without loss, or jpeg of 8 bits (256 counts a step) for looking "
        "at it; distances are always png",
        choices=(PNG, JPEG),
    ),
    FOLDERS,
    AUTOSTART,
)

#: Parameters that describe the published transform.
MOUNT = frozenset(spec.name for spec in SPECS if spec.name.startswith("mount.")) | {"base_frame", "frame_id"}
#: Parameters that can change while a device runs; other parameters of the device open it anew.
_WHILE_RUNNING = {
    "frame_rate",
    "integration_time",
    "modulation_frequency",
    "amplitude_threshold",
    "auto_exposure",
    "mode",
    "pause",
    "playback_rate",
}
RESTARTING = frozenset(field.name for field in fields(Source)) - _WHILE_RUNNING


def source_of(values: Values) -> Source:
    """Return the source of frames that the parameters describe; it is not opened and hardly checked."""
    return Source(**{field.name: values[field.name] for field in fields(Source)})
