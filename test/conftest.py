"""Messages check their fields, set before anything imports one; limits of time of tests that take long."""

from __future__ import annotations

import os

import pytest

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

#: Seconds that a long test may take, on a machine that has other work as well.
LIMIT_OF_LONG = 900


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give tests that take long more time than others, where they state none themselves."""
    for item in items:
        if item.get_closest_marker("long") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(LIMIT_OF_LONG))
