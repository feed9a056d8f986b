"""Every test in this folder has a ROS domain of its own; without rclpy they are skipped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from test.ros.harness import World

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.ros)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    from test.ros.harness import World

    with World(tmp_path) as one:
        yield one
