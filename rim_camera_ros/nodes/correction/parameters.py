"""The correction's parameters, and the correction that they describe; no ROS in here."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.devices.timeline import DEFAULT_INTEGRATION_TIME
from rim_camera_ros.effects import registry
from rim_camera_ros.errors import InputError, nearest_name
from rim_camera_ros.frame import RawFrame, Settings
from rim_camera_ros.measurement import FrameCorrection, measurement_of
from rim_camera_ros.nodes.common.folders import FOLDERS
from rim_camera_ros.nodes.common.lifecycle import AUTOSTART
from rim_camera_ros.nodes.common.parameters import Spec, Values
from rim_camera_ros.nodes.common.qos import CHOICES, SENSOR_DATA
from rim_camera_ros.nodes.correction.freshness import MAXIMUM_AGE, QUEUE_DEPTH

EFFECT = "effects."

SPECS = (
    Spec(
        "camera",
        "sr3000",
        "camera file, or the name of a shipped one; load_camera reads it anew",
        is_path=True,
    ),
    Spec(
        "minimum_amplitude",
        -1.0,
        "amplitude in counts below which a pixel has no point; -1: the camera file's, or where that has none "
        "the amplitude at which the noise of the amplitude term exceeds the range noise",
        limits=(-1.0, 65535.0),
    ),
    Spec(
        "save_as",
        "",
        "name of the file that save_camera writes, without folder; empty: that of camera; where it is taken, "
        "the next free one (NAME_2)",
    ),
    Spec(
        "points.fields",
        "xyzi",
        "fields of points: x y z intensity (16 bytes a point), sigma (4 more), flags (4 more)",
        choices=("xyzi", "xyzi+sigma", "xyzi+flags", "xyzi+sigma+flags"),
    ),
    Spec(
        "samples",
        False,
        "take histograms or gates as well, from which distances are evaluated anew, each with its own sigma",
        read_only=True,
    ),
    Spec("qos.input", SENSOR_DATA, "delivery asked of the driver", choices=CHOICES, read_only=True),
    Spec("qos.points", SENSOR_DATA, "delivery of points", choices=CHOICES, read_only=True),
    Spec(
        "qos.images",
        SENSOR_DATA,
        "delivery of sigma, flags, distance and depth images with their camera_info",
        choices=CHOICES,
        read_only=True,
    ),
    MAXIMUM_AGE,
    QUEUE_DEPTH,
    FOLDERS,
    AUTOSTART,
)

#: Parameters that do not change the correction itself.
INDEPENDENT = frozenset({"save_as", "points.fields", MAXIMUM_AGE.name, QUEUE_DEPTH.name})

#: A parameter of the correction in `camera_node`.
PEOPLE = Spec("people", False, "follow people who walk through the view, in the same process", read_only=True)


def effect_spec(name: str, on: bool) -> Spec:
    """Return the parameter that switches the correction of an effect."""
    return Spec(
        EFFECT + name, on, f"undo {registry()[name].title}; only effects of the camera file can be on"
    )


def correction_of(camera: Camera, values: Values) -> FrameCorrection:
    """Return the correction that parameters describe; `InputError` for what does not fit the camera."""
    on = {name for name in registry() if values[EFFECT + name]}
    foreign = sorted(on - set(camera.effects))
    if foreign:
        raise InputError(
            f"the camera file {values['camera']} has no effect '{foreign[0]}'",
            place=EFFECT + foreign[0],
            remedy=nearest_name(foreign[0], camera.effects) if camera.effects else "it has none",
        )
    minimum = values["minimum_amplitude"]
    if -1.0 < minimum < 0.0:
        raise InputError(
            f"{minimum:g} counts", place="minimum_amplitude", remedy="0 or more, or -1 for the camera file's"
        )
    return measurement_of(camera).correction(
        camera,
        # effects of only one way of measuring have no parameter: they are always undone
        without=(camera.effects.keys() & registry().keys()) - on,
        minimum_amplitude=None if minimum < 0 else minimum,
    )


def warm_up(correction: FrameCorrection) -> None:
    """Make the tables of the most likely setting before frames come: this takes longer than a frame may."""
    camera = correction.camera
    counts = np.full(camera.shape, 1000, np.uint16)
    integration_time = camera.sensor.integration_time or DEFAULT_INTEGRATION_TIME
    settings = Settings(
        integration_time=integration_time, uptime=0.0, ambient_temperature=0.0, reference_distance=0.0
    )
    # a stamp in the far future: every real frame is before it, and filters begin anew
    images = dict.fromkeys(measurement_of(camera).image_roles(camera)[2:], counts)
    correction.correct(
        RawFrame(stamp=2**62, distance=counts, amplitude=counts, settings=settings, images=images)
    )
    correction.notes.clear()
