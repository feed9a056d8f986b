"""Light by way of another surface: one diffuse bounce between surfaces that the emitter lights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import Effect, Undo, effect_of
from rim_camera_ros.effects.candidate import Candidate, Facts, linear
from rim_camera_ros.effects.discrepancy import Change, DiscrepancyColumn, spread_out
from rim_camera_ros.effects.emission_pattern import EmissionPattern
from rim_camera_ros.effects.signal import (
    Column,
    Context,
    Image,
    Signal,
    from_phasor,
    phasor_derivative,
    require_geometry,
)
from rim_camera_ros.geometry import Geometry
from rim_camera_ros.optics import rays_beyond
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor

#: Side in pixels of the blocks of pixels that act as senders of the bounced light.
BLOCK = 4
#: Angle [rad] between senders beyond the view, and the largest angle of emitted light from the axis.
BEYOND_STEP = 0.08
BEYOND_WIDEST = np.radians(75.0)
#: Receivers at a time, which bounds the memory.
_CHUNK = 2048
#: Relative error [-] and difference of path lengths [m] that count as none.
_EXACT = 1e-9
#: Differences of normals up to which a surface is a plane, and heights [m] above it that count as none.
_FLAT = 1e-9
_SAME_PLANE = 1e-9


@dataclass(frozen=True)
class Multipath(Effect):
    """S_i += strength * sum_j A_j rho_i F_ij exp(i 2 pi d_ij / L).

    Patch j of the scene is lit as its amplitude A_j says (emission pattern and emitter offset
    included), and sends light diffusely to patch i. F_ij = cos_i cos_j dA_j / (pi r^2 + dA_j) is the
    form factor of a small disc; d_ij is half the length of the path emitter - j - i - camera. Senders
    are blocks of 4 x 4 pixels, and surfaces that the emitter lights beyond the view, in steps of 0.08 rad
    up to 75 degrees from the axis, as if it stood at the lens; occlusion between patches is neglected.
    Follows the vocabulary's definition with the radiometry of Lambert (Kahlmann 2007, eq. 2.10).
    """

    name = "multipath"
    title = "light by way of another surface"
    observable = "a concave corner or a bright surface beside a dark one, at known poses"
    refuted_by = "a corner measured as sharp as a single wall"
    undo: ClassVar[Undo] = "none"
    remembers = True

    remembers_geometry = True
    steady = True
    lacking = "the scene has one surface"
    needs_all_pixels = True
    planned = False
    shows_on_a_wall = False

    strength: float = quantity("-", "1 = Lambertian surfaces", minimum=0.0, typical=1.0)

    def bounced(self, signal: Signal, context: Context) -> Image:
        """Return the complex image of the bounced light for strength 1."""
        geometry = require_geometry(context, self.name)
        cached = context.memory.get(self.name)
        if cached is not None and cached.geometry is geometry:
            scale = cached.scale_to(signal, context.light_tolerance)
            if scale is not None:
                rescaled: Image = scale * cached.bounced
                return rescaled
        result = _bounce(signal, geometry, context)
        context.memory[self.name] = _Cached(geometry, signal.distance, signal.amplitude, result)
        return result

    def simulate(self, signal: Signal, context: Context) -> Signal:
        direct = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        return from_phasor(direct + self.strength * self.bounced(signal, context), signal, context)

    def columns(self, signal: Signal, context: Context) -> dict[str, Column]:
        bounced = self.bounced(signal, context)
        direct = to_phasor(signal.distance, signal.amplitude, context.ambiguity)
        return {"strength": phasor_derivative(direct + self.strength * bounced, bounced, context.ambiguity)}

    def sentence(self) -> str:
        return (
            f"multipath: {self.strength:.2g} times the light that ideal diffuse surfaces would send to each "
            "other reaches the camera by a detour and lengthens distances in corners"
        )

    @classmethod
    def candidates(cls, camera: Camera, facts: Facts) -> list[Candidate]:
        return [linear(cls(strength=0.0), {"strength": 1.0})] if facts.surfaces > 1 else []

    def discrepancy(self, change: Change) -> Iterator[DiscrepancyColumn]:
        yield from super().discrepancy(change)
        yield from spread_out(change)

    @classmethod
    def example(cls, camera: Camera) -> Multipath:
        return cls(strength=0.7)


def _bounce(signal: Signal, geometry: Geometry, context: Context) -> Image:
    senders = _senders(signal, geometry, context.camera)
    further = _senders_beyond(signal, geometry, context.camera)
    if further is not None:
        senders = senders.and_also(further)
    hit = geometry.hit.ravel()
    surface = geometry.surface.ravel()[hit]
    points = geometry.points.reshape(-1, 3)[hit]
    normals = geometry.normals.reshape(-1, 3)[hit]
    wave = 2 * np.pi / context.ambiguity
    arrived = np.zeros(len(points), complex)
    for own in np.unique(surface):
        receivers = np.flatnonzero(surface == own)
        for other in np.unique(senders.surface):
            chosen = np.flatnonzero(senders.surface == other)
            part, light = _between(points[receivers], normals[receivers], senders.only(chosen), wave=wave)
            arrived[receivers[part]] += light
    # the path's phase is the sender's, the receiver's and that of the way between
    length = geometry.distance.ravel()[hit]
    result = np.zeros(hit.shape, complex)
    result[hit] = geometry.reflectivity.ravel()[hit] * arrived * np.exp(0.5j * wave * length)
    return result.reshape(geometry.distance.shape)


def _between(points: Image, normals: Image, senders: _Senders, *, wave: float) -> tuple[Image, Image]:
    """Return which receivers of one surface are lit by senders of one surface, and the light there.

    A receiver is lit by senders in front of its surface, and a sender lights receivers in front of its own:
    for planes this is known without a test of pairs.
    """
    rows, columns = np.arange(len(points)), np.arange(len(senders.area))
    flat_here, flat_there = _is_flat(normals), _is_flat(senders.normals)
    # r times the cosine at the sender, and at the receiver, of a pair
    if flat_there:
        leaving = (points - senders.points[0]) @ senders.normals[0]
        rows = np.flatnonzero(leaving > _SAME_PLANE)
    if flat_here:
        arriving = (senders.points - points[0]) @ normals[0]
        columns = np.flatnonzero(arriving > _SAME_PLANE)
    light = np.zeros(len(rows), complex)
    if not rows.size or not columns.size:
        return rows, light
    there = senders.only(columns)
    sent = there.amplitude * np.exp(0.5j * wave * there.outward)
    if flat_here:
        sent = sent * arriving[columns]
    # in float32 for speed: its errors are 1e-6 of a weak light
    parts = np.stack([sent.real, sent.imag], axis=1).astype(np.float32)
    area = there.area.astype(np.float32)
    for start in range(0, len(rows), _CHUNK):
        chunk = rows[start : start + _CHUNK]
        square = _square_distances(points[chunk], there.points)
        factor = area / (square * (np.float32(np.pi) * square + area))
        if not flat_there:
            plane = np.einsum("jk,jk->j", there.normals, there.points)
            factor *= np.maximum(points[chunk] @ there.normals.T - plane, 0).astype(np.float32)
        if not flat_here:
            plane = np.einsum("ik,ik->i", normals[chunk], points[chunk])
            factor *= np.maximum(normals[chunk] @ there.points.T - plane[:, None], 0).astype(np.float32)
        phase = np.sqrt(square, out=square)
        phase *= np.float32(0.5 * wave)
        cosine = (factor * np.cos(phase)) @ parts
        sine = np.multiply(factor, np.sin(phase), out=factor) @ parts
        light[start : start + _CHUNK] = cosine[:, 0] - sine[:, 1] + 1j * (cosine[:, 1] + sine[:, 0])
    if flat_there:
        light *= leaving[rows]
    return rows, light


def _is_flat(normals: Image) -> bool:
    return bool(np.ptp(normals, axis=0).max() <= _FLAT)


@dataclass(frozen=True)
class _Cached:
    """The bounced light of a scene at rest, which is in proportion to its amplitude."""

    geometry: Geometry
    distance: Image
    amplitude: Image
    bounced: Image

    def scale_to(self, signal: Signal, tolerance: float) -> float | None:
        """Return the factor to the amplitudes of a signal, None where they are not in proportion."""
        total = float(self.amplitude.sum())
        apart = max(_EXACT, 0.1 * tolerance)
        if total == 0 or not np.allclose(signal.distance, self.distance, rtol=0, atol=apart, equal_nan=True):
            return None
        scale = float(signal.amplitude.sum()) / total
        difference = np.abs(signal.amplitude - scale * self.amplitude)
        if tolerance <= _EXACT:
            return scale if difference.max() <= tolerance * float(signal.amplitude.max()) else None
        return scale if bool(np.all(difference <= tolerance * signal.amplitude)) else None


def _square_distances(a: Image, b: Image) -> Image:
    """Return |a_i - b_j|^2 in m^2 (N, M) as float32, never 0."""
    square = np.einsum("ik,ik->i", a, a)[:, None] + np.einsum("jk,jk->j", b, b) - 2.0 * (a @ b.T)
    result: Image = np.maximum(square, 1e-9).astype(np.float32)
    return result


@dataclass(frozen=True)
class _Senders:
    points: Image
    normals: Image
    amplitude: Image
    area: Image
    outward: Image
    surface: Image

    def only(self, chosen: Image) -> _Senders:
        """Return some of the senders."""
        return _Senders(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def and_also(self, others: _Senders) -> _Senders:
        """Return these senders and others."""
        both = ((getattr(self, field.name), getattr(others, field.name)) for field in fields(self))
        return _Senders(*(np.concatenate(pair) for pair in both))


def _senders(signal: Signal, geometry: Geometry, camera: Camera) -> _Senders:
    """Blocks of pixels on one surface each: mean point, mean amplitude, area on the surface."""
    height, width = geometry.distance.shape
    block = np.arange(height)[:, None] // BLOCK * (width // BLOCK + 1) + np.arange(width)[None] // BLOCK
    label = block * (int(geometry.surface.max()) + 2) + geometry.surface
    hit = geometry.hit
    _, first, index, count = np.unique(label[hit], return_index=True, return_inverse=True, return_counts=True)

    def mean(values: Image) -> Image:
        return np.bincount(index, values, len(count)) / count

    def mean3(values: Image) -> Image:
        return np.stack([mean(values[..., k]) for k in range(3)], axis=-1)

    # solid angle of a pixel: its area over f^2 times cos^3 of the angle from the axis
    solid = camera.rays[..., 2][hit] ** 3 / (camera.optics.fx * camera.optics.fy)
    area = solid * geometry.distance[hit] ** 2 / np.maximum(geometry.cos_incidence[hit], 1e-3)
    normals = mean3(geometry.normals[hit])
    return _Senders(
        points=mean3(geometry.points[hit]),
        normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        amplitude=mean(signal.amplitude[hit]),
        area=np.bincount(index, area, len(count)),
        # from the emitter to the patch: twice the delivered distance less the way back
        outward=mean((2 * signal.distance - geometry.distance)[hit]),
        surface=geometry.surface[hit][first],
    )


def _senders_beyond(signal: Signal, geometry: Geometry, camera: Camera) -> _Senders | None:
    """Return senders lit by the emitter beyond the view, None where there are none.

    Their brightness follows from Lambert's law, the falloff of the emitter and the mean of the pixels' light.
    """
    height, width = geometry.distance.shape
    rays, solid = rays_beyond(
        camera.optics, width=width, height=height, step=BEYOND_STEP, widest=BEYOND_WIDEST
    )
    there = geometry.along(rays[None])
    pattern = effect_of(camera, EmissionPattern)
    here = geometry.hit
    if there is None or not there.hit.any() or not here.any():
        return None
    lit = there.hit[0]
    cosine, distance = there.cos_incidence[0, lit], there.distance[0, lit]
    area = solid[lit] * distance**2 / np.maximum(cosine, 1e-3)
    power: Image | float = 1.0 if pattern is None else pattern.towards(rays[lit], camera)
    power_here: Image | float = 1.0 if pattern is None else pattern.power(camera)[here]
    ideal = float(np.sum(_lambertian(geometry, here) * power_here))
    if ideal <= 0:
        return None
    return _Senders(
        points=there.points[0, lit],
        normals=there.normals[0, lit],
        amplitude=_lambertian(there, there.hit) * power * (signal.amplitude[here].sum() / ideal),
        area=area,
        outward=distance,
        surface=there.surface[0, lit],
    )


def _lambertian(geometry: Geometry, where: Image) -> Image:
    """Return the light (N,) of power 1 by Lambert's law (Kahlmann 2007, eq. 2.10)."""
    light: Image = (
        geometry.reflectivity[where] * geometry.cos_incidence[where] / geometry.distance[where] ** 2
    )
    return light
