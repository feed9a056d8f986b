"""Set-ups as hypotheses: what the scene could be instead, and when another one wins against the files.

A board that is turned, mirrored or inverted, a wrong square size, distances along z, another lens: each is a
change of scene, poses or camera that competes with the files as they are given, before any physics is looked
for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.diagnose.accuracy import LEAST_EXPLAINED
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.scene import Scene

AS_GIVEN = "as_given"
#: Poses of a surface with another sign of an angle, or poses that stand elsewhere.
POSE = "pose"
#: A surface that stands nearer or farther in all poses.
DEPTH = "depth"
#: Nats by which another set-up must be better, and standard errors of its paired differences over poses.
LEAST_GAIN = 20.0
STANDARD_ERRORS = 2.0
#: ... and share of what does not fit from which it is the set-up without asking physics, which may imitate a
#: part of it. Below, the set-up is held against the files as given with the physics that is found.
NEARLY_ALL = 0.9
_WORDS = {
    "turned_180": "the pattern of {0} turned by 180 degrees",
    "mirrored": "the pattern of {0} mirrored",
    "inverted": "the bright and dark tiles of {0} exchanged",
    "turned_90": "the pattern of {0} turned by 90 degrees",
    "other_pattern": "another pattern on {0}: its tiles reflect otherwise than the scene file says",
    "other_board": "another board in the place of {0}, {3}, whose tiles reflect otherwise,",
    "scale": "{0} {1:.3g} times as large as the scene file says",
    DEPTH: "{0} {1:.0f} mm {2} than its poses say",
    "pose": "poses of {0} with another sign of an angle",
    "units": "distances or poses in other units, by a factor of {1:g}",
    "z_distance": "distances along the optical axis instead of along the ray",
    "other_lens": "another lens, of {1:.3g} times the focal length",
}
#: What else of the scene file may be corrected, where its reflectivities may be guesses.
_GUESSES = dict.fromkeys(
    ("other_pattern", "other_board"),
    " (or state a reflectivity_sigma of what it guesses)",
)


#: Recording, scene and camera file of a set-up, and what makes those of another from them.
Files = tuple[Dataset, Scene, Camera]
Change = Callable[[Dataset, Scene, Camera], Files]


@dataclass(frozen=True)
class Hypothesis:
    """A set-up: what it changes, of which surface, by how much, and what it gains over the files [nats].

    ``standard_error`` [nats] of the gain from its paired differences over poses; ``share`` of what does not
    fit that it explains; ``change`` makes recording, scene and camera of the set-up from those given.
    ``against_physics``: the gain is over the files with the physics that was found; ``fitted``: what it
    changes is a parameter of the fit, which decides. ``at`` returns the same with another value. ``sides``:
    by which factors a board is wider and higher.
    """

    hypothesis: str
    surface: str
    gain: float
    standard_error: float
    value: float = 0.0
    share: float = 0.0
    change: Change | None = None
    against_physics: bool = False
    fitted: bool = False
    at: Callable[[float], Trial] | None = None
    sides: tuple[float, float] | None = None

    @property
    def trial(self) -> Trial | None:
        """What is compared; None where nothing is."""
        if self.change is None:
            return None
        return Trial(
            self.hypothesis,
            self.surface,
            self.value,
            self.change,
            fitted=self.fitted,
            at=self.at,
            sides=self.sides,
        )

    @property
    def sentence(self) -> str:
        """The set-up in words."""
        if self.hypothesis == AS_GIVEN:
            return "scene, poses and camera as the files say"
        if self.is_of_poses:
            return f"{self.value:.0f} poses that stand elsewhere"
        value, side = self.value, "farther away" if self.value > 0 else "nearer"
        value = abs(value) if self.hypothesis == DEPTH else value
        return _WORDS[self.hypothesis].format(self.surface or "the scene", value, side, self._size)

    @property
    def _size(self) -> str:
        """By how much a board is larger, in words."""
        across, down = (f"{side:.3g}" for side in self.sides or (self.value, self.value))
        if across == down:
            return f"{across} times as large"
        return f"{across} times as wide and {down} times as high"

    @property
    def is_repainted(self) -> bool:
        """Whether tiles reflect as the recording shows."""
        return self.hypothesis in _GUESSES

    @property
    def is_of_poses(self) -> bool:
        """Whether it is that some poses stand elsewhere, each in its own way."""
        return self.hypothesis == POSE and not self.surface

    @property
    def reason(self) -> str:
        """Why the set-up cannot be trusted, and what to do."""
        guesses = _GUESSES.get(self.hypothesis, "")
        than = "any physics of the camera does" if self.against_physics else "the files do"
        return (
            f"{self.hypothesis}: {self.sentence} explains the recording better than {than} "
            f"({self.share:.0%} of what does not fit); correct the scene file{guesses}, "
            "the poses or the camera file"
        )

    @property
    def is_better(self) -> bool:
        """Whether it fits the recording better than the files do."""
        significant = self.gain > max(LEAST_GAIN, STANDARD_ERRORS * self.standard_error)
        return self.hypothesis != AS_GIVEN and significant

    @property
    def wins(self) -> bool:
        """Whether it is better also than physics: held against it, or as it explains what does not fit.

        One that explains less than half of that is not what differs, as it is with names.
        """
        least = LEAST_EXPLAINED if self.against_physics else NEARLY_ALL
        return self.is_better and not self.fitted and self.share > least


@dataclass(frozen=True)
class Trial:
    """A set-up to be compared: its name, the surface, by how much, and what makes its files.

    ``fitted``: it is a parameter of the fit too. ``at`` returns the same with another value, where it may
    have any. ``sides`` as in `Hypothesis`.
    """

    hypothesis: str
    surface: str
    value: float
    change: Change
    fitted: bool = False
    at: Callable[[float], Trial] | None = None
    sides: tuple[float, float] | None = None

    @property
    def free(self) -> int:
        """How many numbers of it are taken from the recording."""
        return 2 if self.sides is not None else int(self.at is not None)


def share_explained(gain: float, short: float) -> float:
    """Return the share that a ``gain`` is of what does not fit, which is at least what is gained."""
    return gain / max(short, gain, 1e-9)


def by_gain(found: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses by what they gain, the best first."""
    return sorted(found, key=lambda hypothesis: -hypothesis.gain)


