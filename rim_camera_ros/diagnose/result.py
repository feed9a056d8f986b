"""What a diagnosis says: the verdict, what is missing and the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.accuracy import Accuracy
from rim_camera_ros.diagnose.adjusted import Adjusted
from rim_camera_ros.diagnose.hypotheses import Hypothesis
from rim_camera_ros.diagnose.nuisances import Nuisance
from rim_camera_ros.diagnose.variance import Variance
from rim_camera_ros.diagnose.where import Where
from rim_camera_ros.select.compare import Found
from rim_camera_ros.select.exploration import Exploration


@dataclass(frozen=True)
class Missing:
    """What was left out: effect (or `unknown`), its probability, parameters with 95 % intervals by path
    (relative to the effect), and the sentence; its magnitude [m], and to what the distances that it makes are
    known (1-sigma [m]), but for what offsets of pixels take up; for unknown physics covariates, closed form,
    and whether a new table of the improved camera models it.
    """

    effect: str
    probability: float
    parameters: Mapping[str, float]
    interval: Mapping[str, tuple[float, float]]
    sentence: str
    covariates: tuple[str, ...] = ()
    magnitude: float | None = None
    formula: str | None = None
    modelled: bool = False
    distance_sigma: float | None = None


@dataclass(frozen=True)
class Ranked:
    """An effect alone beside the known terms: probability, held-out gain [nats], how well it can be told.

    ``identifiability`` is the share of its energy, at the strength that fits best, that nothing else takes
    on; ``expected_gain`` [nats] what that share is worth.
    """

    effect: str
    probability: float
    gain: float
    identifiability: float | None = None
    expected_gain: float | None = None


@dataclass
class Diagnosis:
    """The result; `rim_camera_ros.diagnose.report` writes it.

    ``verdict``, ``missing``, ``adjusted``, ``ranking``, ``indistinguishable``, ``where``, ``accuracy`` and
    ``next_recording`` are the report's. ``reason`` says what is wrong with the setup (None: nothing).
    ``camera`` is the improved camera as camera.yaml gets it; ``model`` is the same where all pixels were
    looked at, else that of the coarser grid (``looked_at``), which fits the explorations. ``baseline`` is the
    fit of the known terms with what each candidate would gain, ``final`` that after all steps; ``found`` the
    effects in the order of the steps, ``gained`` [nats] what they gained together. ``unseen`` are effects
    that this recording could not show, ``smooth_rest`` the covariates and the gain [nats] of the smooth
    function that still helps after naming. ``setups`` are what else the scene could be, the best first;
    ``nuisances`` what was estimated of ordinary imperfections.
    """

    verdict: str
    missing: list[Missing]
    adjusted: list[Adjusted]
    ranking: list[Ranked]
    indistinguishable: list[list[str]]
    where: Where
    accuracy: Accuracy
    variance: Variance
    camera: Camera
    baseline: Exploration
    final: Exploration
    found: list[Found]
    next_recording: str | None
    reason: str | None = None
    unseen: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    gained: float = 0.0
    smooth_rest: tuple[str, float] | None = None
    looked_at: Camera | None = None
    setups: list[Hypothesis] = field(default_factory=list)
    nuisances: list[Nuisance] = field(default_factory=list)

    @property
    def step(self) -> int:
        """Of how many pixels along each axis one was looked at."""
        if self.looked_at is None:
            return 1
        return round(self.camera.sensor.width / self.looked_at.sensor.width)

    @property
    def model(self) -> Camera:
        """The improved camera, of as many pixels as were looked at."""
        return self.camera if self.looked_at is None else self.looked_at
