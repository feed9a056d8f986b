"""Do intervals hold? Calibrations of recordings whose parameters are drawn afresh each time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from scipy.stats import binomtest

from rim_camera_ros.calibrate.joint import exactly
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.candidate import Facts
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.noise import fit_noise
from rim_camera_ros.fit.pixels import usable_pixels
from rim_camera_ros.fit.problem import Problem
from rim_camera_ros.frame import Pose
from rim_camera_ros.parameters import ArrayFile, NestedList
from rim_camera_ros.rotations import quaternion, rotation_matrix
from rim_camera_ros.scene import Scene

from .helpers import POSE_SIGMA, camera, record, scene

EFFECTS = ("scattering", "cyclic_error", "amplitude_offset", "warm_up_drift")


def drawn_effects(rng: np.random.Generator) -> list[Effect]:
    """Effects with parameters drawn independently."""
    sizes = rng.uniform(8.0, 30.0, 3)
    pattern = 0.0015 * rng.standard_normal((36, 44)) + 0.004 * np.sin(np.arange(44) / rng.uniform(6, 14))
    return [
        Scattering(
            (Kernel(float(rng.uniform(0.03, 0.12)), (float(rng.uniform(6, 12)), float(rng.uniform(6, 12)))),)
        ),
        CyclicError(
            (Harmonic(4, float(rng.uniform(0.006, 0.02)), float(rng.uniform(-0.7, 0.7))),),
            (float(rng.uniform(-0.004, 0.004)), float(rng.uniform(-0.004, 0.004))),
        ),
        AmplitudeOffset(
            MappingProxyType(
                {
                    t: Hyperbola(float(a), float(rng.uniform(0, 2)))
                    for t, a in zip((16.0, 60.0, 100.0), sizes, strict=True)
                }
            )
        ),
        FixedPatternOffset(ArrayFile("pattern.npy", pattern.astype(np.float32))),
        WarmUpDrift((Exponential(float(rng.uniform(0.01, 0.04)), float(rng.uniform(150, 350))),)),
    ]


def start_effects() -> list[Effect]:
    """What every calibration starts from."""
    rows = MappingProxyType({t: Hyperbola(20.0, 1.0) for t in (16.0, 60.0, 100.0)})
    return [
        Scattering((Kernel(0.07, (9.0, 9.0)),)),
        CyclicError((Harmonic(4, 0.012, 0.0),)),
        AmplitudeOffset(rows),
        WarmUpDrift((Exponential(0.02, 250.0),)),
    ]


def with_imperfect_reflectivities(board: Scene, rng: np.random.Generator) -> Scene:
    """The board as it is: every tile reflects otherwise than its file says, by 1 sigma of 10 %."""
    surface = board.surfaces[0]
    assert surface.texture is not None
    stated = surface.texture.values.values
    values = np.clip(stated * np.exp(0.1 * rng.standard_normal(stated.shape)), 0.01, 1.0)
    texture = replace(surface.texture, values=NestedList(values))
    return replace(board, surfaces=(replace(surface, texture=texture),))


def with_imperfections(data: Dataset, rng: np.random.Generator) -> Dataset:
    """The recording with gains of pixels of 2 %, and half of the variance of pose errors in all poses."""
    gains = np.exp(0.02 * rng.standard_normal(data.stations[0].amplitude.shape))
    offset, *tilts = np.sqrt(0.5) * rng.standard_normal(3) * np.array([POSE_SIGMA[0], *(POSE_SIGMA[1],) * 2])
    turn = rotation_matrix((tilts[0] / 2, tilts[1] / 2, 0.0, 1.0))
    stations = []
    for one in data.stations:
        pose = one.truth["board"]
        rotation = rotation_matrix(pose.orientation)
        position = np.array(pose.position) + offset * rotation[:, 2]
        x, y, z = position.tolist()
        wrong = Pose((x, y, z), quaternion(rotation @ turn))
        stations.append(replace(one, amplitude=one.amplitude * gains, truth={"board": wrong}))
    return replace(data, stations=stations)


def calibrated(folder: Path, seed: int) -> tuple[dict[str, float], float]:
    """Return how many sigma each parameter is off, and chi-square per value of held-out poses."""
    rng = np.random.default_rng([seed, 77])
    truth: Camera = camera(folder, *drawn_effects(rng))
    board = scene(folder)
    recorded = record(
        truth, with_imperfect_reflectivities(board, rng), poses=24, frames=4, seed=seed, wrong=np.sqrt(0.5)
    )
    dataset = with_imperfections(recorded, rng)
    start = with_effects(truth, {one.name: one for one in start_effects()})
    noise = fit_noise(dataset, start)
    assert noise is not None
    facts = Facts.of(dataset, moves=False, surfaces=1, camera=start)
    forward = Forward(dataset, board, start)
    forward.estimate_amplitudes()
    masks, _ = usable_pixels(forward)
    problem = Problem(dataset, board, masks=masks)
    outcome = exactly(problem, start, facts, EFFECTS, views=forward.views, say=lambda text: None)
    paths, covariance = outcome.solution.covariance()
    true, found = camera_numbers(truth), camera_numbers(outcome.solution.fit.camera)
    sigma = np.sqrt(np.diag(covariance))
    off = {p: (found[p] - true[p]) / s for p, s in zip(paths, sigma, strict=True)}
    for path in off:
        if path.endswith("phase"):  # modulo a turn
            turns = (found[path] - true[path] + np.pi) % (2 * np.pi) - np.pi
            off[path] = turns / sigma[paths.index(path)]
    return off, outcome.solution.held_out_chi_square() or 0.0


def test_two_calibrations_with_drawn_parameters(tmp_path: Path) -> None:
    for seed in (1, 2):
        off, chi_square = calibrated(tmp_path, seed)
        assert len(off) >= 15
        assert max(map(abs, off.values())) < 4.5
        assert np.sqrt(np.mean(np.square(list(off.values())))) < 1.8
        assert chi_square == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_intervals_cover(tmp_path: Path) -> None:
    """95 % intervals hold in 93-99 % of all cases, and for no parameter in fewer than 89 %.

    They are wide: errors of single poses keep their stated sigma in addition to the share of all poses.
    """
    runs = 200
    inside: dict[str, list[bool]] = {}
    chi_squares = []
    for seed in range(runs):
        off, chi_square = calibrated(tmp_path, 1000 + seed)
        chi_squares.append(chi_square)
        for path, z in off.items():
            inside.setdefault(path, []).append(abs(z) < 1.96)
    pooled = [one for values in inside.values() for one in values]
    share = float(np.mean(pooled))
    worst = {path: float(np.mean(values)) for path, values in inside.items()}
    print(f"\npooled {share:.4f} of {len(pooled)}; chi-square {np.mean(chi_squares):.4f}")
    for path, value in sorted(worst.items(), key=lambda one: one[1]):
        low, high = binomtest(sum(inside[path]), len(inside[path])).proportion_ci(method="wilson")
        print(f"  {value:.3f} [{low:.3f}, {high:.3f}] of {len(inside[path])}  {path}")
    assert 0.93 <= share <= 0.99
    assert min(worst.values()) >= 0.89
    assert np.mean(chi_squares) < 1.05
