"""Topics by role, namespaces and what a recording's names are taken for."""

from __future__ import annotations

import pickle

import pytest

from rim_camera_ros.bags import ROLES, Topics
from rim_camera_ros.bags.topics import (
    CAMERA_INFO,
    DIAGNOSTICS,
    IMAGE,
    RAW_ROLES,
    listed,
    require_images,
    resolve,
)
from rim_camera_ros.errors import InputError


def test_names_of_the_default_namespace() -> None:
    topics = Topics()
    assert {role: topics[role] for role in ROLES} == {
        "distance": "/camera/distance/image_raw",
        "amplitude": "/camera/amplitude/image_raw",
        "camera_info": "/camera/camera_info",
        "frame_info": "/camera/frame_info",
        "temperature": "/camera/temperature",
        "ambient": "/camera/ambient_temperature",
        "reference": "/camera/reference",
        "truth": "/ground_truth/<surface>/pose",
        "truth_with_covariance": "/ground_truth/<surface>/pose_with_covariance",
        "points": "/camera/points",
        "sigma": "/camera/sigma/image",
        "flags": "/camera/flags/image",
        "corrected_distance": "/camera/distance/image",
        "depth": "/camera/depth/image_raw",
    }
    assert topics.truth("board") == "/ground_truth/board/pose"
    assert topics.paired_info("distance") == "/camera/distance/camera_info"
    assert topics.paired_info("depth") == "/camera/depth/camera_info"
    assert not set(RAW_ROLES) & {"truth", "truth_with_covariance"}
    assert topics.truth("board", role="truth_with_covariance") == "/ground_truth/board/pose_with_covariance"


def test_namespace_and_overrides() -> None:
    topics = Topics.parse(["distance=tof/d", "corrected distance=/x"], "left/tof/")
    assert topics.namespace == "/left/tof"
    assert topics["distance"] == "/tof/d"
    assert topics["corrected_distance"] == "/x"
    assert topics["amplitude"] == "/left/tof/amplitude/image_raw"
    assert topics["truth"] == "/ground_truth/<surface>/pose"
    assert Topics("")["camera_info"] == "/camera_info"


def test_topics_are_values() -> None:
    a, b = Topics.parse(["distance=/d"]), Topics(overrides={"distance": "/d"})
    assert a == b
    assert hash(a) == hash(b)
    assert pickle.loads(pickle.dumps(a)) == a


@pytest.mark.parametrize(
    ("topic", "surface"),
    [
        ("/ground_truth/board/pose", "board"),
        ("/ground_truth//pose", None),
        ("/ground_truth/a/b/pose", None),
        ("/camera/ground_truth/board/pose", "board"),
        ("/front/ground_truth/board/pose", None),  # of another camera
        ("/camera/ground_truth/a/b/pose", None),
        ("/ground_truth/pose", None),
        ("/camera/points", None),
    ],
)
def test_surface_of_a_truth_topic(topic: str, surface: str | None) -> None:
    assert Topics().surface_of(topic) == surface


def test_true_poses_are_found_below_the_namespace_and_without_it() -> None:
    front = Topics("/front")
    assert front.surface_of("/front/ground_truth/board/pose") == "board"
    assert front.surface_of("/ground_truth/board/pose") == "board"
    assert front.surface_of("/rear/ground_truth/board/pose") is None
    name = "/front/ground_truth/board/pose_with_covariance"
    assert front.surface_of(name, role="truth_with_covariance") == "board"
    assert front.surface_of(name) is None
    named = Topics.parse(["truth=/tracker/<surface>/pose"], "/front")
    assert named.surface_of("/front/ground_truth/board/pose") is None  # somebody says where they are


def test_the_topic_of_a_pose_with_its_covariance() -> None:
    topics = Topics.parse(["truth=/tracker/<surface>/pose"])
    name = topics.truth("board", role="truth_with_covariance")
    assert name == "/tracker/board/pose_with_covariance"
    assert topics.surface_of(name, role="truth_with_covariance") == "board"
    assert topics.surface_of(name) is None
    assert Topics.parse(["truth=/tracker/<surface>"])["truth_with_covariance"] == (
        "/tracker/<surface>/pose_with_covariance"
    )


@pytest.mark.parametrize(
    ("option", "match"),
    [
        ("distanc=/a", r"--topic distanc=/a: no role 'distanc' \(did you mean 'distance'\?\)"),
        ("zzz=/a", "no role 'zzz'.*known: ambient, amplitude"),
        ("distance", "--topic distance: no '=' in it"),
        ("distance=", "'' is not a topic name"),
        ("distance=/a b", "'/a b' is not a topic name"),
        ("distance=/a//b", "'/a//b' is not a topic name"),
        (
            "distance=/camera/amplitude/image_raw",
            "/camera/amplitude/image_raw is both distance and amplitude",
        ),
        ("truth=/pose", "<surface> stands for the surface's name.*truth=/ground_truth/<surface>/pose"),
        ("depth=/x/<surface>", "<surface> stands for"),
    ],
)
def test_wrong_options_are_refused(option: str, match: str) -> None:
    with pytest.raises(InputError, match=match):
        Topics.parse([option])


