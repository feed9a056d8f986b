"""A second generator of blind cases: cameras made of samples, with the imperfections that every camera has.

It shares no equation with the package or with the first generator; `equations.md` states its own.
"""

from .case import Case, make_case

__all__ = ["Case", "make_case"]
