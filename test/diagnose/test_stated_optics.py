"""Optics that a camera file knows with a covariance: a nuisance within it, named far beyond it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Covariance
from rim_camera_ros.diagnose import run
from rim_camera_ros.diagnose.begin import Inputs
from rim_camera_ros.diagnose.hypotheses import DEPTH, Hypothesis
from rim_camera_ros.diagnose.run import diagnose
from rim_camera_ros.parameters import ArrayFile

from ..calibrate.helpers import camera, record, scene


@pytest.mark.long
@pytest.mark.parametrize(("factor", "named"), [(1.002, []), (1.06, ["camera_constant"])])
def test_a_camera_constant_compared_with_its_stated_sigma(
    tmp_path: Path, factor: float, named: list[str]
) -> None:
    """Of 0.3 %: wrong by 0.2 % nothing is missing, by 6 % it is named whatever the file states."""
    truth, board = camera(tmp_path), scene(tmp_path)
    data = record(truth, board, poses=20, seed=3)
    optics = replace(truth.optics, fx=truth.optics.fx * factor, fy=truth.optics.fy * factor)
    sigma = 0.003 * truth.optics.fx
    # one scale of both, as calibrations of lenses know them
    matrix = sigma**2 * np.array([[1.0, 0.98], [0.98, 1.0]])
    stated = Covariance(("optics.fx", "optics.fy"), ArrayFile("covariance.npy", matrix))
    result = diagnose(data, board, replace(truth, optics=optics, covariance=stated))
    assert [one.effect for one in result.missing] == named
    assert result.verdict == ("missing_physics" if named else "consistent")
    if not named:
        assert not any("times the sigma of its covariance" in note for note in result.notes)


@pytest.mark.parametrize(("share", "said"), [(0.8, "depth"), (0.3, "free optics"), (None, "free optics")])
def test_a_surface_that_stands_elsewhere_comes_before_free_optics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float | None, said: str
) -> None:
    """Where it explains most of what does not fit: by free optics physics may explain more."""
    optics = ("optics.fx", "optics.fy")
    stated = Covariance(optics, ArrayFile("covariance.npy", np.diag([0.01, 0.01])))
    known = replace(camera(tmp_path), covariance=stated)
    inputs: Any = Inputs(SimpleNamespace(notes=[]), scene(tmp_path), known)  # type: ignore[arg-type]
    data = record(known, scene(tmp_path), poses=2)
    begin: Any = SimpleNamespace(dataset=data, problem=None, sees_second_camera=False, variance=None)
    fitted = SimpleNamespace(fit=SimpleNamespace(camera=known))
    result: Any = SimpleNamespace(explorations=[fitted], forget=lambda: None)
    there = Hypothesis(DEPTH, "wall", 90.0, 5.0, share=share or 0.0, against_physics=True)
    elsewhere = (None, []) if share is None else (there, [there])
    monkeypatch.setattr(run, "held_against", lambda setups, *_, **__: (setups, None))
    monkeypatch.setattr(run, "surface_elsewhere", lambda *_: elsewhere)
    monkeypatch.setattr(run, "of_another_setup", lambda other, *_: (other.hypothesis, None))
    monkeypatch.setattr(run, "with_setups", lambda diagnosis, setups: (diagnosis[0], setups))
    again: list[Inputs] = []

    def diagnosed(inputs: Inputs) -> tuple[str, None]:
        again.append(inputs)
        return "free optics", None

    monkeypatch.setattr(run, "_diagnosed", diagnosed)
    found: Any = run._without_stated_optics(inputs, begin, result, [], "the optics differ")
    assert found[0] == said
    assert len(again) == (said == "free optics")
    for one in again:
        assert one.camera.covariance is None
        assert one.dataset.notes[-1] == "the optics differ"
