"""The commands of ``rim``, a module each: ``add_parser`` describes one, its ``run`` does it.

Importing this package pins the threads of BLAS and OpenMP to one (unless the environment says otherwise):
matrices here are small, and next to another busy process several threads wait for each other four times as
long as one computes. It must happen before numpy is imported, therefore here.
"""

from __future__ import annotations

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
