"""Whether anything is missing with another set-up: one fit of the recording with its files."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.diagnose.hypotheses import Files
from rim_camera_ros.diagnose.nuisances import common_pose_beyond, optics_beyond, reflectivities_beyond
from rim_camera_ros.diagnose.setup import check_setup, few_of
from rim_camera_ros.diagnose.smooth import axes_of, gradient_terms, single_terms
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.select.moved_poses import moved_given_physics
from rim_camera_ros.select.search import search


def left_by_chance(files: Files, *, seed: int, threads: int) -> float | None:
    """Return the entry threshold [nats] of an effect or a smooth term with the files of a set-up.

    None where one of them gains that much, or where the fit shows errors of poses, reflectivities or optics
    beyond those that these files state: then something else is missing as well.
    """
    dataset, scene, camera = files
    facts = Facts.of(dataset, moves=scene.camera_motion.moves, surfaces=len(scene.surfaces), camera=camera)
    forward = Forward(dataset, scene, camera)
    try:
        forward.estimate_amplitudes()
        samples = axes_of(forward, seed=seed)
        step = search(
            Problem(dataset, scene, stray_light=scene.stray_light, threads=threads),
            camera,
            facts,
            most=0,
            further=[*single_terms(samples), *gradient_terms(samples)],
            seed=seed,
            views=forward.views,
        ).explorations[0]
        beyond = (
            check_setup(step.fit, moved=moved_given_physics(step, few_of(dataset))).reason
            or reflectivities_beyond(step.fit, scene)
            or common_pose_beyond(step.fit, camera)
            or (None if camera.covariance is None else optics_beyond(step.fit))
        )
    except (RimError, np.linalg.LinAlgError):
        return None
    if beyond is not None or bool(np.any(step.gains > step.thresholds)):
        return None
    return float(step.thresholds.max())
