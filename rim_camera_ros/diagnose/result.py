"""The result of a diagnosis: the verdict, the missing physics and the evidence."""

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
    """A missing effect (or `unknown`): its probability, parameters with 95 % intervals, and a sentence.

    Parameters are by path relative to the effect. ``magnitude`` [m] is its size, ``distance_sigma`` [m] the
    1-sigma of the distances that it causes, apart from what offsets of pixels absorb. For unknown physics
    there are covariates, the closed form ``formula``, and ``model``: the effect of the improved camera that
    describes it (None: none does).
    """

    effect: str
    probability: float
    parameters: Mapping[str, float]
    interval: Mapping[str, tuple[float, float]]
    sentence: str
    covariates: tuple[str, ...] = ()
    magnitude: float | None = None
    formula: str | None = None
    model: str | None = None
    distance_sigma: float | None = None


@dataclass(frozen=True)
class Ranked:
    """A single effect in addition to the known terms: probability, held-out gain [nats], identifiability.

    ``identifiability`` is the share of its energy, at the strength that fits best, that no other parameter
    can imitate; ``expected_gain`` [nats] is the expected gain by that share.
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
    ``next_recording`` are those of the report. ``reason`` says what is wrong with the setup (None: nothing).
    ``camera`` is the improved camera of camera.yaml. ``model`` is the same where all pixels were used, else
    the camera of the coarser grid (``looked_at``), which belongs to the explorations. ``baseline`` is the
    exploration of the known terms with the gain of each candidate, ``final`` that after all steps; ``found``
    are the effects in the order of the steps, ``gained`` [nats] is their total gain. ``unseen`` are effects
    that this recording could not show; ``smooth_rest`` are the covariates and the gain [nats] of the smooth
    function that still gains after naming. ``setups`` are alternative set-ups, the best first; ``nuisances``
    are the estimated ordinary imperfections.
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
        """Step of the grid of pixels that were used, along each axis."""
        if self.looked_at is None:
            return 1
        return round(self.camera.sensor.width / self.looked_at.sensor.width)

    @property
    def model(self) -> Camera:
        """The improved camera on the grid of pixels that were used."""
        return self.camera if self.looked_at is None else self.looked_at
