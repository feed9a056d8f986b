"""The mount that is published to and taken from /tf_static and /tf."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("sklearn", reason="scikit-learn is an optional extra, for the people node")

from geometry_msgs.msg import TransformStamped
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image, PointCloud2

from rim_camera_ros.nodes.common.transforms import optical_rotation
from test.ros import tf2_messages
from test.ros.harness import BEST_EFFORT, LATCHED, RELIABLE, World
from test.ros.test_people_node import empty

OK, WARN = 0, 1
MOUNT = "/camera/people: mount"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with tf2_messages.made(tmp_path_factory.mktemp("tf2")) as made:
        yield made


@pytest.fixture
def tf_world(tmp_path: Path, environment: dict[str, str]) -> Iterator[World]:
    with World(tmp_path) as one:
        one.environment |= environment
        yield one


def transform(parent: str, child: str, *, quaternion: Any = (0, 0, 0, 1), **position: float) -> Any:
    result = TransformStamped(child_frame_id=child)
    result.header.frame_id = parent
    for axis, value in position.items():
        setattr(result.transform.translation, axis, value)
    turn = result.transform.rotation
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
    return result


def test_the_driver_publishes_its_mount_and_its_changes(tf_world: World) -> None:
    from tf2_msgs.msg import TFMessage

    world = tf_world
    said = world.collect(TFMessage, "/tf_static", LATCHED)
    mount = {"mount.x": 0.3, "mount.z": 1.25, "mount.pitch": 0.2}
    world.start("driver_node", base_frame="base_link", **mount)
    assert world.until(lambda: said), world.output()
    (sent,) = said.last.transforms
    assert (sent.header.frame_id, sent.child_frame_id) == ("base_link", "camera_optical_frame")
    assert (sent.transform.translation.x, sent.transform.translation.z) == (0.3, 1.25)
    assert world.set("driver", **{"mount.z": 1.75, "mount.yaw": -0.4}) == ""
    assert world.until(lambda: said.last.transforms[0].transform.translation.z == 1.75), world.output()
    found = said.last.transforms[0].transform.rotation
    turned = Rotation.from_quat([found.x, found.y, found.z, found.w])
    # forward of the camera: down by 0.2 rad, then to the right by 0.4 rad
    forward = [math.cos(0.2) * math.cos(0.4), -math.cos(0.2) * math.sin(0.4), -math.sin(0.2)]
    assert turned.apply([0, 0, 1]) == pytest.approx(np.array(forward), abs=1e-9)
    assert world.set("driver", base_frame="torso") == ""
    assert world.until(lambda: said.last.transforms[0].header.frame_id == "torso"), world.output()
    count = len(said)
    assert world.set("driver", **{"mount.z": 1.75}) == ""  # the value it has
    assert len(said) == count


def test_people_are_above_the_floor_that_transforms_tell(tf_world: World) -> None:
    from tf2_msgs.msg import TFMessage

    world = tf_world
    node = world.start(
        "people_node", base_frame="base_footprint", **{"mount.z": 2.5, "qos.input": "reliable"}
    )
    said = world.diagnostics()
    to_points, to_sigma = world.publisher(PointCloud2, "points"), world.publisher(Image, "sigma/image")
    static = world.node.create_publisher(TFMessage, "/tf_static", LATCHED)
    moving = world.node.create_publisher(TFMessage, "/tf", RELIABLE)
    everything = (to_points, to_sigma, static, moving)
    assert world.until(lambda: all(one.get_subscription_count() for one in everything)), node.text
    stamps = iter(range(10**18, 2 * 10**18, 10**8))

    def frame() -> None:
        cloud, sigma = empty(next(stamps))
        to_points.publish(cloud)
        to_sigma.publish(sigma)

    def mounted(**expected: float) -> bool:
        values = said.values(MOUNT)
        return all(abs(float(values[name]) - value) < 1e-3 for name, value in expected.items())

    frame()
    assert world.until(lambda: "from base_footprint to optical" in said.message(MOUNT)), said.message(MOUNT)
    assert said.level(MOUNT) == WARN
    assert mounted(height_m=2.5, pitch_rad=0.0)
    # footprint -> link -> camera -> optical, as a robot has them; the link is 0.1 m above its footprint
    body = Rotation.from_euler("xyz", [0.05, 0.35, 1.2]).as_quat()
    static.publish(TFMessage(transforms=[transform("base_footprint", "base_link", z=0.1)]))
    static.publish(
        TFMessage(
            transforms=[
                transform("base_link", "camera", x=0.2, z=1.2, quaternion=body),
                transform("camera", "optical", quaternion=optical_rotation(roll=0.0, pitch=0.0, yaw=0.0)),
            ]
        )
    )
    assert world.until(lambda: said.level(MOUNT) == OK), said.message(MOUNT)
    assert said.message(MOUNT) == "1.30 m above the floor, by base_footprint"
    assert mounted(height_m=1.3, roll_rad=0.05, pitch_rad=0.35)
    # the mast goes up while the node runs; what it trembles is no other mount
    static.publish(TFMessage(transforms=[transform("base_footprint", "base_link", z=0.6)]))
    assert world.until(lambda: mounted(height_m=1.8, pitch_rad=0.35)), said.message(MOUNT)
    moving.publish(TFMessage(transforms=[transform("base_footprint", "base_link", z=0.604)]))
    moving.publish(TFMessage(transforms=[transform("base_footprint", "base_link", z=0.8)]))
    assert world.until(lambda: mounted(height_m=2.0)), said.message(MOUNT)
    assert node.text.count("mount by base_footprint") == 3
    # upside down below the floor is no mount: the last one holds
    moving.publish(TFMessage(transforms=[transform("base_footprint", "base_link", z=-3.0)]))
    assert world.until(lambda: "m above the floor (give more than 0)" in said.message(MOUNT))
    assert mounted(height_m=2.0)
    assert world.set("people", base_frame="") == ""
    assert world.until(lambda: said.level(MOUNT) == OK and mounted(height_m=2.5)), said.message(MOUNT)
    assert world.until(lambda: static.get_subscription_count() == 0)
    assert node.running


def test_driver_and_people_of_one_process(tf_world: World) -> None:
    world = tf_world
    said = world.diagnostics()
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    world.start(
        "camera_node",
        scene="wall",
        people=True,
        base_frame="base_link",
        **{"mount.z": 1.6, "mount.pitch": 0.3},
    )
    assert world.until(lambda: points and said.values(MOUNT).get("from") == "base_link"), world.output()
    values = said.values(MOUNT)
    assert (values["height_m"], values["pitch_rad"]) == ("1.6000", "0.3000")
