"""Which parameters of the optics the observations support."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtrc

from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry.bundle import Adjusted, State
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, optics_vector
from rim_camera_ros.photogrammetry.report import InsignificantParameters


def _groups(estimated: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the groups that may be dropped next: the highest radial order, the decentring, the aspect.

    p1 and p2 are one group: they are components of one vector and mix when the axes are turned.
    """
    groups: list[tuple[str, ...]] = []
    for name in ("k3", "k2", "k1"):
        if name in estimated:
            groups.append((name,))
            break
    decentring = tuple(name for name in ("p1", "p2") if name in estimated)
    if decentring:
        groups.append(decentring)
    if "fy" in estimated:
        groups.append(("fy",))
    return groups


def least_significant(
    adjusted: Adjusted, start: Optics, significance: float, known: Sequence[str] = ()
) -> InsignificantParameters | None:
    """Return the group whose departure from ``start`` is least significant; None if all are significant.

    Its probability by chance exceeds ``significance``.

    ``known``: parameters that have a prior, which need no test.
    """
    departures = adjusted.state.optics - optics_vector(start)
    values = dict(zip(OPTICS_PARAMETERS, departures, strict=True))
    values["fy"] = adjusted.state.optics[1] - adjusted.state.optics[0] * start.fy / start.fx
    transfer = np.eye(len(adjusted.estimated))
    if "fy" in adjusted.estimated:
        # what is tested is fy - fx * (start.fy / start.fx), not the departure from the present ratio
        i, j = adjusted.estimated.index("fy"), adjusted.estimated.index("fx")
        optics = adjusted.state.optics
        transfer[i, j] = optics[1] / optics[0] - start.fy / start.fx
    covariance = transfer @ adjusted.optics_covariance @ transfer.T
    worst: InsignificantParameters | None = None
    for group in _groups([name for name in adjusted.estimated if name not in known]):
        where = [adjusted.estimated.index(name) for name in group]
        value = np.array([values[name] for name in group])
        weight = np.linalg.solve(covariance[np.ix_(where, where)], value)
        statistic = float(value @ weight) / len(group)
        probability = float(fdtrc(len(group), max(adjusted.redundancy, 1), statistic))
        if probability > significance and (worst is None or probability > worst.probability):
            worst = InsignificantParameters(group, statistic, probability)
    return worst


def returned(state: State, names: Sequence[str], start: Optics) -> State:
    """Return the state with these parameters as in ``start``; the adjustment itself holds the ratio of fy."""
    optics, before = state.optics.copy(), optics_vector(start)
    for name in names:
        if name != "fy":
            optics[OPTICS_PARAMETERS.index(name)] = before[OPTICS_PARAMETERS.index(name)]
    return State(optics, state.rotations, state.translations, state.targets)
