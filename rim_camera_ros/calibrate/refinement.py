"""Tests of a fit's own assumptions, one by one: values, pixels, errors of poses, weights, offsets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from rim_camera_ros.fit.pixel_elimination import PATTERN_PRIOR
from rim_camera_ros.fit.pixels import Beside, beside_in_view, without_edges
from rim_camera_ros.fit.pose_errors import settled_poses, wider_poses_note
from rim_camera_ros.fit.problem import Fit, Problem
from rim_camera_ros.fit.solver import fit
from rim_camera_ros.fit.variance_components import (
    correlated_error_note,
    first_pattern_prior,
    likely_correlated_error,
    likely_pattern_prior,
    pattern_prior_note,
    pose_variance_factors,
    pose_variance_note,
)
from rim_camera_ros.select.foreign_values import MOST_ROUNDS, ForeignValues, exclusion_notes, foreign_values
from rim_camera_ros.select.pixel_gains import UNKNOWN_GAINS, spread_of_gains

Array = NDArray[Any]


class Refinement:
    """The assumptions of a calibration, each given up at most once, where a fit contradicts it.

    ``masks`` are the pixels of each station and channel (H, W) to begin with; ``beside`` as in
    `without_edges`. With ``coarser`` errors that neighbours share are fitted on a coarser grid, where
    everything else begins anew. ``edges`` says whether pixels beside edges still take part, ``edges_within``
    up to which distance from edges [px] they are excluded.
    """

    def __init__(
        self,
        problem: Problem,
        masks: Sequence[tuple[Array, Array]],
        *,
        beside: Beside = beside_in_view,
        coarser: bool = False,
    ) -> None:
        self._coarser = coarser
        self.edges = True
        self.edges_within = 0
        self._masks, self._beside = masks, beside
        self._stated = problem.scene
        self._first_size = first_pattern_prior(masks)
        self._unsized = self._first_size != PATTERN_PRIOR
        self._edges_note: list[str] = []
        self._gains_note: list[str] = []
        self._foreign: list[ForeignValues] = []

    def first(self, problem: Problem) -> Problem:
        """Return the problem with which to begin."""
        return replace(problem, masks=self._masks, pattern_prior=self._first_size)

    def settled(
        self, problem: Problem, solved: Problem, fitted: Fit, *, say: Callable[[str], None]
    ) -> tuple[Problem, Fit] | None:
        """Return the problem and a fit that contradicts none of its assumptions; None: this is such a fit.

        ``fitted`` solves the problem ``solved``, which is the given one with the effects that were found. The
        effects are fitted again after each assumption that is given up; not where errors that neighbours
        share require the ``coarser`` grid.
        """
        found: tuple[Problem, Fit] | None = None
        while (refined := self.next(problem, fitted)) is not None:
            views = fitted.forward.views if refined[0].scene is problem.scene else None
            problem = refined[0]
            if problem.correlated_error and self._coarser:
                return problem, fitted
            say(f"again, with {refined[1]}")
            solved = replace(
                solved,
                dataset=problem.dataset,
                masks=problem.masks,
                scene=problem.scene,
                variance_factors=problem.variance_factors,
                pattern_prior=problem.pattern_prior,
                pixel_gains=problem.pixel_gains,
                correlated_error=problem.correlated_error,
            )
            fitted = fit(solved, fitted.camera, views=views, warm=fitted)
            found = problem, fitted
        return found

    def next(self, problem: Problem, fitted: Fit) -> tuple[Problem, str] | None:
        """Return the problem to fit next, and its change in words; None: no assumption is contradicted."""
        foreign = foreign_values(fitted) if self.may_hold_foreign else None
        if foreign is not None:
            return self.without(problem, foreign, fitted), "fewer values"
        if problem.pixel_gains is None:
            gains = spread_of_gains(fitted)
            if gains is not None and gains.are_unknown:
                self._gains_note.append(gains.note_of_shared())
                return replace(problem, pixel_gains=UNKNOWN_GAINS), "unknown gains of pixels"
        inner = without_edges(fitted, self._masks, beside=self._beside) if self.edges else None
        if inner is not None:
            masks, self.edges_within, note = inner
            self.edges = False
            self._edges_note.append(note)
            return replace(problem, masks=masks), "fewer pixels"
        if not problem.correlated_error:
            size = likely_correlated_error(problem, fitted)
            if size is not None:
                return replace(problem, correlated_error=size), "errors that neighbours share"
        else:
            weighed = self._weighed(problem, fitted)
            if weighed is not None:
                return weighed
        wider = settled_poses(problem, fitted) if problem.scene is self._stated else None
        if wider is not None:
            return replace(problem, scene=wider), "wider errors of poses"
        # where pixels have many values, weights would hide a missing effect from chi-square
        few_looks = self._first_size != PATTERN_PRIOR and not problem.correlated_error
        weighed = self._weighed(problem, fitted) if few_looks else None
        if weighed is not None:
            return weighed
        if self._unsized:
            self._unsized = False
            size = likely_pattern_prior(fitted)
            if size != problem.pattern_prior:
                return replace(problem, pattern_prior=size), "other offsets of pixels"
        return None

    @property
    def may_hold_foreign(self) -> bool:
        """Whether values that do not see the scene are looked for."""
        return len(self._foreign) < MOST_ROUNDS

    def without(self, problem: Problem, foreign: ForeignValues, fitted: Fit) -> Problem:
        """Return a problem whose pixels are those of a fit without values that do not see the scene."""
        self._foreign.append(foreign)
        now = self._masks if fitted.forward.masks is None else fitted.forward.masks
        self._masks = foreign.kept(self._masks)
        return replace(problem, masks=foreign.kept(now), dataset=foreign.marked_in(problem.dataset))

    def _weighed(self, problem: Problem, fitted: Fit) -> tuple[Problem, str] | None:
        if problem.variance_factors:
            return None
        factors = pose_variance_factors(problem, fitted)
        return None if factors is None else (replace(problem, variance_factors=factors), "weights of poses")

    def notes(self, problem: Problem, fitted: Fit) -> list[str]:
        """Return notes on the assumptions that were given up in a problem, whose solution is ``fitted``."""
        result = [*exclusion_notes(self._foreign), *self._edges_note, *self._gains_note]
        if problem.pattern_prior != PATTERN_PRIOR:
            result.append(pattern_prior_note(problem.pattern_prior))
        if problem.correlated_error:
            result.append(correlated_error_note(fitted))
        if problem.variance_factors:
            result.append(pose_variance_note(problem.variance_factors))
        if problem.scene is not self._stated:
            result.append(wider_poses_note(self._stated, problem.scene))
        return result
