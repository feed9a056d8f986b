"""What is left of a recording once the truth has been taken out of it.

The truth refitted would leave the residuals of the same recording without the effect, compared with the
camera's true known terms. The generator can make that one: the same seed and thus the same scene, camera
and noise, with an effect of a millionth of a sigma.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.scene import load_scene
from rim_camera_ros.select.evidence import Scores, folds_of

from .generator import Truth, make_case

NEXT_TO_NOTHING = 1e-6
#: Effects that change no mean, so that no model of the mean explains any of the variance.
WITHOUT_MEAN = frozenset({"noise", "interference"})


def chi_square_of_truth(truth: Truth, folder: Path) -> float | None:
    """Chi-square per value of held-out poses with the true model; None where it has no meaning.

    It is measured as `rim diagnose` measures its `chi2_before`: errors of poses, powers and the fixed
    pattern are estimated, parameters are not.
    """
    if not truth.effects or WITHOUT_MEAN & set(truth.effects):
        return None
    shutil.rmtree(folder, ignore_errors=True)
    make_case(
        folder,
        tier=truth.tier,
        effect=None if truth.tier == "cancelled" else "+".join(truth.effects),
        scene=truth.scene,
        seed=truth.seed,
        strength=NEXT_TO_NOTHING,
        size=truth.size,
        forms=truth.forms,
        masked=False,
    )
    try:
        camera, scene = load_camera(folder / "camera.yaml"), load_scene(folder / "scene.yaml")
        dataset = reduce_recording(folder / "recording", camera)
        dataset.with_poses(scene)
        frozen = Problem(dataset, scene, effects=(), gain=False, robust=False)
        fitted = fit(frozen, camera, fold_of=folds_of(dataset), iterations=1)
        total, values = Scores(fitted.equations, range(len(fitted.parameters))).chi_square(held_out=True)
        return total / max(values, 1)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
