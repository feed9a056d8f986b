"""Light by way of another surface: one diffuse bounce between the surfaces in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.base import (
    Column,
    Context,
    Effect,
    Image,
    Signal,
    Undo,
    from_phasor,
    phasor_derivative,
    require_geometry,
)
from rim_camera_ros.parameters import quantity
from rim_camera_ros.phasor import to_phasor
from rim_camera_ros.scene import Geometry

#: Side in pixels of the blocks of pixels that act as senders of the bounced light.
BLOCK = 4
#: Key of the memory of a context: relative change of the light (and tenths of a metre of its way) up to which
#: bounced light computed before will do. That of light that changed by a hundredth is off by a ten
#: thousandth of all light.
TOLERANCE = "multipath.tolerance"
_EXACT = 1e-9
#: Receivers at a time, which bounds the memory.
_CHUNK = 2048


@dataclass(frozen=True)
class Multipath(Effect):
    """S_i += strength * sum_j A_j rho_i F_ij exp(i 2 pi d_ij / L).

    Patch j of the scene is lit as its amplitude A_j says (emission pattern and emitter offset
    included), and sends light diffusely to patch i. F_ij = cos_i cos_j dA_j / (pi r^2 + dA_j) is the
    form factor of a small disc; d_ij is half the length of the path emitter - j - i - camera. Senders
    are blocks of 4 x 4 pixels; light from surfaces outside the view and occlusion between patches are
    left out. Follows the vocabulary's definition with the radiometry of Lambert (Kahlmann 2007,
    eq. 2.10).
    """

    name = "multipath"
    title = "light by way of another surface"
    observable = "a concave corner or a bright surface beside a dark one, at known poses"
    refuted_by = "a corner measured as sharp as a single wall"
    undo: ClassVar[Undo] = "none"

    strength: float = quantity("-", "1 = Lambertian surfaces", minimum=0.0, typical=1.0)

    def bounced(self, signal: Signal, context: Context) -> Image:
        """Return the complex image of the bounced light for strength 1."""
        geometry = require_geometry(context, self.name)
        cached = context.memory.get(self.name)
        if cached is not None and cached.geometry is geometry:
            scale = cached.scale_to(signal, float(context.memory.get(TOLERANCE, _EXACT)))
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
    def example(cls, camera: Camera) -> Multipath:
        return cls(strength=0.7)


def _bounce(signal: Signal, geometry: Geometry, context: Context) -> Image:
    senders = _senders(signal, geometry, context.camera)
    hit = geometry.hit.ravel()
    points = geometry.points.reshape(-1, 3)[hit]
    normals = geometry.normals.reshape(-1, 3)[hit]
    reflectivity = geometry.reflectivity.ravel()[hit]
    length = geometry.distance.ravel()[hit]
    wave = 2 * np.pi / context.ambiguity
    # the path's phase is the sender's, the receiver's and that of the way between, in float32 for speed:
    # its errors are 1e-6 of a weak light
    sent = senders.amplitude * np.exp(0.5j * wave * senders.outward)
    area = senders.area.astype(np.float32)
    sender_plane = np.einsum("jk,jk->j", senders.normals, senders.points)
    received = np.empty(len(points), complex)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        own_plane = np.einsum("ik,ik->i", normals[part], points[part])
        # both cosines times r: sender's normal . r, receiver's normal . -r
        factor = (points[part] @ senders.normals.T - sender_plane).astype(np.float32)
        np.maximum(factor, 0, out=factor)
        arriving = (normals[part] @ senders.points.T - own_plane[:, None]).astype(np.float32)
        factor *= np.maximum(arriving, 0, out=arriving)
        square = _square_distances(points[part], senders.points)
        factor /= square
        factor *= area
        factor /= np.float32(np.pi) * square + area
        phase = np.sqrt(square, out=square)
        phase *= np.float32(0.5 * wave)
        arrived = (factor * np.cos(phase)) @ sent + 1j * ((factor * np.sin(phase)) @ sent)
        received[part] = reflectivity[part] * arrived * np.exp(0.5j * wave * length[part])
    result = np.zeros(hit.shape, complex)
    result[hit] = received
    return result.reshape(geometry.distance.shape)


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


def _senders(signal: Signal, geometry: Geometry, camera: Camera) -> _Senders:
    """Blocks of pixels on one surface each: mean point, mean amplitude, area on the surface."""
    height, width = geometry.distance.shape
    block = np.arange(height)[:, None] // BLOCK * (width // BLOCK + 1) + np.arange(width)[None] // BLOCK
    label = block * (int(geometry.surface.max()) + 2) + geometry.surface
    hit = geometry.hit
    _, index, count = np.unique(label[hit], return_inverse=True, return_counts=True)

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
    )
