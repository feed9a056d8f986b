"""Before anything imports a ROS message: messages check their fields, as they do not by default."""

from __future__ import annotations

import os

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
