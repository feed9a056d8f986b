"""Set-ups as hypotheses: alternatives to the files, and when one of them wins against the files.

A board that is turned, mirrored or inverted, a wrong square size, distances along z, another lens: each is a
change of scene, poses or camera that competes with the files as they are given, before any search for
physics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.scene import Scene
from rim_camera_ros.select.thresholds import LEAST_EXPLAINED, STANDARD_ERRORS

AS_GIVEN = "as_given"
#: Poses of a surface with another sign of an angle, or poses in which a surface is displaced.
POSE = "pose"
#: A surface that stands nearer or farther in all poses.
DEPTH = "depth"
#: Least gain of another set-up [nats]; it must also gain `STANDARD_ERRORS`, paired over poses.
LEAST_GAIN = 20.0
#: ... and share of the misfit above which it wins without a comparison with physics, which may imitate a part
#: of it. Below, it is compared with the files as given and the physics that is found.
NEARLY_ALL = 0.9
#: Difference of gains [nats] below which two set-ups are the same files by other words.
_NO_DIFFERENCE = 1e-6
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
    "compensated_amplitude": "a driver that multiplies amplitudes by the square of the distance",
    "other_lens": "another lens, of {1:.3g} times the focal length",
}
#: Another remedy in the scene file, where its reflectivities may be guesses.
_GUESSES = dict.fromkeys(
    ("other_pattern", "other_board"),
    " (or state a reflectivity_sigma of what it guesses)",
)
#: What to do where neither scene, poses nor camera file are to be corrected.
_REMEDIES = {
    "compensated_amplitude": "record the amplitudes as measured (SwissRanger: without AM_CONV_GRAY; ifm: the "
    "topic raw_amplitude)",
}

#: Recording, scene and camera file of a set-up, and a function that makes those of another from them.
Files = tuple[Dataset, Scene, Camera]
Change = Callable[[Dataset, Scene, Camera], Files]


@dataclass(frozen=True)
class Hypothesis:
    """A set-up: its change, the surface, the ``value`` of the change, and its gain over the files [nats].

    ``standard_error`` [nats] is that of the gain, from paired differences over poses; ``share`` is the share
    of the misfit that it explains; ``change`` makes recording, scene and camera of the set-up from those
    given. ``against_physics``: the gain is over the files with the physics found. ``fitted``: the set-up is
    also a parameter of the fit, which decides. ``at`` returns the same trial with another value. ``sides``
    are the factors on width and height of a board. ``alike`` are other set-ups, in words, in which the board
    looks the same.
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
    alike: tuple[str, ...] = ()

    @property
    def trial(self) -> Trial | None:
        """The trial of this set-up; None where there is none."""
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
        """The size of a board relative to the scene file, in words."""
        across, down = (f"{side:.3g}" for side in self.sides or (self.value, self.value))
        if across == down:
            return f"{across} times as large"
        return f"{across} times as wide and {down} times as high"

    @property
    def is_repainted(self) -> bool:
        """Whether the reflectivities of tiles are taken from the recording."""
        return self.hypothesis in _GUESSES

    @property
    def is_of_poses(self) -> bool:
        """Whether the set-up is one with surfaces that are displaced in some poses, each differently."""
        return self.hypothesis == POSE and not self.surface

    @property
    def reason(self) -> str:
        """Why the set-up cannot be trusted, and what to do."""
        guesses = _GUESSES.get(self.hypothesis, "")
        remedy = f"correct the scene file{guesses}, the poses or the camera file"
        than = "any physics of the camera does" if self.against_physics else "the files do"
        alike = f", or {', or '.join(self.alike)}, which look the same," if self.alike else ""
        return (
            f"{self.hypothesis}: {self.sentence}{alike} explains the recording better than {than} "
            f"({self.share:.0%} of what does not fit); {_REMEDIES.get(self.hypothesis, remedy)}"
        )

    @property
    def is_better(self) -> bool:
        """Whether it fits the recording significantly better than the files do."""
        significant = self.gain > max(LEAST_GAIN, STANDARD_ERRORS * self.standard_error)
        return self.hypothesis != AS_GIVEN and significant

    @property
    def wins(self) -> bool:
        """Whether it is also better than physics: by comparison, or as it explains nearly all of the misfit.

        A set-up that explains less than half of the misfit is not its cause; the same holds for names.
        """
        least = LEAST_EXPLAINED if self.against_physics else NEARLY_ALL
        return self.is_better and not self.fitted and self.share > least


@dataclass(frozen=True)
class Trial:
    """A set-up to be compared: its name, the surface, the value of the change, and the change of the files.

    ``fitted``: it is also a parameter of the fit. ``at`` returns the same trial with another value, where its
    value is continuous. ``sides`` as in `Hypothesis`.
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
        """How many of its numbers are estimated from the recording."""
        return 2 if self.sides is not None else int(self.at is not None)


def share_explained(gain: float, short: float) -> float:
    """Return the share of the misfit ``short`` [nats] that a ``gain`` explains; 1 at most."""
    return gain / max(short, gain, 1e-9)


def by_gain(found: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses by their gain, the best first."""
    return sorted(found, key=lambda hypothesis: -hypothesis.gain)


def poses_elsewhere(gain: float, count: int) -> Hypothesis:
    """Return the set-up with surfaces displaced in ``count`` poses, with its ``gain`` [nats]."""
    return Hypothesis(POSE, "", gain, 0.0, float(count))


def leaving_nothing(
    found: Sequence[Hypothesis], given: Files, left_by_chance: Callable[[Files], float | None]
) -> list[Hypothesis]:
    """Return the set-ups by their gain; the leader with the share of the misfit by a fit to its files.

    ``left_by_chance`` returns the entry threshold [nats] of an effect by the files of a set-up, None where
    something is missing there as well. A set-up that explains all of the misfit but that threshold is not
    compared with physics: no effect imitates so much of another set-up. The search for physics would take
    minutes there, as every fit is far from convergence.
    """
    leader = next((hypothesis for hypothesis in found if hypothesis.is_better), None)
    if leader is None or leader.wins or leader.fitted or leader.change is None:
        return list(found)
    try:
        left = left_by_chance(leader.change(*given))
    except RimError:
        left = None  # the set-up is not possible with some poses
    if left is None:
        return list(found)
    share = max(leader.share, share_explained(leader.gain, leader.gain + left))
    return [replace(hypothesis, share=share) if hypothesis is leader else hypothesis for hypothesis in found]


def best_setup(found: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the set-up that explains the recording better than the files do; None: the files are best.

    None also where the best set-up is a parameter of the fit, which decides then.
    """
    leader = next(
        (
            hypothesis
            for hypothesis in found
            if (hypothesis.fitted and hypothesis.is_better) or hypothesis.wins
        ),
        None,
    )
    if leader is None or not leader.wins:
        return None
    alike = (one for one in found if one is not leader and abs(one.gain - leader.gain) < _NO_DIFFERENCE)
    return replace(leader, alike=tuple(one.sentence for one in alike))
