"""What a report must never say at once: probabilities, ranking, names, ties and verdict are one result's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Verdicts that name something that was omitted.
_NAMING = ("missing_physics", "unknown_physics")


def contradictions(report: Mapping[str, Any]) -> list[str]:
    """Return in words what a report (report.json) contradicts itself in; empty for a consistent one."""
    found = []
    missing, verdict = report["missing"], report["verdict"]
    if (verdict in _NAMING) != bool(missing):
        found.append(f"{verdict} with {len(missing)} missing")
    if (verdict == "inconsistent_setup") != ("reason" in report):
        found.append(f"{verdict} and a reason do not go together")
    setups = [one["hypothesis"] for one in report.get("setup", [])]
    if verdict != "inconsistent_setup" and setups and setups[0] != "as_given":
        found.append(f"{verdict}, though {setups[0]} ranks above the set-up as given")
    if verdict == "wrong_parameters" and not report["adjusted"]:
        found.append("wrong parameters without any that moved")
    for one in missing:
        if one["probability"] < 0.5:
            found.append(f"{one['effect']} is named with probability {one['probability']:.2g}")
    tied = {name for names in report["indistinguishable"] for name in names}
    named = [one["effect"] for one in missing]
    gains = {one["effect"]: one["held_out_gain"] for one in report["ranking"]}
    if verdict == "missing_physics" and named and named[0] in gains:
        for rival, gain in gains.items():
            if gain > gains[named[0]] and rival not in {*named, *tied}:
                found.append(f"{named[0]} ranks below {rival}, which is neither named nor tied with it")
    fit = report["fit"]
    if verdict == "missing_physics" and "noise" not in named and fit["held_out"]:
        same = (fit["rms_after"], fit["chi2_after"]) == (fit["rms_before"], fit["chi2_before"])
        worse = fit["chi2_after"] > fit["chi2_before"] and fit["rms_after"] > fit["rms_before"]
        if same or worse:
            found.append("missing physics that does not improve held-out poses")
    return found
