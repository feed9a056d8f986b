"""The tables of the documentation are those of the running nodes; parameter files name what there is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("sklearn", reason="scikit-learn is an optional extra, for the people node")

import yaml
from sensor_msgs.msg import CameraInfo, Image

from rim_camera_ros.nodes.calibration import parameters as calibration_parameters
from rim_camera_ros.nodes.common.transforms import mount, optical_rotation
from rim_camera_ros.nodes.correction import parameters as correction_parameters
from rim_camera_ros.nodes.driver import parameters as driver_parameters
from rim_camera_ros.nodes.people import parameters as people_parameters
from test.ros.harness import BEST_EFFORT, World

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "nodes.md").read_text()
PARAMETERS = (ROOT / "docs" / "node_parameters.md").read_text()
#: What every node of ROS has.
_OF_EVERY_NODE = ("use_sim_time", "start_type_description_service", "qos_overrides.")
#: The nodes, by name, with the parameters that they declare.
_SPECS = {
    "driver": driver_parameters.SPECS,
    "correction": correction_parameters.SPECS,
    "calibration": calibration_parameters.SPECS,
    "people": people_parameters.SPECS,
}
_EVERY_TOPIC = ("/rosout", "/parameter_events")
_EVERY_SERVICE = (
    r"/(describe_parameters|get_parameter\w*|list_parameters|set_parameters\w*|get_type_description|"
    + (r"change_state|get_state|get_available_\w+|get_transition_graph)$")
)


def table(page: str, heading: str, first: str) -> list[list[str]]:
    """Return the rows of the first table after a heading whose first column is ``first``."""
    part = page[page.index(heading) :]
    lines = part[part.index(f"| {first} |") :].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2 : lines.index("")]]
    assert rows
    return rows


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with World(tmp_path_factory.mktemp("documentation")) as world:
        world.start("driver_node", scene="wall", publish_clock=True)
        world.start("correction_node")
        diagnostics = world.diagnostics()
        world.start("calibration_node")
        world.start("people_node")
        for name in ("/camera/calibration: work", "/camera/people: people"):
            assert world.until(lambda name=name: diagnostics.of(name)), world.output()
        images = world.collect(Image, "distance/image", BEST_EFFORT)
        assert world.until(lambda: len(images) > 2), world.output()
        yield world


@pytest.mark.parametrize("node", _SPECS)
def test_parameters(nodes: World, node: str) -> None:
    described = nodes.describe(node)
    found_rows = table(PARAMETERS, f"`{node}_node` (node `{node}`)", "parameter")
    rows = {row[0].strip("`"): row[1:] for row in found_rows}
    running = {name for name in described if not name.startswith(_OF_EVERY_NODE)}
    # of each surface three, sixty in the room
    assert not [name for name in described if "ground_truth" in name]
    effects = {name for name in running if name.startswith("effects.")}
    assert running - effects == set(rows) - {"effects.<name>"}
    assert bool(effects) == ("effects.<name>" in rows)
    for spec in _SPECS[node]:
        found, (default, allowed, text, when) = described[spec.name], rows[spec.name]
        assert found.description == spec.description == text
        assert found.read_only == (when == "at start")
        if isinstance(spec.default, bool):
            assert {"true": True, "false": False}[default] is spec.default
        elif isinstance(spec.default, int | float):
            assert float(default) == spec.default
            ranges = found.floating_point_range or found.integer_range
            assert len(ranges) == 1, f"{spec.name} has no range"
            limits = (ranges[0].from_value, ranges[0].to_value)
            assert tuple(map(float, allowed.split(" to "))) == pytest.approx(limits, rel=1e-9)
        else:
            assert default == (spec.default or "empty")
            assert allowed == ", ".join(spec.choices) == found.additional_constraints.removeprefix("one of: ")


def test_topics(nodes: World) -> None:
    documented: dict[str, tuple[str, str]] = {}
    for topics, kind, node, content in table(PAGE, "## Topics", "topic"):
        if content.startswith(("while recording", "in their place")):
            continue  # nothing is recorded here, by a camera of one frequency
        for topic in re.findall(r"`([^`]+)`", topics):
            kinds = kind.split(", ")
            documented[topic] = (kinds[-1] if "camera_info" in topic else kinds[0], node)
    types: dict[str, str] = {}

    def published() -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for node in _SPECS:
            for name, kind in nodes.published_by(node).items():
                if name in _EVERY_TOPIC or name.endswith("/transition_event"):
                    continue
                short = name.removeprefix("/camera/")
                short = re.sub(r"^ground_truth/[^/]+/", "ground_truth/<surface>/", short)
                found.setdefault(short, set()).add(node)
                types[short] = kind.rpartition("/")[2]
        return found

    expected = set(documented) - {"/tf_static"}
    nodes.until(lambda: set(published()) == expected)  # discovery brings topics one by one
    assert set(published()) == expected
    for name, (kind, node) in documented.items():
        if name != "/tf_static":
            assert types[name] == kind.split()[0], name
            assert published()[name] == (set(_SPECS) if node == "all" else {node}), name


def test_services(nodes: World) -> None:
    rows = {row[0].strip("`"): row for row in table(PAGE, "## Services", "service")}

    def offered() -> dict[str, tuple[str, str]]:
        return {
            name.removeprefix("/camera/"): (kind.replace("/srv", ""), node)
            for node in _SPECS
            for name, kind in nodes.served_by(node).items()
            if not re.search(_EVERY_SERVICE, name)
        }

    expected = {name: (row[1], row[2]) for name, row in rows.items()}
    nodes.until(lambda: offered() == expected)
    assert offered() == expected


def test_camera_info_is_what_depth_image_proc_reads(nodes: World) -> None:
    infos = {
        topic: nodes.collect(CameraInfo, topic, BEST_EFFORT)
        for topic in ("camera_info", "distance/camera_info", "depth/camera_info")
    }
    depth = nodes.collect(Image, "depth/image_raw", BEST_EFFORT)
    assert nodes.until(lambda: depth and all(infos.values())), nodes.output()
    for one in infos.values():
        info = one.last
        assert (info.width, info.height) == (depth.last.width, depth.last.height)
        assert info.distortion_model == "plumb_bob"
        assert len(info.d) == 5
        assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        # the projection of the unrectified image: K itself, no baseline
        assert np.allclose(
            np.reshape(info.p, (3, 4)), np.hstack([np.reshape(info.k, (3, 3)), np.zeros((3, 1))])
        )
        assert (info.binning_x, info.roi.do_rectify) == (0, False)
    common = set(infos["depth/camera_info"].by_stamp()) & set(depth.by_stamp())
    assert common or nodes.until(lambda: set(infos["depth/camera_info"].by_stamp()) & set(depth.by_stamp()))
    assert depth.last.header.frame_id == infos["depth/camera_info"].last.header.frame_id


@pytest.mark.parametrize(
    ("file", "specs"),
    [
        ("driver_simulator", driver_parameters.SPECS),
        ("driver_playback", driver_parameters.SPECS),
        ("driver_sr3000", driver_parameters.SPECS),
        ("correction", correction_parameters.SPECS),
        ("calibration", calibration_parameters.SPECS),
    ],
)
def test_parameter_files_name_parameters_and_hold_their_types(file: str, specs: Any) -> None:
    content = yaml.safe_load((ROOT / "config" / f"{file}.yaml").read_text())["/**"]["ros__parameters"]
    known = {one.name: one for one in specs}

    def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key, value in values.items():
            result |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        return result

    for name, value in flat(content).items():
        assert name in known, name
        assert type(value) is type(known[name].default), name
        known[name].check(value)


@pytest.mark.parametrize(
    ("angles", "forward", "right"),
    [
        ({}, (1, 0, 0), (0, -1, 0)),
        ({"yaw": np.pi / 2}, (0, 1, 0), (1, 0, 0)),
        ({"pitch": np.pi / 2}, (0, 0, -1), (0, -1, 0)),
        ({"roll": np.pi / 2}, (1, 0, 0), (0, 0, -1)),
        ({"roll": np.pi / 2, "pitch": np.pi / 2}, (0, 0, -1), (-1, 0, 0)),
    ],
)
def test_mount(angles: dict[str, float], forward: tuple[float, ...], right: tuple[float, ...]) -> None:
    from scipy.spatial.transform import Rotation

    values = {"roll": 0.0, "pitch": 0.0, "yaw": 0.0, **angles}
    rotation = Rotation.from_quat(optical_rotation(**values))
    assert np.allclose(rotation.apply([0, 0, 1]), forward, atol=1e-12)
    assert np.allclose(rotation.apply([1, 0, 0]), right, atol=1e-12)
    # roll, pitch, yaw about fixed axes as URDF has them, then the optical frame of REP 103
    urdf = Rotation.from_euler("xyz", [0.3, -0.2, 1.1]) * Rotation.from_euler(
        "xyz", [-np.pi / 2, 0, -np.pi / 2]
    )
    ours = Rotation.from_quat(optical_rotation(roll=0.3, pitch=-0.2, yaw=1.1))
    assert (ours.inv() * urdf).magnitude() < 1e-12
    message = mount(
        {"base_frame": "base_link", "frame_id": "optical", **{f"mount.{k}": v for k, v in values.items()}}
        | {"mount.x": 0.1, "mount.y": -0.2, "mount.z": 0.9}
    )
    assert (message.header.frame_id, message.child_frame_id) == ("base_link", "optical")
    assert (message.transform.translation.x, message.transform.translation.z) == (0.1, 0.9)


def test_a_base_frame_without_tf2_msgs_is_said(world: World) -> None:
    try:
        import tf2_msgs.msg  # noqa: F401
    except ImportError:
        driver = world.start("driver_node", base_frame="base_link")
        images = world.collect(Image, "distance/image_raw", BEST_EFFORT)
        assert world.until(lambda: len(images) > 2), world.output()
        missing = "no transform is published (sudo apt install ros-jazzy-tf2-msgs)"
        assert world.until(lambda: missing in driver.text), world.output()
    else:
        from tf2_msgs.msg import TFMessage

        from test.ros.harness import LATCHED

        world.start("driver_node", base_frame="base_link")
        transforms = world.collect(TFMessage, "/tf_static", LATCHED)
        assert world.until(lambda: len(transforms)), world.output()
        assert transforms.last.transforms[0].child_frame_id == "camera_optical_frame"
