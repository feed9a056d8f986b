"""ROS 2 nodes: thin shells around devices and pipeline; the only place that imports rclpy.

Importing this package pins the threads of BLAS and OpenMP to one (unless the environment says
otherwise): frames are small, and several threads only take time from other nodes. It must happen
before numpy is imported, therefore here.
"""

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
