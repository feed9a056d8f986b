"""The compiled functions of the correction (kernels.c), where they were compiled at the installation.

Without them the classes that use them compute the same by numpy; `LIBRARY` is then None, and `PROBLEM` states
the reason. Functions for planes are called in `rim_camera_ros.pipeline.plane_kernels`.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

POINTER, WHOLE, NUMBER = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
#: Address of the data of an array, for a call; TypeError where they are not contiguous or are read-only. It
#: takes half the time of `numpy.ndarray.ctypes`, which matters for the 60 arrays of a frame.
address = (ctypes.c_char * 0).from_buffer
#: Types of the arguments and of the result, by function.
_FUNCTIONS: dict[str, tuple[list[Any], Any]] = {
    "rim_planes": ([*[POINTER] * 5, *[WHOLE] * 2, *[NUMBER] * 4, POINTER], WHOLE),
    "rim_widen": ([*[POINTER] * 4, *[NUMBER] * 4], None),
    "rim_entries": ([POINTER] * 3, None),
    "rim_cosine": ([*[WHOLE] * 2, *[POINTER] * 6, WHOLE, *[NUMBER] * 3, *[POINTER] * 2], None),
    "rim_solve": ([POINTER, *[WHOLE] * 2, *[POINTER] * 2], None),
    "rim_read": ([WHOLE, *[POINTER] * 3, *[NUMBER] * 2, *[POINTER] * 6], ctypes.c_int32),
    "rim_judge": ([*[WHOLE] * 2, *[POINTER] * 4], None),
    "rim_incidence": ([WHOLE, *[POINTER] * 3, ctypes.c_int32, POINTER], None),
    "rim_plane_table": ([WHOLE, *[POINTER] * 3, WHOLE, *[POINTER] * 2, *[NUMBER] * 2, POINTER], None),
    "rim_to_image": ([*[WHOLE] * 2, *[POINTER] * 2, NUMBER, POINTER], None),
    "rim_from_image": (
        [
            *[WHOLE] * 2,
            *[POINTER] * 2,
            NUMBER,
            ctypes.c_int32,
            NUMBER,
            POINTER,
            NUMBER,
            *[POINTER] * 3,
        ],
        None,
    ),
}


def load(folder: Path) -> tuple[Any, str]:
    """Return the compiled functions in a folder; or None and the reason where they cannot be loaded."""
    for suffix in EXTENSION_SUFFIXES:
        path = folder / f"_kernels{suffix}"
        if path.is_file():
            try:
                library = ctypes.CDLL(str(path))
                for name, (arguments, result) in _FUNCTIONS.items():
                    function = getattr(library, name)
                    function.argtypes, function.restype = arguments, result
            except (OSError, AttributeError) as error:  # built for another system, or another version
                return None, f"{' '.join(str(error).split())} (build the package again)"
            return library, ""
    remedy = "sudo apt install build-essential, and build the package again"
    return None, f"none were built in {folder} ({remedy})"


LIBRARY: Any
PROBLEM: str
LIBRARY, PROBLEM = load(Path(__file__).parent)


def in_words() -> str:
    """Return whether compiled functions are used, and why not."""
    return "compiled kernels are used" if LIBRARY is not None else f"compiled kernels are not used: {PROBLEM}"


class _Solver(ctypes.Structure):
    _fields_ = [
        *[(name, POINTER) for name in ("shift", "beside", "entries", "row", "slope")],
        ("scale", NUMBER),
        ("length", ctypes.c_int32),
        ("wraps", ctypes.c_int32),
    ]


class CompiledSolver:
    """The computation of `rim_camera_ros.pipeline.distance_tables.DistanceSolver`, with its arrays.

    ``slope`` (H, W) is written for each pixel that is solved.
    """

    def __init__(
        self,
        *,
        shift: Image,
        row: NDArray[np.int32],
        beside: Image | None,
        entries: NDArray[np.complex128],
        scale: float,
        length: int,
        wraps: bool,
        slope: Image,
    ) -> None:
        self._held = shift, beside, entries, row, slope
        addresses = [None if one is None else one.ctypes.data for one in self._held]
        self.structure = _Solver(*addresses, scale, length, int(wraps))

    def solve(self, y: Image, *, first: int, out: Image | None) -> Image:
        """Return the distances [m] for y of the pixels from ``first`` on; a new array, or ``out``."""
        y = np.ascontiguousarray(y, np.float32)
        solved = np.empty_like(y) if out is None else out
        LIBRARY.rim_solve(ctypes.byref(self.structure), first, y.size, address(y), address(solved))
        return solved


class _Table(ctypes.Structure):
    _fields_ = [(name, POINTER) for name in ("term", "amplitude", "sigma", "flags")]


class CompiledTable:
    """`rim_camera_ros.pipeline.amplitude_tables.ByAmplitude` of the 65,536 counts, in float32.

    ``amplitude`` is None where it is the counts themselves.
    """

    def __init__(
        self, *, term: Image, amplitude: Image | None, sigma: Image, flags: NDArray[np.uint8]
    ) -> None:
        self._held = term, amplitude, sigma, flags
        self.structure = _Table(*(None if one is None else one.ctypes.data for one in self._held))


@dataclass(frozen=True, slots=True)
class Counts:
    """Values read from counts (H, W): distances ``y`` and ``sigma`` [m], ``amplitude`` [counts], ``flags``.

    ``sigma`` and ``flags`` are empty unless ``whole`` was set; ``found``: all flags that are set anywhere.
    """

    y: Image
    amplitude: Image
    sigma: Image
    flags: NDArray[np.uint8]
    found: int


def read(
    distance: NDArray[np.uint16],
    amplitude: NDArray[np.uint16],
    *,
    table: CompiledTable,
    unit: float,
    offset: float,
    map_: Image | None,
    solver: CompiledSolver | None,
    whole: bool,
) -> Counts:
    """Read counts (H, W), into new arrays.

    The terms of amplitude, a map and an offset [m] are subtracted from distances, and terms of the distance
    are undone where a solver is given. ``whole``: with sigma and flags.
    """
    raw, published = (np.ascontiguousarray(one, np.uint16) for one in (distance, amplitude))
    y, light = (np.empty(raw.shape, np.float32) for _ in range(2))
    shape = raw.shape if whole else (0, 0)
    sigma, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    found = LIBRARY.rim_read(
        raw.size,
        raw.ctypes.data,  # may be read-only
        published.ctypes.data,
        ctypes.byref(table.structure),
        unit,
        offset,
        None if map_ is None else address(map_),
        None if solver is None else ctypes.byref(solver.structure),
        address(y),
        address(light),
        address(sigma) if whole else None,
        address(flags) if whole else None,
    )
    return Counts(y, light, sigma, flags, found)


class _Judged(ctypes.Structure):
    _fields_ = [
        *[(name, POINTER) for name in ("amplitude", "gain", "slope", "cosine", "always")],
        *[
            (name, NUMBER)
            for name in (
                *("minimum", "slope_scale", "spread", "least", "greatest"),
                *("step", "sigmas", "share"),
            )
        ],
        ("everywhere", ctypes.c_int32),
    ]


def judge(
    distance: Image,
    sigma: Image,
    flags: NDArray[np.uint8],
    *,
    amplitude: Image,
    gain: Image | None,
    slope: tuple[Image, float] | None,
    cosine: Image | None,
    always: NDArray[np.uint8] | None,
    minimum: float,
    spread: float,
    limits: tuple[float, float],
    mixed: tuple[float, float, float],
    everywhere: int,
) -> None:
    """Finish sigma [m] and flags (H, W), and make distances and sigmas NaN where they are not valid.

    In place, as `rim_camera_ros.pipeline.judgement.Judgement` does. Sigma and flags are at first those by the
    amplitudes. ``mixed``: least step [m], least step in sigmas, and least share, of
    `rim_camera_ros.pipeline.mixed`.
    """
    held = amplitude, gain, None if slope is None else slope[0], cosine, always
    addresses = [None if one is None else ctypes.addressof(address(one)) for one in held]
    scale = 0.0 if slope is None else slope[1]
    by = _Judged(*addresses, minimum, scale, spread, *limits, *mixed, everywhere)
    LIBRARY.rim_judge(*distance.shape, ctypes.byref(by), address(distance), address(sigma), address(flags))


def incidence_term(cosine: Image, distance: Image, *, table: NDArray[np.complex64]) -> Image:
    """Return the terms in metres of cosines and distances [m] (H, W), from a table over the cosine."""
    term = np.empty(cosine.shape, np.float32)
    cosine, distance = (np.ascontiguousarray(one, np.float32) for one in (cosine, distance))
    LIBRARY.rim_incidence(
        term.size,
        address(cosine),
        address(distance),
        address(table),
        table.size - 2,
        address(term),
    )
    return term


def plane_table(
    distance: Image,
    *,
    base: Image,
    slope: Image,
    knots: Image,
    bends: Image,
    first: float,
    last: float,
) -> Image:
    """Return terms [m] of `rim_camera_ros.pipeline.distance_tables.PlaneTable` at distances (H, W) [m]."""
    term = np.empty(distance.shape, np.float32)
    distance = np.ascontiguousarray(distance, np.float32)
    LIBRARY.rim_plane_table(
        term.size,
        address(distance),
        address(base),
        address(slope),
        knots.size,
        address(knots),
        address(bends),
        first,
        last,
        address(term),
    )
    return term


def to_image(distance: Image, amplitude: Image, *, ambiguity: float, image: Image) -> None:
    """Write the complex image (H, 2, W) of distances [m] and amplitudes, dark where a distance is NaN."""
    distance, amplitude = (np.ascontiguousarray(one, np.float32) for one in (distance, amplitude))
    LIBRARY.rim_to_image(*distance.shape, address(distance), address(amplitude), ambiguity, address(image))


def from_image(
    image: Image,
    distance: Image,
    before: Image,
    *,
    ambiguity: float,
    wraps: bool,
    direct: float,
    along: Image | None,
    square: float,
) -> tuple[Image, Image]:
    """Overwrite the delivered distances (H, W) [m] by those of an image; return its amplitudes and the gains.

    As `rim_camera_ros.pipeline.optics.OpticsUndo` does; ``before``: amplitudes before stray light is undone.
    """
    image, before = (np.ascontiguousarray(one, np.float32) for one in (image, before))
    amplitude, gain = np.empty_like(before), np.empty_like(before)
    LIBRARY.rim_from_image(
        *distance.shape,
        address(image),
        address(before),
        ambiguity,
        int(wraps),
        direct,
        None if along is None else address(along),
        square,
        address(distance),
        address(amplitude),
        address(gain),
    )
    return amplitude, gain
