"""Generator of the blind benchmark: recordings of cameras whose file does not tell all of their physics.

It shares no code with the package under test; `equations.md` beside it says what it computes.
"""

from .case import Truth, make_case, seal

__all__ = ["Truth", "make_case", "seal"]
