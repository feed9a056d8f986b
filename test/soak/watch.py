"""What a listener sees of a chain: order and pairing of frames, latency, memory of the processes."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import Image, PointCloud2

from rim_camera_ros.bags.messages import image_array, points_array, settings_from
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.files import find_camera, share_folder
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.nodes.common.run import use_shipped_profile
from rim_camera_ros.pipeline.correct import Correction
from test.ros.harness import BEST_EFFORT, World, stamp_of

# a listener finds a node that is started anew sooner with it, as the nodes do
use_shipped_profile(
    os.environ,
    profile=share_folder() / "config" / "fastdds.xml",
    middleware=get_rmw_implementation_identifier(),
)


class Listener:
    """Points and raw images with their times of arrival; only the last seconds are kept."""

    def __init__(self, world: World, *, raw: bool = True, keep: float = 5.0) -> None:
        self._keep = keep
        self.points: dict[int, Any] = {}
        self.arrived: dict[int, float] = {}
        self.latency: list[tuple[float, float]] = []
        self.raw: dict[str, dict[int, Any]] = {role: {} for role in ("distance", "amplitude", "info")}
        self.raw_count = self.points_count = self.backwards = 0
        self._newest = 0
        world.node.create_subscription(
            PointCloud2, f"{world.namespace}/points", self._take_points, BEST_EFFORT
        )
        if raw:
            for role, kind, topic in (
                ("distance", Image, "distance/image_raw"),
                ("amplitude", Image, "amplitude/image_raw"),
                ("info", DiagnosticArray, "frame_info"),
            ):
                world.node.create_subscription(
                    kind, f"{world.namespace}/{topic}", self._taker(role), BEST_EFFORT
                )

    def _take_points(self, message: PointCloud2) -> None:
        stamp, now = stamp_of(message), time.time()
        self.points_count += 1
        self.backwards += stamp <= self._newest
        self._newest = max(stamp, self._newest)
        self.points[stamp] = message
        self.arrived[stamp] = now
        self.latency.append((now, now - stamp / 1e9))
        self._forget(self.points)

    def _taker(self, role: str) -> Any:
        def take(message: Any) -> None:
            self.raw_count += role == "distance"
            self.raw[role][stamp_of(message)] = message
            self._forget(self.raw[role])

        return take

    def _forget(self, messages: dict[int, Any]) -> None:
        newest = max(messages)
        for stamp in [one for one in messages if one < newest - self._keep * 1e9]:
            del messages[stamp]

    def wrong_pairs(self, camera: str = "sr3000") -> tuple[int, int]:
        """Return how many kept clouds could be computed again from the raw frame of their stamp, and how
        many of these are another one.
        """
        correction = Correction(load_camera(find_camera(camera)))
        whole = set.intersection(set(self.points), *(set(one) for one in self.raw.values()))
        wrong = 0
        for stamp in sorted(whole):
            settings, _ = settings_from(self.raw["info"][stamp])
            frame = RawFrame(
                stamp=stamp,
                distance=image_array(self.raw["distance"][stamp]),
                amplitude=image_array(self.raw["amplitude"][stamp]),
                settings=settings,
            )
            expected = correction.cloud(correction.correct_distance(frame))
            found = points_array(self.points[stamp])
            both = np.isfinite(expected[..., 2]) & np.isfinite(found[..., 2])
            # without the ambient temperature's lag, which is a constant over the image
            apart = np.abs(expected[..., 2] - found[..., 2])[both]
            same = np.array_equal(expected[..., 3], found[..., 3], equal_nan=True)
            wrong += not (same and both.any() and float(apart.max()) < 0.03)
        return len(whole), wrong


def resident(pid: int) -> float:
    """Return the resident memory of a process and its children in MB."""
    process = psutil.Process(pid)
    total = 0
    for one in (process, *process.children(recursive=True)):
        try:
            total += one.memory_info().rss
        except psutil.NoSuchProcess:
            continue
    return total / 2**20


def descriptors(pid: int) -> int:
    """Return the number of open files of a process."""
    return len(os.listdir(f"/proc/{pid}/fd"))
