"""The parameters of the node that follows people, and the settings that they describe; no ROS in here."""

from __future__ import annotations

from rim_camera_ros.errors import InputError
from rim_camera_ros.nodes.common.lifecycle import AUTOSTART
from rim_camera_ros.nodes.common.parameters import Spec, Values
from rim_camera_ros.nodes.common.qos import CHOICES, SENSOR_DATA
from rim_camera_ros.tracking.background import BackgroundSettings
from rim_camera_ros.tracking.ground import Ground
from rim_camera_ros.tracking.moving import ClusterSettings
from rim_camera_ros.tracking.people import PeopleSettings
from rim_camera_ros.tracking.tracks import TrackSettings

_BACKGROUND, _CLUSTER, _TRACK = BackgroundSettings(), ClusterSettings(), TrackSettings()
_DAY = 86400.0

SPECS = (
    Spec(
        "base_frame",
        "",
        "frame on the floor (z up) from which /tf leads to the camera's frame: the mount is taken from there "
        "as soon as it is known; empty: from mount.*",
    ),
    Spec("mount.z", 2.2, "camera above the floor [m]", limits=(0.01, 100.0)),
    Spec("mount.roll", 0.0, "camera about the viewing direction [rad]", limits=(-3.2, 3.2)),
    Spec("mount.pitch", 0.0, "looking down is positive [rad]", limits=(-1.5, 1.5)),
    Spec(
        "background.threshold",
        _BACKGROUND.threshold,
        "a pixel moves where it is nearer than the background by more standard deviations than this [-]",
        limits=(1.0, 20.0),
    ),
    Spec(
        "background.model_error",
        _BACKGROUND.model_error,
        "1-sigma of what sigma does not hold, light by way of a person say [m]",
        limits=(0.0, 1.0),
    ),
    Spec(
        "background.warm_start",
        _BACKGROUND.warm_start,
        "frames from whose median the background begins [-]",
        limits=(1, 500),
    ),
    Spec(
        "background.time_constant",
        _BACKGROUND.time_constant,
        "with which the background forgets [s]",
        limits=(0.1, _DAY),
    ),
    Spec(
        "background.absorb_after",
        _BACKGROUND.absorb_after,
        "what stands still for so long becomes background [s]",
        limits=(0.1, _DAY),
    ),
    Spec(
        "background.reveal_after",
        _BACKGROUND.reveal_after,
        "what is seen behind the background for so long becomes background [s]",
        limits=(0.0, _DAY),
    ),
    Spec(
        "cluster.reach",
        _CLUSTER.reach,
        "points on the floor nearer to each other belong together [m]",
        limits=(0.05, 2.0),
    ),
    Spec(
        "cluster.minimum_area",
        _CLUSTER.minimum_area,
        "area of the smallest cluster, as the camera sees it [m^2]",
        limits=(0.001, 10.0),
    ),
    Spec("cluster.lowest", _CLUSTER.lowest, "points count above this height [m]", limits=(-1.0, 10.0)),
    Spec("cluster.highest", _CLUSTER.highest, "points count below this height [m]", limits=(0.0, 10.0)),
    Spec(
        "cluster.tallest_below",
        _CLUSTER.tallest_below,
        "a cluster whose top lies lower is no person [m]",
        limits=(0.0, 10.0),
    ),
    Spec(
        "cluster.maximum_sigma",
        _CLUSTER.maximum_sigma,
        "points with a greater standard deviation are ignored [m]",
        limits=(0.001, 10.0),
    ),
    Spec(
        "cluster.body_radius",
        _CLUSTER.body_radius,
        "of the cylinder whose near side is seen of a person [m]",
        limits=(0.0, 1.0),
    ),
    Spec(
        "track.acceleration",
        _TRACK.acceleration,
        "spectral density of the white acceleration of walking [m^2/s^3]",
        limits=(0.001, 100.0),
    ),
    Spec(
        "track.measurement_sigma",
        _TRACK.measurement_sigma,
        "1-sigma per axis of a position [m]",
        limits=(0.001, 1.0),
    ),
    Spec(
        "track.gate",
        _TRACK.gate,
        "probability with which a person's own position lies within the gate [-]",
        limits=(0.5, 0.999999),
    ),
    Spec("track.confirm_after", _TRACK.confirm_after, "positions before a track counts [-]", limits=(1, 100)),
    Spec("track.coast", _TRACK.coast, "a hidden person is predicted for so long [s]", limits=(0.0, 60.0)),
    Spec(
        "track.apart", _TRACK.apart, "nobody appears nearer to somebody who is there [m]", limits=(0.0, 10.0)
    ),
    Spec("trail", 5.0, "length of the line behind a person [s]", limits=(0.0, 60.0)),
    Spec("qos.input", SENSOR_DATA, "delivery asked of the correction", choices=CHOICES, read_only=True),
    AUTOSTART,
)


def people_settings(values: Values, *, ground: Ground | None = None) -> PeopleSettings:
    """Return the settings that parameters describe; `InputError` for heights in the wrong order.

    ``ground``: the floor in place of that of ``mount.*``.
    """
    if values["cluster.lowest"] >= values["cluster.highest"]:
        raise InputError(
            f"{values['cluster.lowest']:g} m is not below cluster.highest {values['cluster.highest']:g} m",
            place="cluster.lowest",
        )

    def group(prefix: str) -> dict[str, float]:
        return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}

    mount = group("mount.")
    return PeopleSettings(
        ground=ground or Ground(height=mount["z"], roll=mount["roll"], pitch=mount["pitch"]),
        background=BackgroundSettings(**group("background.")),  # type: ignore[arg-type]
        clusters=ClusterSettings(**group("cluster.")),
        tracks=TrackSettings(**group("track."), body_radius=values["cluster.body_radius"]),  # type: ignore[arg-type]
    )
