"""Errors of the package: one line that states the file, the place in it and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from os import PathLike


class RimError(Exception):
    """The work failed (exit status 1)."""

    exit_status = 1

    def __init__(
        self,
        problem: str,
        *,
        file: str | PathLike[str] | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem = problem
        self.file = None if file is None else str(file)
        self.place = place
        self.remedy = remedy
        super().__init__(str(self))

    def __str__(self) -> str:
        text = ": ".join(part for part in (self.file, self.place, self.problem) if part)
        if self.remedy:
            text += f" ({self.remedy})"
        # text from files may contain control characters of a terminal
        return "".join(
            one if one.isprintable() else one.encode("unicode_escape").decode()
            for one in " ".join(text.split())
        )

    def located(self, file: str | PathLike[str]) -> RimError:
        """Return the same error with this file, unless it has one already."""
        if self.file is not None:
            return self
        return type(self)(self.problem, file=file, place=self.place, remedy=self.remedy)


class InputError(RimError):
    """The input or the usage is wrong (exit status 2)."""

    exit_status = 2


class DeviceError(RimError):
    """A camera, simulated or real, cannot deliver."""


def nearest_name(name: object, known: Iterable[str]) -> str:
    """Return a remedy that names the nearest known name, or lists all of them."""
    names = sorted(str(one) for one in known)
    close = difflib.get_close_matches(str(name)[:100], names, n=1, cutoff=0.5)
    if close:
        return f"did you mean '{close[0]}'?"
    return "known: " + ", ".join(names) if names else "no key is allowed here"
