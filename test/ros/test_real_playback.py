"""The real recordings through driver_node and correction_node: what they are known to show is still there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rim_camera_ros.bags import Recording
from test.real.analysis import black_squares, wall_residual
from test.real.test_real_recordings import RECORDINGS, check_black_squares, check_wall
from test.ros.harness import Chain, World

pytestmark = pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the real recordings are not beside this checkout (../shared/recordings)"
)


def play(world: World, folder: Path) -> Chain:
    """Return all that the nodes make of one pass over a recording."""
    camera = str(folder / "camera.yaml")
    chain = Chain(
        world,
        driver={
            "source": "playback",
            "recording": str(folder / "recording"),
            "loop": False,
            "stamps": "recorded",
            "playback_rate": 10.0 if "kinect" in folder.name else 1.0,
        },
        correction={"camera": camera},
    )
    chain.finish()
    return chain


def test_o3d303_wall(world: World) -> None:
    chain = play(world, RECORDINGS / "o3d303_wall")
    assert len(chain.points) == 3
    check_wall(wall_residual(list(chain.clouds().values())))


@pytest.mark.slow
def test_kinect_black_squares(world: World) -> None:
    folder = RECORDINGS / "kinect2_checkerboard"
    chain = play(world, folder)
    with Recording(folder / "recording") as bag:
        poses = {frame.stamp: frame.truth["board"] for frame in bag.frames()}
    clouds = chain.clouds()
    assert sorted(clouds) == sorted(poses)
    check_black_squares(
        *black_squares(
            (cloud, np.array(poses[stamp].position), np.array(poses[stamp].orientation))
            for stamp, cloud in sorted(clouds.items())
        )
    )
