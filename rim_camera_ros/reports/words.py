"""Words that several reports share."""

from __future__ import annotations

from collections.abc import Sequence

from rim_camera_ros.reports.page import Mood

#: Ratios of differences to their noise up to which they are as expected, and above which they are obvious.
_AS_EXPECTED, _PLAIN = 1.05, 2.0


def joined(words: Sequence[str], last: str = "and") -> str:
    """Return words as an enumeration."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def noise_words(chi_square: float) -> tuple[str, Mood]:
    """Return the meaning of chi-square per value in words, with its mood."""
    ratio = chi_square**0.5
    if ratio <= _AS_EXPECTED:
        return "noise as expected", "good"
    if ratio < _PLAIN:
        return f"{100 * (ratio - 1):.0f} % above the noise", "warn"
    return f"{ratio:.2g} times the noise" if ratio < 100 else f"{ratio:,.0f} times the noise", "warn"


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{share * 100:.0f} %" if share >= 0.01 or share == 0 else f"{share * 100:.2g} %"


def millimetres(value: float) -> str:
    """Return a length [m] in mm with two digits."""
    return f"{float(f'{value * 1e3:.2g}'):,g} mm"
