"""Messages check their fields, set before anything imports one; limits of time of tests that take long."""

from __future__ import annotations

import os

import pytest

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

#: Seconds that tests of these markers may take, on a machine that has other work as well.
LIMITS = {"slow": 2400, "long": 900}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests that take long more time than others, where they state none themselves."""
    for item in items:
        if item.get_closest_marker("timeout"):
            continue
        for marker, limit in LIMITS.items():
            if item.get_closest_marker(marker):
                item.add_marker(pytest.mark.timeout(limit))
                break
