"""When an effect enters the model: beyond chance, and beyond what poses disagree about.

The form of an effect that was found is never quite the true one. What it leaves is compared with candidates
as one of them: a smooth curve of a covariate that the effect depends on enters as its discrepancy (Kennedy
and O'Hagan 2001), unnamed, where it predicts held-out poses better than every named candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rim_camera_ros.calibrate.exploration import Exploration

#: Paired standard errors over poses that an effect must gain beside those found before it. The null
#: replicates give the threshold of the first; what forms leave that are not quite true is not in them.
PAIRED_ERRORS = 2.0
#: An effect must move distances by this much somewhere [m] (RMS over the 5 % of pixels it moves most).
LEAST_SIZE = 0.0005


@dataclass
class Found:
    """An effect that joined: its gain in nats alone at that step, and which others explain it as well.

    ``step`` is the number of the exploration that it was found in.
    """

    effect: str
    gain: float
    ties: list[str] = field(default_factory=list)
    step: int = 0


def paired_error(after: Sequence[float], before: Sequence[float]) -> float:
    """Return the standard error [nats] of a gain of held-out log likelihood, from those of folds of poses.

    The folds' differences are paired (Vehtari, Gelman, Gabry 2017, eq. 23). 0 for fewer than two folds.
    """
    gains = np.asarray(after, float) - np.asarray(before, float)
    return float(np.sqrt(len(gains)) * np.std(gains, ddof=1)) if len(gains) > 1 else 0.0


def curve_of_forms(step: Exploration, found: Sequence[Found]) -> tuple[float, int] | None:
    """Return gain and number of the best smooth curve of what the effects found depend on, if there is one.

    The gain is that beside the changes of forms which the exploration has already.
    """
    effects = [step.fit.camera.effects.get(one.effect) for one in found]
    own = {name for one in effects if one is not None for name in one.own_covariates()}
    smooth = [k for k in range(step.named, len(step.candidates)) if step.candidates[k].variant in own]
    return max(((step.joint(k), k) for k in smooth), default=None)
