"""The compiled functions of the correction (kernels.c), where they were compiled at the installation.

Without them numpy computes the same: the classes that use these say what. `LIBRARY` is None then.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

_POINTER, _WHOLE, _NUMBER = ctypes.c_void_p, ctypes.c_int64, ctypes.c_float
#: Where the data of an array begin, for a call; TypeError where they are not contiguous or are read-only.
#: Half the time that `numpy.ndarray.ctypes` takes, which a frame would spend on 60 arrays.
_at = (ctypes.c_char * 0).from_buffer
#: Arguments, and what is returned.
_FUNCTIONS: dict[str, tuple[list[Any], Any]] = {
    "rim_planes": ([*[_POINTER] * 5, *[_WHOLE] * 2, *[_NUMBER] * 4, _POINTER], _WHOLE),
    "rim_widen": ([*[_POINTER] * 4, *[_NUMBER] * 4], None),
    "rim_entries": ([_POINTER] * 3, None),
    "rim_cosine": ([*[_WHOLE] * 2, *[_POINTER] * 6, _WHOLE, *[_NUMBER] * 3, *[_POINTER] * 2], None),
    "rim_solve": ([_POINTER, *[_WHOLE] * 2, *[_POINTER] * 2], None),
    "rim_read": ([_WHOLE, *[_POINTER] * 3, *[_NUMBER] * 2, *[_POINTER] * 6], ctypes.c_int32),
    "rim_judge": ([*[_WHOLE] * 2, *[_POINTER] * 4], None),
    "rim_incidence": ([_WHOLE, *[_POINTER] * 3, ctypes.c_int32, _POINTER], None),
    "rim_plane_table": ([_WHOLE, *[_POINTER] * 3, _WHOLE, *[_POINTER] * 2, *[_NUMBER] * 2, _POINTER], None),
    "rim_to_image": ([*[_WHOLE] * 2, *[_POINTER] * 2, _NUMBER, _POINTER], None),
    "rim_from_image": (
        [
            *[_WHOLE] * 2,
            *[_POINTER] * 2,
            _NUMBER,
            ctypes.c_int32,
            _NUMBER,
            _POINTER,
            _NUMBER,
            *[_POINTER] * 3,
        ],
        None,
    ),
}


def load(folder: Path) -> Any:
    """Return the compiled functions in a folder, None where there are none that this system can load."""
    for suffix in EXTENSION_SUFFIXES:
        path = folder / f"_kernels{suffix}"
        if path.is_file():
            try:
                library = ctypes.CDLL(str(path))
                for name, (arguments, result) in _FUNCTIONS.items():
                    function = getattr(library, name)
                    function.argtypes, function.restype = arguments, result
            except (OSError, AttributeError):  # of another system, or of another version
                return None
            return library
    return None


LIBRARY: Any = load(Path(__file__).parent)


class _Grid(ctypes.Structure):
    _fields_ = [(name, _WHOLE) for name in ("width", "rows", "columns", "stride")]


class _Geometry(ctypes.Structure):
    _fields_ = [
        ("inverse", _POINTER * 4),
        *[(name, _POINTER) for name in ("mean_x", "mean_y", "tilt", "centre_z")],
        ("slopes", _POINTER * 4),
        ("over", _POINTER),
    ]


class _Windows(ctypes.Structure):
    _fields_ = [
        (name, _POINTER)
        for name in (
            *("mean", "along_row", "along_column", "residual", "x", "y", "z", "metre", "noise"),
            *("good", "noisy"),
        )
    ]


class CompiledWindows:
    """What `rim_camera_ros.pipeline.planes.PlaneWindows` computes of a frame, from its arrays.

    Those are (rows, stride) and are kept here; ``over`` is None where there are no wider windows.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        columns: int,
        inverse: Sequence[Image],
        mean: Sequence[Image],
        tilt: Image,
        centre_z: Image,
        slopes: Sequence[Image],
        over: NDArray[np.intp] | None,
        entries: NDArray[np.complex128],
    ) -> None:
        rows, stride = tilt.shape
        self._held = [
            np.ascontiguousarray(one, np.float32) for one in (*inverse, *mean, tilt, centre_z, *slopes)
        ]
        self._over = np.zeros(1, np.int64) if over is None else np.ascontiguousarray(over, np.int64)
        addresses = [one.ctypes.data for one in self._held]
        geometry = _Geometry(
            (_POINTER * 4)(*addresses[:4]),
            *addresses[4:8],
            (_POINTER * 4)(*addresses[8:]),
            self._over.ctypes.data,
        )
        self._numbers = np.zeros((9, rows, stride), np.float32)
        self._states = np.zeros((2, rows, stride), np.uint8)
        windows = _Windows(*(one.ctypes.data for one in (*self._numbers, *self._states)))
        self._columns = np.empty((4, shape[1]), np.float32)
        self._entries = entries
        self._structures = _Grid(shape[1], rows, columns, stride), geometry, windows
        self._grid, self._geometry, self._windows = (ctypes.addressof(one) for one in self._structures)

    def fit(
        self,
        inverse_depth: Image,
        sigma: NDArray[Any] | float,
        *,
        factor: float,
        excess: float,
        residual: float,
        tilt: float,
    ) -> bool:
        """Fit planes; return whether wider ones are asked for."""
        noise = np.asarray(sigma, np.float32)
        row, column = (one // noise.itemsize for one in noise.strides) if noise.ndim else (0, 0)
        inverse_depth = np.ascontiguousarray(inverse_depth, np.float32)
        return bool(
            LIBRARY.rim_planes(
                self._grid,
                self._geometry,
                self._windows,
                _at(inverse_depth),
                noise.ctypes.data,
                row,
                column,
                factor,
                excess,
                residual,
                tilt,
                _at(self._columns),
            )
        )

    def widen(
        self,
        wider: NDArray[np.complex128],
        *,
        mean_sigmas: float,
        near: float,
        slope_sigmas: float,
        slope: float,
    ) -> None:
        """Put wider planes, by their entries, in the place of noisy ones where they agree."""
        LIBRARY.rim_widen(
            self._grid,
            self._geometry,
            self._windows,
            _at(wider),
            mean_sigmas,
            near,
            slope_sigmas,
            slope,
        )

    def entries(self) -> NDArray[np.complex128]:
        """Return the entries of all windows, bad ones replaced by a good one within reach."""
        LIBRARY.rim_entries(self._grid, self._windows, _at(self._entries))
        return self._entries


def cosine(
    distance: Image,
    sigma: NDArray[Any] | float,
    *,
    rays: Image,
    entries: NDArray[np.complex128],
    window: NDArray[np.int64],
    neighbours: NDArray[np.int64],
    near: float,
    sure: float,
    sigmas: float,
) -> Image:
    """Return the cosines of `rim_camera_ros.pipeline.normals.IncidenceEstimator` (H, W), a new array."""
    result = np.empty(distance.shape, np.float32)
    distance = np.ascontiguousarray(distance, np.float32)
    noise = np.ascontiguousarray(sigma if np.ndim(sigma) else np.full(result.shape, sigma), np.float32)
    planes = np.empty((4, result.shape[1]), np.float32)
    LIBRARY.rim_cosine(
        *result.shape,
        _at(distance),
        _at(noise),
        _at(rays),
        _at(entries),
        _at(window),
        _at(neighbours),
        neighbours.shape[1],
        near,
        sure,
        sigmas,
        _at(planes),
        _at(result),
    )
    return result


class _Solver(ctypes.Structure):
    _fields_ = [
        *[(name, _POINTER) for name in ("shift", "beside", "entries", "row", "slope")],
        ("scale", _NUMBER),
        ("length", ctypes.c_int32),
        ("wraps", ctypes.c_int32),
    ]


class CompiledSolver:
    """What `rim_camera_ros.pipeline.tables.DistanceSolver` computes of a frame, from its arrays.

    ``slope`` (H, W) is written with each pixel that is solved.
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
        LIBRARY.rim_solve(ctypes.byref(self.structure), first, y.size, _at(y), _at(solved))
        return solved


class _Table(ctypes.Structure):
    _fields_ = [(name, _POINTER) for name in ("term", "amplitude", "sigma", "flags")]


class CompiledTable:
    """What the 65,536 counts of the amplitude say: `rim_camera_ros.pipeline.tables.ByAmplitude`, in float32.

    ``amplitude`` is None where it is the counts themselves.
    """

    def __init__(
        self, *, term: Image, amplitude: Image | None, sigma: Image, flags: NDArray[np.uint8]
    ) -> None:
        self._held = term, amplitude, sigma, flags
        self.structure = _Table(*(None if one is None else one.ctypes.data for one in self._held))


@dataclass(frozen=True, slots=True)
class Counts:
    """What counts (H, W) say: distances ``y`` and ``sigma`` [m], ``amplitude`` [counts], ``flags``.

    ``sigma`` and ``flags`` are empty where nobody asked for them; ``found``: flags that are set somewhere.
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

    Distances are without what the amplitude, a map and an offset [m] add, and solved where a solver is given;
    ``whole``: with sigma and flags.
    """
    raw, published = (np.ascontiguousarray(one, np.uint16) for one in (distance, amplitude))
    y, light = (np.empty(raw.shape, np.float32) for _ in range(2))
    shape = raw.shape if whole else (0, 0)
    sigma, flags = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    found = LIBRARY.rim_read(
        raw.size,
        raw.ctypes.data,  # perhaps not to be written
        published.ctypes.data,
        ctypes.byref(table.structure),
        unit,
        offset,
        None if map_ is None else _at(map_),
        None if solver is None else ctypes.byref(solver.structure),
        _at(y),
        _at(light),
        _at(sigma) if whole else None,
        _at(flags) if whole else None,
    )
    return Counts(y, light, sigma, flags, found)


class _Judged(ctypes.Structure):
    _fields_ = [
        *[(name, _POINTER) for name in ("amplitude", "gain", "slope", "cosine", "always")],
        *[
            (name, _NUMBER)
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

    In place, as `rim_camera_ros.pipeline.correct.Correction` does, from what the amplitudes say. ``mixed``:
    least step [m], in sigmas, share, of `rim_camera_ros.pipeline.mixed`.
    """
    held = amplitude, gain, None if slope is None else slope[0], cosine, always
    addresses = [None if one is None else ctypes.addressof(_at(one)) for one in held]
    scale = 0.0 if slope is None else slope[1]
    by = _Judged(*addresses, minimum, scale, spread, *limits, *mixed, everywhere)
    LIBRARY.rim_judge(*distance.shape, ctypes.byref(by), _at(distance), _at(sigma), _at(flags))


def incidence_term(cosine: Image, distance: Image, *, table: NDArray[np.complex64]) -> Image:
    """Return the terms in metres of cosines and distances [m] (H, W), from a table over the cosine."""
    term = np.empty(cosine.shape, np.float32)
    cosine, distance = (np.ascontiguousarray(one, np.float32) for one in (cosine, distance))
    LIBRARY.rim_incidence(
        term.size,
        _at(cosine),
        _at(distance),
        _at(table),
        table.size - 2,
        _at(term),
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
    """Return the terms in metres of `rim_camera_ros.pipeline.tables.PlaneTable` at distances (H, W) [m]."""
    term = np.empty(distance.shape, np.float32)
    distance = np.ascontiguousarray(distance, np.float32)
    LIBRARY.rim_plane_table(
        term.size,
        _at(distance),
        _at(base),
        _at(slope),
        knots.size,
        _at(knots),
        _at(bends),
        first,
        last,
        _at(term),
    )
    return term


def to_image(distance: Image, amplitude: Image, *, ambiguity: float, image: Image) -> None:
    """Write the complex image (H, 2, W) of distances [m] and amplitudes, dark where a distance is NaN."""
    distance, amplitude = (np.ascontiguousarray(one, np.float32) for one in (distance, amplitude))
    LIBRARY.rim_to_image(*distance.shape, _at(distance), _at(amplitude), ambiguity, _at(image))


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

    As `rim_camera_ros.pipeline.optics.OpticsUndo` does; ``before`` are the amplitudes before.
    """
    image, before = (np.ascontiguousarray(one, np.float32) for one in (image, before))
    amplitude, gain = np.empty_like(before), np.empty_like(before)
    LIBRARY.rim_from_image(
        *distance.shape,
        _at(image),
        _at(before),
        ambiguity,
        int(wraps),
        direct,
        None if along is None else _at(along),
        square,
        _at(distance),
        _at(amplitude),
        _at(gain),
    )
    return amplitude, gain
