"""The traits that every name of the vocabulary declares, for the search, the fit and the reports.

`Effect`s and the sections of a camera file (`rim_camera_ros.effects.sections`) are both `Physics`. Code
outside of this package must not depend on single effects, only on these traits.
"""

from __future__ import annotations

from abc import ABC
from typing import TYPE_CHECKING, ClassVar, Literal

if TYPE_CHECKING:
    from rim_camera_ros.camera import Camera
    from rim_camera_ros.effects.candidate import Candidate, Facts

#: How parameters are estimated: by the joint fit of mean frames; by one value per pixel; as a table over
#: covariates; as a table over positions; or elsewhere (`Physics.estimated_elsewhere` says why).
Estimated = Literal["joint", "pixels", "covariates", "positions", "elsewhere"]
#: Where it shows: measured distances, amplitudes (distances only through these), or the scatter of frames.
Shows = Literal["distance", "amplitude", "noise", "frames"]


class Physics(ABC):
    """One name of the vocabulary: what it is, where it acts, and how a search begins with it."""

    name: ClassVar[str]
    #: one line: what it is, for people
    title: ClassVar[str]
    #: what a recording must contain for it to be observable: the experiment
    observable: ClassVar[str]
    #: the signature that would refute it
    refuted_by: ClassVar[str]

    #: where it shows
    shows_in: ClassVar[Shows] = "distance"
    #: how its parameters are estimated, and what estimates them where the joint fit does not
    estimated: ClassVar[Estimated] = "joint"
    estimated_elsewhere: ClassVar[str] = ""
    #: what is lacking in recordings in which it has no candidate
    lacking: ClassVar[str] = "nothing in the recordings shows it"
    #: whether it follows the time of the poses: it heats, cools, ages
    in_time: ClassVar[bool] = False
    #: whether it changes with time or setting, and so is identifiable from one pose
    from_one_pose: ClassVar[bool] = False
    #: whether it is the amplitude response of the electronics, which has a free curve in addition to its law
    is_response: ClassVar[bool] = False
    #: whether it is in proportion to the distance
    scales_distance: ClassVar[bool] = False
    #: whether it shows beside edges, in pixels that are excluded from the fits of other effects
    at_edges: ClassVar[bool] = False
    #: whether it belongs to the demodulation of a phase, which not every way of measuring has
    demodulates: ClassVar[bool] = False
    #: whether it moves rays, so that every pixel sees another point
    moves_rays: ClassVar[bool] = False
    #: whether it brings light from one pixel to others
    spreads: ClassVar[bool] = False
    #: whether it belongs to the scene's surfaces, which no parameter of a camera file describes
    of_surfaces: ClassVar[bool] = False
    #: whether it acts on each pixel by itself, so that a part of the array can be computed without the rest:
    #: `Context.window`
    pointwise: ClassVar[bool] = False
    #: whether it acts from pixel to pixel or is stated by pixels, so that a fit needs all of them
    needs_all_pixels: ClassVar[bool] = False
    #: whether it is stated for pixels of the full grid, so that no coarser grid can be used
    stated_by_pixels: ClassVar[bool] = False
    #: covariates over which a report draws it, the first that varies (none: over its own size)
    drawn_over: ClassVar[tuple[str, ...]] = ()
    #: whether it shows in frames of a wall by itself: it needs no second surface, motion or other light
    shows_on_a_wall: ClassVar[bool] = True
    #: whether every camera has it
    everywhere: ClassVar[bool] = False
    #: whether experiments are planned for it
    planned: ClassVar[bool] = True

    @classmethod
    def is_of_neighbours(cls) -> bool:
        """Whether light of neighbouring pixels may look like it."""
        return cls.spreads or cls.at_edges or cls.moves_rays

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        """Return the variants that a search tries where a camera lacks it; none if it could not show.

        Each is linear in its coefficients about its start. Where the linearisation at strength zero does not
        contain the identifiable part (which is of second order), variants start at several finite values.
        """
        return []

    @classmethod
    def edge_candidates(cls, *, at_first_sight: bool = False) -> list[Candidate]:
        """Return the variants that show only in pixels which an edge crosses.

        With ``at_first_sight`` there may be fewer of them, sampled more coarsely.
        """
        return []

    @classmethod
    def record(cls) -> str:
        """Return what to record to determine it, in words."""
        return f"record: {cls.observable}"
