"""Two publishers of the raw topics in one namespace mix their frames: the correction says who they are."""

from __future__ import annotations

import signal

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image, PointCloud2

from test.ros.harness import BEST_EFFORT, World

OK, WARN = 0, 1
CHECK = "/camera/correction: publishers"
TOPICS = ("frame_info", "amplitude/image_raw", "distance/image_raw")


@pytest.mark.parametrize("together", [False, True], ids=["own process", "process of its driver"])
def test_two_drivers_of_one_name_are_warned_of_once(world: World, together: bool) -> None:
    if together:
        first = correction = world.start("camera_node", scene="wall", frame_rate=10.0)
    else:
        first = world.start("driver_node", scene="wall", frame_rate=10.0)
        correction = world.start("correction_node")
    said = world.diagnostics()
    points = world.collect(PointCloud2, "points", BEST_EFFORT)
    assert world.until(lambda: len(points) > 2 and said.level(CHECK) == OK), world.output()
    assert world.until(lambda: said.values(CHECK) == {f"/camera/{one}": "/camera/driver" for one in TOPICS})
    assert said.message(CHECK) == "one camera at most"
    second = world.start("driver_node", scene="corner", frame_rate=10.0)
    names = {f"/camera/{one}": "/camera/driver, /camera/driver" for one in TOPICS}
    assert world.until(lambda: said.values(CHECK) == names), world.output()
    assert said.level(CHECK) == WARN
    warning = "frames of several publishers mix: /camera/driver, /camera/driver publish /camera/frame_info, "
    assert said.message(CHECK).startswith(warning)
    count = len(said.of(CHECK))
    assert world.until(lambda: len(said.of(CHECK)) > count + 3)  # further looks
    assert correction.text.count(warning) == 1
    second.send(signal.SIGINT)
    assert second.wait() == 0
    assert world.until(lambda: said.level(CHECK) == OK), said.message(CHECK)
    assert first.running
    # another one, of another name, is another change
    third = world.publisher(Image, "distance/image_raw", BEST_EFFORT)
    other = (
        "frames of several publishers mix: /camera/driver, /test_listener publish /camera/distance/image_raw;"
    )
    assert world.until(lambda: said.level(CHECK) == WARN and other in correction.text), correction.text
    assert said.message(CHECK).startswith(other)
    assert correction.text.count("several publishers") == 2
    world.node.destroy_publisher(third)
    assert world.until(lambda: said.level(CHECK) == OK), said.message(CHECK)
