"""One case of the benchmark: what the tool is given, and the sealed truth beside it."""

import hashlib
import json
import zlib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from . import catalogue
from .base import FORMS, LeftOut
from .catalogue import (
    CONFOUNDED,
    MASKABLE,
    NULL_SCENES,
    OUTSIDE,
    PAIRED,
    STRENGTHS,
    TIERS,
    VOCABULARY,
)
from .electronics import AmplitudeOffset, IncidenceAngle
from .images import record
from .known import draw_camera
from .recording import scene_document, write_recording, write_yaml
from .refit import refit
from .scenes import POSE_SIGMA, SCENES, draw_scene
from .sensor import Sensor
from .strength import Size, amount_for, size_of
from .world import Hidden, World

SATURATED_SHARE = 0.985
"""Quantile of the amplitudes at which a camera with a low saturation saturates."""
CANCELLED_UP_TO = np.pi * 60.0 / 200.0
"""60 gon, the range over which the thesis' two effects cancel (sec. 3.3.6)."""


@dataclass
class Truth:
    """What was left out of one case; `truth.json` holds these fields."""

    effects: list[str]
    strength: dict[str, float]
    tier: str
    forms: str
    scene: str
    seed: int
    verdict: str
    masked: bool
    size: tuple[int, int]
    covariates: list[str] = field(default_factory=list)
    strength_wanted: dict[str, float] = field(default_factory=dict)
    strength_local: float | None = None
    strength_together: float | None = None
    left_after_masking: float | None = None
    cancellation: float | None = None
    hidden_rms_m: float = 0.0
    sigma_median_m: float = 0.0
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    known_before_masking: dict[str, Any] = field(default_factory=dict)
    pose_sigma: list[float] = field(default_factory=lambda: list(POSE_SIGMA))
    valid_share: float = 0.0

    def write(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(asdict(self), indent=1, sort_keys=True) + "\n", encoding="utf-8")


def make_case(
    out: Path,
    *,
    tier: str,
    effect: str | None = None,
    scene: str | None = None,
    seed: int,
    strength: float | None = None,
    size: tuple[int, int] = (88, 72),
    forms: str = "scoring",
    masked: bool | None = None,
    storage: str = "mcap",
) -> Truth:
    """Write a case folder and return its truth; what is not given is drawn from the seed.

    `effect` is a name (two joined by `+` in the tier `two`), `strength` the RMS of effect over the median
    single-frame sigma (of each effect), `size` columns and rows. `masked` overrides what the tier says.

    Raises
    ------
    ValueError: tier, effect, scene or form is unknown or they do not go together.
    FileExistsError: `out` exists.
    """
    if tier not in TIERS or forms not in FORMS:
        raise ValueError(
            f"tier {tier!r} is none of {', '.join(TIERS)}, or forms {forms!r} none of {', '.join(FORMS)}"
        )
    out = Path(out)
    if out.exists():
        raise FileExistsError(f"{out} exists")
    rng = np.random.default_rng([seed, 3, TIERS.index(tier)])
    names = _effects(tier, effect, rng)
    scene = _scene(tier, names, scene, rng)
    wanted = {
        name: float(strength) if strength is not None else float(np.exp(rng.uniform(*np.log(STRENGTHS))))
        for name in names
    }
    if masked is None:
        masked = tier in ("masked", "cancelled", "confounded") or (tier == "null" and rng.uniform() < 0.5)
        masked = masked or (tier in ("two", "unknown") and rng.uniform() < 0.5)
    world = _world(scene, names, seed, size, tier)
    hidden, cancellation = _hidden(world, tier, names, wanted, seed, forms)
    truth = Truth(
        effects=list(names),
        strength={},
        tier=tier,
        forms=forms,
        scene=scene,
        seed=seed,
        verdict={"unknown": "unknown_physics", "null": "consistent"}.get(tier, "missing_physics"),
        masked=bool(masked),
        size=size,
        strength_wanted=wanted,
        cancellation=cancellation,
    )
    together = _describe(truth, world, hidden)
    counts = record(world, hidden, np.random.default_rng([seed, 4]))
    told = world.camera
    if masked:
        truth.known_before_masking = world.camera.document()["effects"]
        told, truth.left_after_masking = refit(
            world, *counts, together if any(effect.kind == "distance" for effect, _ in hidden) else None
        )
    truth.valid_share = float(np.mean(counts[0] > 0))
    _write(out, told.document(), scene_document(world.scene), truth, together)
    write_recording(out / "recording", world.camera, world.scene, counts, storage=storage)
    return truth


def seal(case: Path) -> str:
    """The sha256 of a case's truth.json, to be published before the run.

    Raises
    ------
    FileNotFoundError: the case has no truth (any more).
    """
    return hashlib.sha256((Path(case) / "truth.json").read_bytes()).hexdigest()


def _effects(tier: str, effect: str | None, rng: np.random.Generator) -> tuple[str, ...]:
    if tier == "null":
        return ()
    if tier == "cancelled":
        return ("incidence_angle", "amplitude_offset")
    library = {
        "plain": tuple(VOCABULARY),
        "masked": MASKABLE,
        "confounded": CONFOUNDED,
        "two": PAIRED,
        "unknown": tuple(OUTSIDE),
    }[tier]
    count = 2 if tier == "two" else 1
    if effect is None:
        while True:
            names = tuple(str(name) for name in rng.choice(library, count, replace=False))
            if tier == "confounded" or catalogue.common_scenes(names):
                return names
    names = tuple(effect.split("+"))
    allowed = tuple(OUTSIDE) if tier == "unknown" else tuple(VOCABULARY)
    if len(names) != count or not set(names) <= set(allowed):
        raise ValueError(f"tier {tier!r} takes {count} of {', '.join(allowed)}, not {effect!r}")
    return names


