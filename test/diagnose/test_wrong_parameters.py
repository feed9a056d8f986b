"""Known terms of which the camera file states other parameters: said where held-out poses gain by others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Covariance
from rim_camera_ros.diagnose import adjusted as adjusting
from rim_camera_ros.diagnose.adjusted import Adjusted, file_covariance, parameters_matter
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.select.search import search

from ..calibrate.helpers import camera, record, scene, with_wrong_pose


def cyclic(amplitude: float) -> CyclicError:
    """A cyclic error of that amplitude [m], four periods in the ambiguity range."""
    return CyclicError((Harmonic(4, amplitude, 0.7),))


@pytest.mark.long
@pytest.mark.parametrize(
    ("stated", "verdict", "adjusted"),
    [(0.012, "consistent", []), (0.016, "wrong_parameters", ["cyclic_error"])],
)
def test_only_the_term_that_is_wrong_is_adjusted(
    tmp_path: Path, stated: float, verdict: str, adjusted: list[str]
) -> None:
    """Of 12 mm and 16 mm stated; the scale, which is known too, is as the file says."""
    board, scale = scene(tmp_path), DistanceScale(0.004)
    data = record(camera(tmp_path, scale, cyclic(0.012)), board, poses=20, seed=5)
    result = diagnose(data, board, camera(tmp_path, scale, cyclic(stated)))
    assert result.verdict == verdict
    assert [one.effect for one in result.adjusted] == adjusted
    for one in result.adjusted:
        assert one.after["harmonics.0.amplitude"] == pytest.approx(0.012, abs=0.0005)


def test_an_error_of_amplitudes_that_is_stated_is_not_estimated(tmp_path: Path) -> None:
    """Likelihoods that are compared are of the same noise."""
    board = scene(tmp_path)
    data = record(camera(tmp_path), board, poses=6, frames=2, seed=2)
    stated = replace(Problem(data, board), amplitude_error=0.03)
    assert fit(stated, camera(tmp_path)).forward.amplitude_model.tau == 0.03
    assert fit(Problem(data, board), camera(tmp_path)).forward.amplitude_model.tau < 0.02


@pytest.mark.long
def test_poses_that_moved_are_a_set_up_however_many_rounds_find_them(tmp_path: Path) -> None:
    """Two of twenty by 60 and 25 mm: one alone is excluded with a note, two are too many for that."""
    board, truth = scene(tmp_path), camera(tmp_path)
    data = record(truth, board, poses=20, seed=3)
    single = diagnose(with_wrong_pose(data, 5, 0.06), board, truth)
    assert single.verdict == "consistent"
    assert any("poses do not agree" in note for note in single.notes)
    both = diagnose(with_wrong_pose(with_wrong_pose(data, 5, 0.06), 12, -0.025), board, truth)
    assert both.verdict == "inconsistent_setup"
    assert both.setups[0].hypothesis == "pose"


@pytest.mark.parametrize(
    ("stated", "matter"),
    [(0.0, True), (-11.0, True), (-13.0, False)],  # of 20 nats from all folds 8 are the threshold
)
def test_parameters_that_strain_stated_errors_of_poses_gain_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: float, matter: bool
) -> None:
    """What files state of errors that poses share counts as it does where effects enter."""
    known = camera(tmp_path, cyclic(0.012))

    def scores(by_fold: list[float], of_statement: float) -> Any:
        return SimpleNamespace(
            trained=[1],
            log_likelihoods=lambda: by_fold,
            log_likelihood=lambda: sum(by_fold) + of_statement,
        )

    forward = SimpleNamespace(amplitude_model=SimpleNamespace(tau=0.01), views=None)
    fitted = SimpleNamespace(camera=known, forward=forward)
    last = SimpleNamespace(fit=fitted, scores=scores([4.0, 5.0, 3.0, 4.0, 4.0], stated), threshold=8.0)
    result: Any = SimpleNamespace(
        explorations=[last],
        fit=fitted,
        problem=Problem(record(known, scene(tmp_path), poses=2), scene(tmp_path)),
    )
    monkeypatch.setattr(adjusting, "beyond_file", lambda one, other: True)
    as_stated = SimpleNamespace(scores=scores([0.0] * 5, 0.0))
    monkeypatch.setattr(adjusting, "explore", lambda *args, **settings: as_stated)
    moved = Adjusted("cyclic_error", {"harmonics.0.amplitude": 0.012}, {"harmonics.0.amplitude": 0.01})
    assert parameters_matter(known, result, [moved]) is matter


@pytest.mark.long
@pytest.mark.parametrize(
    ("sigma", "verdict"),
    [(0.002, "consistent"), (0.0005, "wrong_parameters")],  # 16 mm are stated where 12 mm are true
)
def test_a_file_is_held_to_the_covariance_that_it_states(tmp_path: Path, sigma: float, verdict: str) -> None:
    board = scene(tmp_path)
    data = record(camera(tmp_path, cyclic(0.012)), board, poses=20, seed=5)
    names = ("effects.cyclic_error.harmonics.0.amplitude", "effects.cyclic_error.harmonics.0.phase")
    stated = ArrayFile("covariance.npy", np.diag([sigma**2, (sigma / 0.016) ** 2]))
    file = replace(camera(tmp_path, cyclic(0.016)), covariance=Covariance(names, stated))
    assert diagnose(data, board, file).verdict == verdict


def test_without_a_covariance_a_file_is_known_as_by_plain_least_squares(tmp_path: Path) -> None:
    """Of a scale, by errors of poses: those of boards at many distances are its largest part.

    Fitted to other recordings without a thought of errors of poses, it scatters by what is returned.
    """
    described, truth = scene(tmp_path), camera(tmp_path, DistanceScale(0.004))
    board = replace(described, surfaces=(replace(described.surfaces[0], pose_common=0.0),))
    plain = []
    for seed in range(40):
        predictions = list(Forward(record(truth, board, poses=12, seed=seed), board, truth).predictions())
        distance = np.concatenate([one.distance[one.used] for one in predictions])
        residual = np.concatenate([one.residual[one.used] for one in predictions])
        weight = np.concatenate([one.sigma[one.used] for one in predictions]) ** -2.0
        plain.append(float(np.sum(weight * distance * residual) / np.sum(weight * distance**2)))
    fitted = fit(Problem(record(truth, board, poses=12, seed=99), board), truth)
    own = [list(fitted.parameters).index("effects.distance_scale.scale")]
    known = float(np.sqrt(file_covariance(truth, fitted, own)[0, 0]))
    assert known == pytest.approx(float(np.std(plain)), rel=0.25)


def test_what_the_file_knows_is_said_also_where_effects_were_withdrawn(tmp_path: Path) -> None:
    """A search lets go of the sums of each pixel of its first fit once an effect has joined."""
    stated = camera(tmp_path, cyclic(0.011))
    truth = camera(tmp_path, cyclic(0.011), DistanceScale(0.02))
    board = scene(tmp_path)
    data = record(truth, board, poses=10, seed=6)
    facts = Facts.of(data, moves=False, surfaces=1, camera=stated)
    problem = Problem(data, board)
    untouched = search(problem, stated, facts, effects=["distance_scale"], most=0).fit
    result = search(problem, stated, facts, effects=["distance_scale"])
    assert [one.effect for one in result.found] == ["distance_scale"]
    left = result.withdrawn().fit
    own = [k for k, path in enumerate(left.parameters) if path.startswith("effects.cyclic_error.")]
    known = file_covariance(stated, left, own)
    assert known == pytest.approx(file_covariance(stated, untouched, own), rel=1e-6)