def test_a_role_given_twice_is_refused() -> None:
    with pytest.raises(InputError, match="the role depth is given twice"):
        Topics.parse(["depth=/a", "depth=/b"])


def test_a_malformed_namespace_is_refused() -> None:
    with pytest.raises(InputError, match=r"^namespace: 'a b' is not a topic name"):
        Topics("a b")


def test_one_other_namespace_is_taken() -> None:
    types = {"/left/tof/distance/image_raw": IMAGE, "/left/tof/amplitude/image_raw": IMAGE}
    topics, said = resolve(Topics(), types)
    assert topics["frame_info"] == "/left/tof/frame_info"
    assert said == ["the topics are those of the namespace /left/tof"]
    require_images(topics, types)


def test_the_default_namespace_comes_first() -> None:
    types = {"/a/distance/image_raw": IMAGE, "/camera/distance/image_raw": IMAGE}
    topics, said = resolve(Topics(), types)
    assert (topics.namespace, said) == ("/camera", [])


def test_two_other_namespaces_must_be_chosen_from() -> None:
    types = {"/b/distance/image_raw": IMAGE, "/a/distance/image_raw": IMAGE}
    with pytest.raises(InputError, match=r"2 namespaces hold distance images: /a, /b \(choose one"):
        resolve(Topics(), types)
    topics, said = resolve(Topics("/b"), types)
    assert (topics["distance"], said) == ("/b/distance/image_raw", [])


def test_an_explicit_distance_is_not_looked_for() -> None:
    types = {"/a/distance/image_raw": IMAGE, "/b/distance/image_raw": IMAGE}
    topics, said = resolve(Topics.parse(["distance=/b/distance/image_raw"]), types)
    assert (topics.namespace, said) == ("/camera", [])


def test_swissranger_names_are_recognised() -> None:
    types = dict.fromkeys(
        (
            "/sr/distance/image_raw",
            "/sr/distance/image_raw16",
            "/sr/intensity/image_raw",
            "/sr/intensity/image_raw16",
        ),
        IMAGE,
    )
    topics, said = resolve(Topics(), types)
    assert topics["distance"] == "/sr/distance/image_raw16"
    assert topics["amplitude"] == "/sr/intensity/image_raw16"
    assert len(said) == 3
    del types["/sr/intensity/image_raw16"]
    topics, said = resolve(Topics(), types)
    assert topics["amplitude"] == "/sr/intensity/image_raw"
    assert "256 counts each if it is mono8" in said[-1]


def test_swissranger_names_without_a_namespace() -> None:
    types = {"/distance/image_raw16": IMAGE, "/intensity/image_raw16": IMAGE}
    topics, said = resolve(Topics(), types)
    assert topics["distance"] == "/distance/image_raw16"
    assert said[0] == "the topics are those of the namespace /"


def test_camera_info_beside_the_distance_is_found() -> None:
    types = {"/camera/distance/image_raw": IMAGE, "/camera/distance/camera_info": CAMERA_INFO}
    assert resolve(Topics(), types)[0]["camera_info"] == "/camera/distance/camera_info"


@pytest.mark.parametrize(
    ("types", "options", "match"),
    [
        ({"/camera/distance/image_raw": IMAGE, "/i": IMAGE}, [],
         r"distance without amplitude: no topic /camera/amplitude/image_raw; topics of type "
         r"sensor_msgs/Image: /camera/distance/image_raw, /i \(name it with --topic amplitude=name\)"),
        ({"/camera/amplitude/image_raw": IMAGE}, [],
         "amplitude without distance: no topic /camera/distance/image_raw"),
        ({"/rosout": "rcl_interfaces/msg/Log"}, [], "no sensor_msgs/Image; topics: /rosout"),
        ({}, [], "topics: none"),
        ({"/camera/distance/image_raw": CAMERA_INFO}, [],
         "topic /camera/distance/image_raw: its type is sensor_msgs/msg/CameraInfo, the role distance needs"),
        ({"/camera/distance/image_raw": IMAGE, "/camera/amplitude/image_raw": IMAGE, "/f": DIAGNOSTICS},
         ["frame_info=/g"], "no topic /g; topics of type diagnostic_msgs/DiagnosticArray: /f"),
    ],
)  # fmt: skip
def test_missing_topics_are_named(types: dict[str, str], options: list[str], match: str) -> None:
    with pytest.raises(InputError, match=match):
        require_images(Topics.parse(options), types)


def test_long_lists_are_cut() -> None:
    assert listed([f"/t{i:02}" for i in range(15)]).endswith("/t11 and 3 more")
