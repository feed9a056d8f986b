"""What every name of the vocabulary says of itself, for the search, the fit and the reports.

`Effect`s and the sections of a camera file (`rim_camera_ros.effects.sections`) are both of this kind. Nothing
outside this package asks which effect it has before it: it asks for one of these traits.
"""

from __future__ import annotations

from abc import ABC
from typing import TYPE_CHECKING, ClassVar, Literal

if TYPE_CHECKING:
    from rim_camera_ros.camera import Camera
    from rim_camera_ros.effects.candidate import Candidate, Facts

#: What comes to the parameters: the joint fit of mean frames; one value per pixel; a table over covariates; a
#: table over positions; or something else, of which `Physics.estimated_elsewhere` says what.
Estimated = Literal["joint", "pixels", "covariates", "positions", "elsewhere"]
#: What shows it: measured distances, amplitudes (distances only by way of them), or the scatter of frames.
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

    #: in what it shows
    shows_in: ClassVar[Shows] = "distance"
    #: how its parameters are estimated, and what does it where nothing of the joint fit does
    estimated: ClassVar[Estimated] = "joint"
    estimated_elsewhere: ClassVar[str] = ""
    #: what recordings lack in which it has no candidate
    lacking: ClassVar[str] = "nothing in the recordings shows it"
    #: whether it follows the time of the poses: it heats, cools, ages
    in_time: ClassVar[bool] = False
    #: whether it changes with time or setting, and so can be told from one pose
    from_one_pose: ClassVar[bool] = False
    #: whether it is the amplitude response of the electronics, beside whose law there is a free curve
    is_response: ClassVar[bool] = False
    #: whether it is in proportion to the distance
    scales_distance: ClassVar[bool] = False
    #: whether it shows beside edges, in pixels that other effects are fitted without
    at_edges: ClassVar[bool] = False
    #: whether it is of the demodulation of a phase, which not every way of measuring has
    demodulates: ClassVar[bool] = False
    #: whether it moves rays, so that every pixel sees another point
    moves_rays: ClassVar[bool] = False
    #: whether it brings light from one pixel to others
    spreads: ClassVar[bool] = False
    #: whether it is of the scene's surfaces, which no parameter of a camera file describes
    of_surfaces: ClassVar[bool] = False
    #: whether it acts on each pixel by itself, so that a part of the array can be computed without the rest:
    #: `Context.window`
    pointwise: ClassVar[bool] = False
    #: whether it acts from pixel to pixel or is stated by pixels, so that a fit needs all of them
    needs_all_pixels: ClassVar[bool] = False
    #: whether it is stated for pixels of the full grid, so that no coarser grid can be looked at
    stated_by_pixels: ClassVar[bool] = False
    #: covariates over which a report draws what it does, the first that varies (none: over its own size)
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
        """Return the variants that a search tries where a camera lacks it; none if nothing could show it.

        Each is linear in its coefficients about its start. Where the linearisation at strength zero is blind
        (an identifiable part of second order), variants start at several finite places.
        """
        return []

    @classmethod
    def edge_candidates(cls, *, at_first_sight: bool = False) -> list[Candidate]:
        """Return the variants that show in the very pixels that an edge crosses alone.

        ``at_first_sight`` there may be fewer, and sampled more coarsely.
        """
        return []

    @classmethod
    def record(cls) -> str:
        """Return what to record to determine it, in words."""
        return f"record: {cls.observable}"
