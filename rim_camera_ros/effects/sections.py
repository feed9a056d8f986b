"""Names of the vocabulary without parameters under ``effects``: sections of a camera file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Block, Candidate, Coefficients, Column, Facts, Reading, Regressor
from rim_camera_ros.effects.light_curves import LOBE, LOBE_SIGMA, RIPPLES, SURFACES
from rim_camera_ros.effects.physics import Physics
from rim_camera_ros.optics import ray_derivatives
from rim_camera_ros.parameters import flatten, with_values

Array = NDArray[Any]

#: 1-sigma of the relative change of a surface's light at an angle of incidence, and of a response to light.
REFLECTANCE_PRIOR = 0.2
#: ... and of its ripples over the phase.
_RIPPLE_PRIOR = 0.03


class Section(Physics):
    """A name whose parameters stand in a section of the camera file."""

    #: the section of the camera file
    section: ClassVar[str]
    #: description of a camera file that lacks it
    missing: ClassVar[str]


class OpticsSection(Section):
    """Numbers of the optics: they move the rays."""

    section = "optics"
    observable = "a board at known poses that reaches into the corners of the image"
    moves_rays = True
    needs_all_pixels = True
    #: path under ``optics`` and 1-sigma of the prior
    numbers: ClassVar[tuple[tuple[str, float], ...]]

    @classmethod
    def block(cls, camera: Camera) -> Block:
        """Return the regressors of the numbers about those of the camera."""
        regressors = tuple(Regressor(f"optics.{path}", cls.name, prior) for path, prior in cls.numbers)
        return Block(regressors, optics_columns(camera, [path for path, _ in cls.numbers]), pointwise=True)

    @classmethod
    def of_another(cls, camera: Camera, other: Camera) -> Camera:
        """Return the camera with the numbers that another one has."""
        numbers = flatten(other.optics)
        return replace(
            camera, optics=with_values(camera.optics, {path: numbers[path] for path, _ in cls.numbers})
        )

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        block = cls.block(camera)

        def build(other: Camera, values: Coefficients) -> Camera:
            numbers = flatten(other.optics)
            paths = {r.label.removeprefix("optics."): r.label for r in block.regressors}
            moved = {path: numbers[path] + values[label] for path, label in paths.items()}
            return replace(other, optics=with_values(other.optics, moved))

        return [Candidate(cls.name, "", block, build)]

    @classmethod
    def record(cls) -> str:
        return "record: targets at known coordinates, from several rotated stations"


class CameraConstant(OpticsSection):
    """Focal length and principal point (Kahlmann 2007, sec. 3.2)."""

    name = "camera_constant"
    title = "focal length and principal point"
    refuted_by = "residuals that do not grow with the tilt of a surface"
    missing = "camera constant: focal length or principal point differ from the camera file's"
    numbers = (("fx", 5.0), ("fy", 5.0), ("cx", 3.0), ("cy", 3.0))


class LensDistortion(OpticsSection):
    """Distortion of the lens (Kahlmann 2007, sec. 3.2), ROS plumb_bob."""

    name = "lens_distortion"
    title = "lens distortion"
    refuted_by = "edges of a board that are straight in the undistorted image"
    missing = "lens distortion: the rays bend other than the camera file's distortion says"
    numbers = (("d.0", 0.1), ("d.1", 0.1), ("d.2", 0.003), ("d.3", 0.003))


class NoiseSection(Section):
    """The standard deviation of single frames (`rim_camera_ros.noise`)."""

    name = "noise"
    title = "the noise model"
    observable = "repeated frames of a scene at rest, bright to dark"
    refuted_by = "a variance of repeated frames as the model states it"
    section = "noise"
    missing = "noise: repeated frames scatter otherwise than the model says"
    shows_in = "noise"
    estimated = "elsewhere"
    estimated_elsewhere = "shows in the scatter of frames"


class Radiometry(Section):
    """Surfaces that do not reflect as Lambert says: their fit frees curves of the light."""

    name = "radiometry"
    title = "the brightness of the light"
    observable = "a surface of known reflectance at several angles of incidence"
    refuted_by = "amplitudes in proportion to the cosine of the angle of incidence"
    section = "radiometry"
    missing = (
        "radiometry: surfaces do not reflect as Lambert says; amplitudes depend otherwise on the angle "
        "of incidence than the scene's simulation"
    )
    shows_in = "amplitude"
    drawn_over = ("incidence",)
    of_surfaces = True
    planned = False

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [Candidate(cls.name, "incidence", light_block(SURFACES), lambda other, values: other)]


SECTIONS: dict[str, type[Section]] = {
    one.name: one for one in (LensDistortion, CameraConstant, NoiseSection, Radiometry)
}
#: Sections whose numbers move the rays, in the order in which they are fitted.
OPTICS: dict[str, type[OpticsSection]] = {one.name: one for one in (CameraConstant, LensDistortion)}
#: Names that belong to the scene's surfaces.
OF_SURFACES = frozenset(name for name, one in SECTIONS.items() if one.of_surfaces)


def optics_columns(camera: Camera, paths: Sequence[str]) -> Callable[[Reading], list[Column]]:
    """Return the derivatives of the distances by numbers of the optics (``fx``, ``d.0``)."""
    changes = ray_derivatives(camera.optics, camera.rays, paths)

    def columns(reading: Reading) -> list[Column]:
        context = reading.context
        geometry = context.geometry
        assert geometry is not None
        along = np.einsum("ijk,ijk->ij", geometry.normals, context.inside(camera.rays))
        result: list[Column] = []
        for change in map(context.inside, changes):
            with np.errstate(invalid="ignore", divide="ignore"):
                by = -geometry.distance * np.einsum("ijk,ijk->ij", geometry.normals, change) / along
            by = np.where(geometry.hit, np.nan_to_num(by), 0.0)
            result.append((np.asarray(reading.reading_change(by, 0.0)[0]), None))
        return result

    return columns


def light_block(labels: Sequence[str], *, sigma: float = REFLECTANCE_PRIOR) -> Block:
    """Return the regressors of curves of the light, by their labels in `light_curves`.

    ``sigma`` is the prior of the heights of curves that have no own size.
    """
    prior = sigma
    if labels[0] in RIPPLES:
        prior = _RIPPLE_PRIOR
    elif labels[0] in LOBE:
        prior = LOBE_SIGMA
    regressors = tuple(Regressor(label, Radiometry.name, prior) for label in labels)
    return Block(regressors, lambda reading: reading.curve_columns(labels), pointwise=True)
