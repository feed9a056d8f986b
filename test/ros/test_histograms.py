"""A single-photon array on a robot: histograms on request, and the correction that evaluates them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, Temperature

from rim_camera_ros import messages
from rim_camera_ros.bags.messages import image_array
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.measurement import measurement_of
from test.ros.harness import LOSSLESS_CORRECTION, LOSSLESS_DRIVER, RELIABLE, World

ROLES = ("distance", "amplitude", "histogram")


@pytest.mark.parametrize("samples", [True, False])
def test_the_histogram_comes_for_who_asks_and_is_evaluated_where_it_is_wanted(
    world: World, samples: bool
) -> None:
    driver = world.start(
        "driver_node", scene=str(find_scene("corner")), camera="epfl32", frame_rate=4, **LOSSLESS_DRIVER
    )
    correction = world.start("correction_node", camera="epfl32", samples=samples, **LOSSLESS_CORRECTION)
    out = {one: world.collect(Image, f"{one}/image", RELIABLE) for one in ("distance", "sigma")}
    raw = {one: world.collect(Image, f"{one}/image_raw", RELIABLE) for one in ROLES[:2]}
    info = world.collect(DiagnosticArray, "frame_info", RELIABLE)
    warmth = world.collect(Temperature, "temperature", RELIABLE)

    def common(*topics: object) -> set[int]:
        return set.intersection(*(set(one.by_stamp()) for one in topics))  # type: ignore[attr-defined]

    assert world.until(lambda: common(*raw.values(), *out.values(), info, warmth)), (
        driver.text + correction.text
    )
    raw["histogram"] = world.collect(Image, "histogram/image_raw", RELIABLE)
    assert world.until(lambda: common(*raw.values(), *out.values(), info, warmth)), driver.text
    stamp = max(common(*raw.values(), *out.values(), info, warmth))
    message = raw["histogram"].by_stamp()[stamp]
    assert (message.encoding, message.width, message.height) == ("16UC128", 32, 32)
    assert message.step == 32 * 128 * 2
    assert not message.is_bigendian
    images = {role: image_array(raw[role].by_stamp()[stamp]) for role in ROLES[:2]}
    images["histogram"] = np.frombuffer(message.data, "<u2").reshape(32, 32, 128)
    settings = messages.frame_info(info.by_stamp()[stamp]).settings
    settings = replace(settings, body_temperature=warmth.by_stamp()[stamp].temperature)
    frame = RawFrame(
        stamp=stamp,
        distance=images["distance"],
        amplitude=images["amplitude"],
        settings=settings,
        images={"histogram": images["histogram"]} if samples else {},
    )
    camera = load_camera(find_camera("epfl32"))
    expected = measurement_of(camera).correction(camera).correct(frame)
    published = {one: image_array(topic.by_stamp()[stamp]) for one, topic in out.items()}
    assert np.isfinite(expected.distance).mean() > 0.9
    np.testing.assert_allclose(published["distance"], expected.distance, atol=2e-5, equal_nan=True)
    np.testing.assert_allclose(published["sigma"], expected.sigma, rtol=1e-3, equal_nan=True)
    # the counts of a pixel tell its own sigma: that of the file's noise is another one
    other = replace(frame, images={} if samples else {"histogram": images["histogram"]})
    unlike = measurement_of(camera).correction(camera).correct(other).sigma / expected.sigma
    assert np.nanstd(unlike) > 0.003
