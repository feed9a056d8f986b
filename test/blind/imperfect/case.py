"""One case: drawn from its seed until an expert could decide it, then written with its truth."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import combined, drafts
from .drafts import ANY_STYLE, OF_AMPLITUDE, SETUP_STYLES, SINGLES, SIZES, Draft
from .files import camera_document, scene_document, untold, write_recording, write_yaml
from .imperfections import OFF, draw_world
from .scenes import draw_scene
from .setups import SETUPS, decidable

ATTEMPTS = 24


@dataclass(frozen=True)
class Case:
    """A case to make: its tier, seed, the effects or the set-up, and the imperfections (`OFF`)."""

    name: str
    tier: str
    seed: int
    effects: tuple[str, ...] = ()
    imperfections: str = "all"


def make_case(folder: Path, case: Case) -> dict[str, Any]:
    """Write recording, camera.yaml, scene.yaml, covariance.npy, truth.json and truth.npy into a new folder.

    Returns the truth. Raises RuntimeError where no draw could be decided by an expert.
    """
    started = time.process_time()
    for attempt in range(ATTEMPTS):
        draft = _draft(case, attempt)
        if draft is not None:
            return _write(folder, case, draft, attempt, started)
    raise RuntimeError(f"{case.name}: none of {ATTEMPTS} draws could be decided by an expert")


def _draft(case: Case, attempt: int) -> Draft | None:
    rng = np.random.default_rng([case.seed, attempt])
    style = str(rng.choice(_styles(case)))
    scene = draw_scene(style, rng)
    if case.tier != "wrong_parameters" and "emission_pattern" in case.effects:
        scene = replace(scene, falloff=(0.0, 0.0))
    world, stated = draw_world(scene, OFF[case.imperfections], rng)
    size = float(np.exp(rng.uniform(*np.log(SIZES)))) * 1.15**attempt
    if case.tier == "setup" and not decidable(scene, case.effects[0]):
        return None
    if case.tier in ("null", "setup"):
        return Draft(world, world, stated, setup=case.effects[0] if case.effects else None)
    make = {
        "single": drafts.single,
        "wrong_parameters": drafts.wrong,
        "two": combined.several,
        "three": combined.several,
        "cancelled": combined.cancelled,
        "concealed": combined.concealed,
        "unknown": drafts.single,
    }
    return make[case.tier](case.effects, world, stated, size, rng)


def _styles(case: Case) -> tuple[str, ...]:
    if case.tier == "setup":
        return ("board", "sweep", "boxes") if case.effects[0] in ("depth", "sign_of_angle") else SETUP_STYLES
    if case.tier == "wrong_parameters" and case.effects[0] in ("incidence_angle", "integration_time_offset"):
        return ("board", "sweep", "boxes")
    if case.tier == "cancelled":
        return ("plain",)
    if case.tier in ("null", "wrong_parameters"):
        return ANY_STYLE
    found = set(ANY_STYLE)
    for name in case.effects:
        found &= set(SINGLES[name][2])
    if case.tier == "concealed":
        found &= {"board", "boxes", "sweep"}
    return tuple(one for one in ANY_STYLE if one in found)


def _write(folder: Path, case: Case, draft: Draft, attempt: int, started: float) -> dict[str, Any]:
    folder.mkdir(parents=True)
    rng = np.random.default_rng([case.seed, attempt, 1])
    world, believed, stated = draft.world, draft.believed, draft.stated
    told = untold(world.scene.surfaces, stated, stated.lens)
    if draft.setup is not None:
        told = SETUPS[draft.setup](world.scene, stated, rng)
    write_recording(folder / "recording", world, stated, told, rng)
    hidden = set(world.hidden)
    document = camera_document(
        world,
        stated,
        told,
        known=believed.known,
        cyclic=None if "cyclic_error" in hidden else believed.sensor.cyclic(),
        falloff="emission_pattern" not in hidden,
        blur=None if "mixed_pixels" in hidden else stated.blur,
    )
    write_yaml(folder / "camera.yaml", document)
    np.save(folder / "covariance.npy", stated.covariance)
    write_yaml(folder / "scene.yaml", scene_document(told, world.scene.pose_sigma))
    judged = draft.judgement
    truth = {
        "effects": list(case.effects),
        "tier": case.tier,
        "imperfections": case.imperfections,
        "off": list(OFF[case.imperfections]),
        "style": world.scene.style,
        "hypothesis": told.hypothesis,
        "surface": told.surface,
        "detail": told.detail,
        "moved": list(told.moved),
        "size": draft.sizes or {},
        "size_kind": {name: "amplitude" for name in draft.sizes or {} if name in OF_AMPLITUDE},
        "total": judged.size if judged else None,
        "share": judged.share if judged else None,
        "nats": judged.nats if judged else None,
        "rival": judged.rival if judged else None,
        "rival_nats": judged.rival_nats if judged else None,
        "masked": case.tier == "concealed",
        "absorbed": draft.absorbed,
        "strength": dict(world.hidden),
        "parameters": draft.parameters or {},
        "attempt": attempt,
        "seed": case.seed,
        "seconds": time.process_time() - started,
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    size = world.scene.shape
    np.save(folder / "truth.npy", judged.map if judged else np.zeros(size, np.float32))
    return truth
