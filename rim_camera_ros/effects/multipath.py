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
        key = (id(geometry), signal.amplitude.tobytes())
        cached = context.memory.get(self.name)
        if cached is not None and cached[0] == key:
            result: Image = cached[1]
            return result
        result = _bounce(signal, geometry, context)
        # the geometry is kept with the key, so that its id stays its own
        context.memory[self.name] = (key, result, geometry)
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
    received = np.empty(len(points), complex)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        between = points[part, None, :] - senders.points[None]
        square = np.einsum("ijk,ijk->ij", between, between)
        # both cosines times r: sender's normal . r, receiver's normal . -r
        leaving = np.maximum(np.einsum("ijk,jk->ij", between, senders.normals), 0)
        arriving = np.maximum(-np.einsum("ijk,ik->ij", between, normals[part]), 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = leaving * arriving / square * senders.area / (np.pi * square + senders.area)
        factor[square == 0] = 0
        half_path = 0.5 * (senders.outward + np.sqrt(square) + length[part, None])
        received[part] = reflectivity[part] * ((factor * np.exp(1j * wave * half_path)) @ senders.amplitude)
    result = np.zeros(hit.shape, complex)
    result[hit] = received
    return result.reshape(geometry.distance.shape)


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


