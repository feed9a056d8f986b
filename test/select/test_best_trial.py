"""Which of a step's candidates is the best: none is fitted twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rim_camera_ros.select import best_trial
from rim_camera_ros.select.best_trial import Trials
from rim_camera_ros.select.compare import Trial

#: Log likelihoods of three candidates by themselves.
LIKELIHOODS: dict[tuple[int, ...], float] = {(0,): 40.0, (1,): 25.0, (2,): 30.0}


class Counted(Trials):
    """Trials whose fits are counted; they have their likelihoods from a table."""

    def fitted(self, choices: Sequence[tuple[int, ...]], **_: Any) -> dict[tuple[int, ...], Trial]:
        self.problem.extend(choices)  # type: ignore[attr-defined]
        nothing: Any = SimpleNamespace(fitted=None)
        return {one: Trial([f"effect {one[0]}"], nothing, nothing, LIKELIHOODS[one]) for one in choices}


def test_rivals_of_a_leader_that_proved_wrong_are_not_fitted_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rivals = {0: [(2,)], 2: [(1,)], 1: [(2,)]}
    monkeypatch.setattr(best_trial, "near_rivals", lambda step, numbers, leader, failed: rivals[leader])
    monkeypatch.setattr(best_trial, "what_it_became", lambda *_: None)
    monkeypatch.setattr(best_trial, "as_good", lambda alone, best: sorted(alone))
    monkeypatch.setattr(best_trial, "subsample_of", lambda *_, **__: None)
    fits: Any = []
    step: Any = object()
    trials = Counted(fits, SimpleNamespace(), step, {})  # type: ignore[arg-type]
    best, names = trials.best((0,), 0)
    assert (best.likelihood, names) == (40.0, ["effect 0", "effect 2"])
    assert fits == [(0,), (2,)]
    best, names = trials.best((2,), 2)
    assert (best.likelihood, names) == (30.0, ["effect 1", "effect 2"])
    assert fits == [(0,), (2,), (1,)]
    # at another step every fit is another
    other: Any = object()
    replace(trials, step=other).best((1,), 1)
    assert fits[3:] == [(1,), (2,)]
