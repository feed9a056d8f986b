"""The node that follows people, behind driver and correction, on the simulated walk."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("sklearn", reason="scikit-learn is an optional extra")
pytest.importorskip("visualization_msgs")

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image, PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from rim_camera_ros.nodes.common.messages import cloud, header, image
from rim_camera_ros.nodes.people.pairing import POINTS, SIGMA, CloudPairing
from rim_camera_ros.tracking.figures import GROUND
from test.ros.harness import LATCHED, LOSSLESS_CORRECTION, LOSSLESS_DRIVER, World, stamp_of

ROOT = Path(__file__).resolve().parents[2]
PITCH = math.radians(20.0)
OK, WARN, ERROR = 0, 1, 2


def on_floor(point: object) -> np.ndarray:
    """Return a point of a marker or pose in the floor's frame."""
    return GROUND.from_optical(np.array([[point.x, point.y, point.z]]))[0]  # type: ignore[attr-defined]


@pytest.mark.slow
def test_two_people_cross_and_stay_who_they_are(world: World) -> None:
    people = world.start("people_node", **{"mount.z": 2.2, "mount.pitch": PITCH, "qos.input": "reliable"})
    world.start("correction_node", camera="sr3000", **LOSSLESS_CORRECTION)
    arrays = world.collect(MarkerArray, "people/markers")
    clouds = world.collect(PointCloud2, "points")
    truth = {
        name: world.collect(PoseStamped, f"ground_truth/{name}_head/pose", LATCHED)
        for name in ("anna", "bert")
    }
    said = world.diagnostics()
    assert world.until(lambda: arrays.matched and clouds.matched), world.output()
    assert world.until(
        lambda: (
            "people" in said.values("/camera/people: people")
            and world.node.count_publishers("/camera/sigma/image") == 1
            and world.node.count_subscribers("/camera/sigma/image") == 1
        )
    ), world.output()
    world.start(
        "driver_node",
        scene="walking_people",
        camera="sr3000",
        as_fast_as_possible=True,
        loop=False,
        wait_for_subscribers=1,
        **LOSSLESS_DRIVER,
    )

    def bodies() -> list[Marker]:
        return [one for array in arrays for one in array.markers if one.ns == "people"]

    def gone() -> set[int]:
        return {one.id for one in bodies() if one.action == Marker.DELETE}

    # the first leaves the view so early that his track ends before the recording does
    assert world.until(lambda: len(clouds) == 90 and gone()), world.output()
    assert gone() == {1}
    shown = [one for one in bodies() if one.action == Marker.ADD]
    assert {one.id for one in shown} == {1, 2}, world.output()
    heads = {
        name: {stamp_of(one): on_floor(one.pose.position)[:2] for one in collected}
        for name, collected in truth.items()
    }
    owners: dict[int, set[str]] = {1: set(), 2: set()}
    errors = []
    for one in shown:
        stamp = stamp_of(one)
        if one.color.a < 0.5 or not all(stamp in by_stamp for by_stamp in heads.values()):
            continue  # hidden, or somebody's pose did not come
        place = on_floor(one.pose.position)
        apart = {name: float(np.linalg.norm(by_stamp[stamp] - place[:2])) for name, by_stamp in heads.items()}
        nearest = min(apart, key=apart.__getitem__)
        owners[one.id].add(nearest)
        errors.append(apart[nearest])
        # a cylinder upright on the floor
        assert 2 * place[2] == pytest.approx(one.scale.z, abs=1e-6)
        assert 1.3 < one.scale.z < 1.85
    assert sorted(map(sorted, owners.values())) == [["anna"], ["bert"]]
    assert len(errors) > 40
    assert np.sqrt(np.mean(np.square(errors))) < 0.04
    spaces = {one.ns for array in arrays for one in array.markers}
    assert spaces == {"people", "numbers", "trails"}
    trails = [one for array in arrays for one in array.markers if one.ns == "trails" and one.points]
    assert max(len(one.points) for one in trails) > 20
    assert abs(on_floor(trails[-1].points[0])[2]) < 1e-6
    assert shown[0].header.frame_id == "camera_optical_frame"
    assert "refused" not in people.text


def empty(stamp: int, *, depth: float = 3.0) -> tuple[PointCloud2, Image]:
    """Return the cloud and sigma of a wall, 16 x 12 px."""
    across, down = np.meshgrid((np.arange(16) - 8) / 20, (np.arange(12) - 6) / 20)
    points = np.dstack([depth * across, depth * down, np.full((12, 16), depth), np.full((12, 16), 900.0)])
    head = header(stamp, "optical")
    return cloud(points.astype(np.float32), head), image(np.full((12, 16), 0.01, np.float32), head)


