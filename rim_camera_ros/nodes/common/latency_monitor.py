"""Measures a running driver and correction: latency, rate and lost frames, as a process of its own.

``python -m rim_camera_ros.nodes.common.latency_monitor --frames 1500 --json FILE`` waits for a driver and a
correction under the namespace, listens to the raw distances and the points, and writes a summary.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.yaml_files import write_whole

#: Seconds to wait for frames that are still on their way.
_GRACE = 1.0


class Arrivals:
    """Stamps [ns] and arrival times [ns] of raw and corrected frames."""

    def __init__(self) -> None:
        self.raw: dict[int, int] = {}
        self.points: dict[int, int] = {}

    def summary(self) -> dict[str, Any]:
        """Return counts, rates and latencies in milliseconds (stamp to arrival) as plain numbers."""
        stamps = np.array(sorted(self.raw), dtype=np.int64)
        result: dict[str, Any] = {"raw_frames": len(self.raw), "points": len(self.points)}
        if len(stamps) > 1:
            steps = np.diff(stamps) / NANOSECONDS
            period = float(np.median(steps))
            result["rate_hz"] = 1.0 / period
            result["missing_in_raw"] = int(np.rint(np.maximum(steps / period - 1, 0)).sum())
        # frames before the first points came while the processes were still discovering each other
        first = min(self.points, default=0)
        result["before_first_points"] = sum(stamp < first for stamp in self.raw)
        result["without_points"] = sum(stamp >= first and stamp not in self.points for stamp in self.raw)
        for name, arrived in (("raw", self.raw), ("points", self.points)):
            late = np.array([at - stamp for stamp, at in arrived.items()]) / 1e6
            if late.size:
                result[f"{name}_latency_ms"] = {
                    "median": float(np.median(late)),
                    "p99": float(np.percentile(late, 99)),
                    "max": float(late.max()),
                }
        return result


def listen(*, namespace: str, frames: int, timeout: float) -> Arrivals:
    """Return the arrivals of up to ``frames`` frames; ends when a topic is silent for ``timeout`` seconds."""
    import rclpy
    import rclpy.utilities
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image, PointCloud2

    rclpy.init()
    node = rclpy.create_node("latency_monitor")
    arrivals = Arrivals()
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)

    topics = (("distance/image_raw", Image, arrivals.raw), ("points", PointCloud2, arrivals.points))
    last = dict.fromkeys((topic for topic, _, _ in topics), time.monotonic())

    def note(topic: str, into: dict[int, int]) -> Any:
        def arrived(message: Any) -> None:
            into[message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec] = time.time_ns()
            last[topic] = time.monotonic()

        return arrived

    for topic, kind, into in topics:
        node.create_subscription(kind, f"{namespace}/{topic}", note(topic, into), qos)
    try:
        while min(len(arrivals.raw), len(arrivals.points)) < frames:
            patience = timeout if len(arrivals.points) < frames else _GRACE
            if time.monotonic() - min(last.values()) > patience:
                break
            rclpy.spin_once(node, timeout_sec=0.05)
    finally:
        node.destroy_node()
        rclpy.utilities.try_shutdown()
    return arrivals


def main(argv: list[str] | None = None) -> int:
    """Run the monitor; status 1 where no points came."""
    parser = argparse.ArgumentParser(prog="latency_monitor", description=__doc__)
    parser.add_argument("--namespace", default="/camera")
    parser.add_argument("--frames", type=int, default=100, help="frames to wait for")
    parser.add_argument("--timeout", type=float, default=20.0, help="seconds without a frame that end it")
    parser.add_argument("--json", type=Path, help="file for the summary (default: standard output)")
    given = parser.parse_args(argv)
    try:
        summary = listen(namespace=given.namespace, frames=given.frames, timeout=given.timeout).summary()
    except KeyboardInterrupt:
        return 130
    text = json.dumps(summary, indent=1) + "\n"
    if given.json is None:
        print(text, end="")
    else:
        write_whole(given.json, lambda stream: stream.write(text.encode()))
    return 0 if summary["points"] else 1


if __name__ == "__main__":
    sys.exit(main())