def _scene(tier: str, names: tuple[str, ...], scene: str | None, rng: np.random.Generator) -> str:
    possible = NULL_SCENES if not names else catalogue.common_scenes(names)
    if tier == "cancelled":
        possible = ("tilted",)
    elif tier == "confounded":
        possible = ("sweep",)
    if scene is None:
        if not possible:
            raise ValueError(f"no scene shows {' and '.join(names)} together")
        weights = np.array([0.4 if name == "passage" else 1.0 for name in possible])
        return str(rng.choice(possible, p=weights / weights.sum()))
    if scene not in SCENES:
        raise ValueError(f"scene {scene!r} is none of {', '.join(SCENES)}")
    needed = {"motion": "passage", "multipath": "corner"}
    for name in names:
        if needed.get(name, scene) != scene:
            raise ValueError(f"{name} is seen in the scene {needed[name]!r} only, not in {scene!r}")
    return scene


def _world(scene: str, names: tuple[str, ...], seed: int, size: tuple[int, int], tier: str) -> World:
    rng = np.random.default_rng([seed, 5])
    camera = draw_camera(Sensor(*size), seed)
    if "background_light" in names:
        camera = replace(camera, shot=0.05)
    low_saturation = rng.uniform() < 0.25 and scene in ("rich", "board")
    drawn = draw_scene(scene, seed, monotonic_air=tier == "confounded")
    world = World(camera, drawn)
    if low_saturation or "saturation_bleed" in names:
        lit = np.abs(world.light)[world.geometry.seen]
        world = World(replace(camera, saturation=int(np.quantile(lit, SATURATED_SHARE))), drawn)
    camera = world.camera.without(names)
    library = {**VOCABULARY, **OUTSIDE}
    if any(library[name].per_frame for name in names):
        drawn = replace(drawn, exposures=drawn.exposures.frame_by_frame())
    return World(camera, drawn)


def _hidden(
    world: World, tier: str, names: tuple[str, ...], wanted: dict[str, float], seed: int, forms: str
) -> tuple[Hidden, float | None]:
    library = {**VOCABULARY, **OUTSIDE}
    effects = [
        library[name](
            world, forms, np.random.default_rng([seed, 6, zlib.crc32(name.encode()), FORMS.index(forms)])
        )
        for name in names
    ]
    if tier == "cancelled":
        return _cancelled(world, effects, wanted[names[0]])
    hidden = [(effect, amount_for(world, effect, wanted[effect.name])) for effect in effects]
    return sorted(hidden, key=lambda pair: pair[0].stage), None


def _cancelled(world: World, effects: list[LeftOut], strength: float) -> tuple[Hidden, float]:
    """Incidence against amplitude, and the share that is left.

    The incidence form takes on the constants with which it cancels the other on the optical axis; the
    strength is its own.
    """
    incidence, offset = effects
    assert isinstance(incidence, IncidenceAngle)
    assert isinstance(offset, AmplitudeOffset)
    angle = np.linspace(0.0, CANCELLED_UP_TO, 61)
    reflectivity = world.scene.surfaces[0].reflectivity
    signal = world.camera.gain * reflectivity * np.cos(angle) / 2.5**2
    longer = offset.shape(signal) - offset.shape(signal[:1])

    def rest(constants: "np.ndarray") -> "np.ndarray":
        incidence.cancelling = (float(constants[1]), float(constants[2]))
        return np.asarray(longer - constants[0] * incidence.shape(angle))

    start = [float(longer[-1]), 0.8, 2.0]
    fitted = least_squares(
        rest, start, bounds=([0.0, 0.2, 1.0], [np.inf, 3.0 if incidence.tuning else 1.0, 4.0])
    )
    rest(fitted.x)
    left = float(np.sqrt(np.mean(fitted.fun**2) / np.mean((longer - longer.mean()) ** 2)))
    incidence.drawn["cancelling"] = list(incidence.cancelling or ())
    amount = amount_for(world, incidence, strength)
    return [(incidence, amount), (offset, amount / float(fitted.x[0]))], left


def _describe(truth: Truth, world: World, hidden: Hidden) -> Size:
    together = size_of(world, hidden)
    truth.sigma_median_m = together.median_sigma
    for effect, amount in hidden:
        alone = together if len(hidden) == 1 else size_of(world, [(effect, amount)])
        truth.strength[effect.name] = alone.strength
        truth.parameters[effect.name] = {"amount": float(amount), **effect.drawn}
        truth.covariates += list(effect.covariates)
    if hidden:
        truth.hidden_rms_m = together.rms
        truth.strength_local, truth.strength_together = together.strength_local, together.strength
    return together


def _write(out: Path, camera: dict[str, Any], scene: dict[str, Any], truth: Truth, together: Size) -> None:
    out.mkdir(parents=True)
    write_yaml(out / "camera.yaml", camera)
    write_yaml(out / "scene.yaml", scene)
    truth.write(out / "truth.json")
    np.save(out / "truth.npy", together.per_pixel())