def test_states_services_parameters_and_damaged_messages(world: World) -> None:
    node = world.start("people_node", **{"background.warm_start": 5, "qos.input": "reliable"})
    to_points = world.publisher(PointCloud2, "points")
    to_sigma = world.publisher(Image, "sigma/image")
    said = world.diagnostics()
    frames, people = "/camera/people: frames", "/camera/people: people"
    assert world.until(lambda: to_points.get_subscription_count() and to_sigma.get_subscription_count())
    assert world.until(lambda: "no frame for" in said.message(frames)), node.text
    assert said.level(frames) == ERROR
    stamps = iter(range(10**18, 2 * 10**18, 10**8))

    def send(count: int, **depth: float) -> None:
        for _ in range(count):
            points, sigma = empty(next(stamps), **depth)
            to_points.publish(points)
            to_sigma.publish(sigma)

    send(3)
    assert world.until(lambda: said.values(people).get("missing_background_frames") == "2"), node.text
    assert said.level(people) == WARN
    send(4)
    assert world.until(lambda: said.values(people).get("missing_background_frames") == "0"), node.text
    assert said.message(people) == "0 people"
    send(1, depth=2.0)
    assert world.until(lambda: said.values(people).get("moving_share") == "1.0000"), node.text
    assert "100 % of the pixels move: the camera was moved" in said.message(people)
    answer = world.call(Trigger, "people/learn_background")
    assert (answer.success, answer.message) == (True, "the next 5 frames are the background")
    damaged, sigma = empty(next(stamps))
    damaged.point_step = 20
    to_points.publish(damaged)
    to_sigma.publish(sigma)
    assert world.until(lambda: "the cloud is not packed in 16 bytes a point" in node.text), node.text
    assert world.until(lambda: said.values(frames).get("refused_messages") == "1")
    reason = world.set("people", **{"cluster.lowest": 2.0, "cluster.highest": 1.0})
    assert reason == "cluster.lowest: 2 m is not below cluster.highest 1 m"
    assert world.set("people", **{"track.coast": 3.0, "mount.z": 1.4}) == ""
    assert "mount.z" in world.set("people", **{"mount.z": -1.0})
    assert world.get("people", "track.coast", "mount.z", "cluster.highest") == [3.0, 1.4, 2.3]
    markers = world.collect(MarkerArray, "people/markers")
    assert world.until(lambda: markers.matched)
    assert world.transition("people", "deactivate")
    assert world.until(lambda: markers), node.text
    assert [one.action for one in markers.last.markers] == [Marker.DELETEALL]
    assert world.until(lambda: to_points.get_subscription_count() == 0)
    assert world.transition("people", "activate")
    assert world.until(lambda: to_points.get_subscription_count() and to_sigma.get_subscription_count())
    send(6)
    assert world.until(lambda: said.values(people).get("missing_background_frames") == "0"), node.text


def test_what_takes_seconds_to_import_is_there_before_the_first_frame(world: World) -> None:
    node = world.start("people_node")
    said = world.diagnostics()
    assert world.until(lambda: said.of("/camera/people: frames")), node.text
    assert "sklearn" in Path(f"/proc/{node.pid}/maps").read_text()


def test_a_wrong_mount_ends_the_start_with_one_line(world: World) -> None:
    node = world.start("people_node", **{"mount.z": -2.0})
    assert node.wait() == 2
    assert node.text.startswith("people_node: mount.z: ")
    assert "camera above the floor [m]" in node.text
    assert len(node.text.splitlines()) == 1


def test_halves_of_frames_are_paired_by_stamp() -> None:
    pairing = CloudPairing()
    assert pairing.add(POINTS, 10, "p10") is None
    assert pairing.add(SIGMA, 20, "s20") is None
    assert pairing.add(POINTS, 20, "p20") == ("p20", "s20")
    assert pairing.dropped == 0  # the first half had no chance
    assert pairing.add(SIGMA, 30, "s30") is None
    assert pairing.add(POINTS, 40, "p40") is None
    assert pairing.add(SIGMA, 40, "s40") == ("p40", "s40")
    assert pairing.dropped == 1
    for stamp in range(50, 150, 10):
        assert pairing.add(POINTS, stamp, "p") is None
    assert pairing.dropped == 3  # eight wait
    assert pairing.add(SIGMA, 70, "s70") == ("p", "s70")