def poses_elsewhere(gain: float, count: int) -> Hypothesis:
    """Return the set-up in which ``count`` poses stand elsewhere, which gains so many nats."""
    return Hypothesis(POSE, "", gain, 0.0, float(count))


def leaving_nothing(
    found: Sequence[Hypothesis], given: Files, left_by_chance: Callable[[Files], float | None]
) -> list[Hypothesis]:
    """Return the set-ups by what they gain, the leader with the share that a fit under it shows.

    ``left_by_chance`` returns what an effect would have to gain in nats by the files of a set-up, None where
    something is missing there as well. Physics of the camera as given can explain no more than all: a set-up
    that explains all but what chance leaves is not held against it, as no effect imitates so much of
    another set-up. The search for physics would take minutes there, where every fit is far from its end.
    """
    leader = next((hypothesis for hypothesis in found if hypothesis.is_better), None)
    if leader is None or leader.wins or leader.fitted or leader.change is None:
        return list(found)
    try:
        left = left_by_chance(leader.change(*given))
    except RimError:
        left = None  # some poses make no set-up of that kind
    if left is None:
        return list(found)
    share = max(leader.share, share_explained(leader.gain, leader.gain + left))
    return [replace(hypothesis, share=share) if hypothesis is leader else hypothesis for hypothesis in found]


def best_setup(found: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the set-up that explains the recording better than the files do; None: they are the best.

    None too where the best is a parameter of the fit, which decides.
    """
    leader = next(
        (
            hypothesis
            for hypothesis in found
            if (hypothesis.fitted and hypothesis.is_better) or hypothesis.wins
        ),
        None,
    )
    return leader if leader is not None and leader.wins else None
