"""The camera before its scene: light on every pixel, and what the camera makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.signal import fftconvolve

from .electrons import Sensor
from .geometry import Hits, Lens, Placement, Spot, mixed, trace
from .scenes import Scene

#: Patches along each side of a surface that sends light on to others.
_PATCHES = 12
#: Half width [m] of the part of an endless plane that sends light on.
_PLANE = 1.6


@dataclass(frozen=True)
class World:
    """A camera, a scene, and everything that is not as the files say.

    `power` per station relative to nominal; `uptime` [s] and `air` temperature [degC] as functions of the
    station; `reflectivity` true tiles per surface; `gloss` (strength, width [rad]) of a weak lobe;
    `pattern` [m] and `gains` [-] per pixel; `known` effects with parameters as in a camera file;
    `hidden` strengths of effects whose forms are those of `forms`, with their `shape` parameters.
    """

    scene: Scene
    lens: Lens
    sensor: Sensor
    spot: Spot | None
    gain: float
    settings: np.ndarray
    power: np.ndarray
    uptime: np.ndarray
    air_history: tuple[np.ndarray, np.ndarray]
    reflectivity: dict[str, np.ndarray]
    gloss: tuple[float, float]
    pattern: np.ndarray
    gains: np.ndarray
    known: dict[str, dict[str, Any]]
    hidden: dict[str, float] = field(default_factory=dict)
    shape: dict[str, dict[str, Any]] = field(default_factory=dict)
    memory: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def with_hidden(self, **strengths: float) -> World:
        """The same with hidden effects of these strengths (0: none) besides those it has."""
        kept = {name: value for name, value in {**self.hidden, **strengths}.items() if value != 0.0}
        return replace(self, hidden=kept)

    def drawn(self, name: str, parameter: str) -> Any:
        """A parameter of the form of a hidden effect."""
        return self.shape[name][parameter]

    @property
    def true_lens(self) -> Lens:
        """The lens with what is hidden of it."""
        lens = self.lens
        if "camera_constant" in self.hidden:
            scale = 1 + self.hidden["camera_constant"]
            lens = replace(lens, fx=lens.fx * scale, fy=lens.fy * scale)
        if "lens_distortion" in self.hidden:
            off = self.hidden["lens_distortion"] * np.array(self.drawn("lens_distortion", "direction"))
            lens = replace(lens, d=tuple(float(value) for value in np.array(lens.d) + off))
        return lens

    @property
    def true_sensor(self) -> Sensor:
        """The sensor with the harmonics of a hidden cyclic error."""
        if "cyclic_error" not in self.hidden:
            return self.sensor
        third, fifth = self.drawn("cyclic_error", "harmonics")
        size = self.hidden["cyclic_error"]
        return replace(self.sensor, third=size * third, fifth=size * fifth)


@dataclass(frozen=True)
class Light:
    """Noise-free light of one exposure, images in counts: phasors of three harmonics and power.

    `distance` [m] and `amplitude` [counts] of the first harmonic; `angle` of incidence [rad] at pixel
    centres, `surface` there (-1: none), `mixed` pixels with a change within them, `tile` numbers.
    """

    harmonics: tuple[np.ndarray, np.ndarray, np.ndarray]
    power: np.ndarray
    distance: np.ndarray
    amplitude: np.ndarray
    angle: np.ndarray
    surface: np.ndarray
    tile: np.ndarray
    points: np.ndarray
    mixed: np.ndarray


def illuminate(
    world: World, station: int, *, area: bool = True, places: dict[str, Placement] | None = None
) -> Light:
    """Light at a station; without `area` only rays through pixel centres are traced."""
    height, width = world.scene.shape
    places = world.scene.places[station] if places is None else places
    lens = world.true_lens
    u, v = (grid.ravel().astype(float) for grid in np.meshgrid(np.arange(width), np.arange(height)))
    rays = lens.directions(u, v)
    centre = trace(rays, world.scene.surfaces, places)
    phasors = _phasors(world, station, rays, centre)
    spot = _true_spot(world) if area else None
    changing = np.zeros(height * width, bool)
    if spot is not None:
        reach = int(np.ceil(3 * np.abs(spot.offsets()).max())) if spot.disc else 2
        changing = mixed(lens, (height, width), world.scene.surfaces, places, reach=reach).ravel()
        offsets, index = spot.offsets(), np.flatnonzero(changing)
        many = lens.directions(
            (u[index, None] + offsets[:, 0]).ravel(), (v[index, None] + offsets[:, 1]).ravel()
        )
        found = _phasors(world, station, many, trace(many, world.scene.surfaces, places))
        for whole, part in zip(phasors, found, strict=True):
            whole[index] = part.reshape(len(index), -1).mean(axis=1)
    images = [one.reshape(height, width) for one in phasors]
    if "multipath" in world.hidden:
        second = world.hidden["multipath"] * _bounce(world, station, rays, centre, places)
        images = [images[0] + second.reshape(height, width), *images[1:]]
    if "scattering" in world.hidden:
        images = [_scatter(world, image) for image in images]
    images = [_outside(world, station, image, number) for number, image in enumerate(images)]
    images = [image * world.gains for image in images]
    phase = np.angle(images[0]) % (2 * np.pi)
    distance = phase * world.sensor.ambiguity / (2 * np.pi)
    seen = centre.surface >= 0
    points = np.where(seen[:, None], rays * np.where(seen, centre.distance, 0.0)[:, None], np.nan)
    return Light(
        (images[0], images[1], images[2]),
        np.real(images[3]),
        distance,
        np.abs(images[0]),
        np.arccos(np.clip(centre.cosine, 0, 1)).reshape(height, width),
        centre.surface.reshape(height, width),
        centre.tile.reshape(height, width),
        points.reshape(height, width, 3),
        changing.reshape(height, width),
    )


def _true_spot(world: World) -> Spot | None:
    if "mixed_pixels" not in world.hidden:
        return world.spot
    spot = world.spot or Spot(0.9, 0.1)
    return replace(spot, disc=world.hidden["mixed_pixels"])


def _phasors(world: World, station: int, rays: np.ndarray, hits: Hits) -> list[np.ndarray]:
    """Phasors of 1st, 3rd, 5th harmonic and power per ray, in counts."""
    seen = hits.surface >= 0
    rays, far = rays[seen], hits.distance[seen]
    points = rays * far[:, None]
    lamps = [np.zeros(3)]
    if "emitter_offset" in world.hidden:
        lamps = list(world.hidden["emitter_offset"] * np.array(world.drawn("emitter_offset", "lamps")))
    albedo = np.empty(len(far))
    for number, surface in enumerate(world.scene.surfaces):
        own = hits.surface[seen] == number
        albedo[own] = world.reflectivity[surface.name].ravel()[hits.tile[seen][own]]
    angle = np.arccos(np.clip(hits.cosine[seen], 0, 1))
    lobe = 1 + world.gloss[0] * np.exp(-((angle / world.gloss[1]) ** 2))
    axis = np.arccos(np.clip(rays[:, 2], -1, 1)) ** 2
    level = world.gain * world.settings[station] * world.power[station] / len(lamps)
    common = level * albedo * lobe * hits.cosine[seen] * fall_off(world, axis)
    out = [np.zeros(len(seen), complex) for _ in range(4)]
    for lamp in lamps:
        other = np.linalg.norm(points - lamp, axis=1)
        wave = np.exp(2j * np.pi * (far + other) / 2 / world.sensor.ambiguity)
        strength = common / other**2
        for image, part in zip(out, (wave, wave**3, wave**5, 1.0), strict=True):
            image[seen] += strength * part
    return out


def fall_off(world: World, squared: np.ndarray) -> np.ndarray:
    """Relative power of the lamp at a squared angle from the axis [rad^2]."""
    first, second = world.scene.falloff
    power = 1 + first * squared + second * squared**2
    if "emission_pattern" in world.hidden:
        # a lobe of its own: a power of the cosine
        power = power * np.cos(np.sqrt(squared)) ** world.hidden["emission_pattern"]
    return np.maximum(power, 0.02)


def _scatter(world: World, image: np.ndarray) -> np.ndarray:
    """Stray light with wings of a power law (Moffat 1969), nothing outside the sensor."""
    weight, radius = world.hidden["scattering"], world.drawn("scattering", "radius")
    height, width = image.shape
    v, u = np.mgrid[-height : height + 1, -width : width + 1]
    kernel = (1 + (u**2 + v**2) / radius**2) ** -world.drawn("scattering", "exponent")
    spread = fftconvolve(image, kernel / kernel.sum(), mode="same")
    return (1 - weight) * image + weight * spread


def _outside(world: World, station: int, image: np.ndarray, number: int) -> np.ndarray:
    """Light that no effect of the vocabulary describes; `number` of the image: harmonics, then power."""
    height, width = image.shape
    if "unknown_light_leak" in world.hidden and number in (0, 3):
        # a ring of the camera's own light beside the lens, along a path of its own
        down, across, radius, thick, phase = world.drawn("unknown_light_leak", "ring")
        v, u = np.mgrid[0:height, 0:width]
        far = np.hypot(u / width - across, (v / height - down) * height / width)
        ring = world.hidden["unknown_light_leak"] * np.exp(-(((far - radius) / thick) ** 2))
        ring = ring * world.power[station] * world.settings[station] / 60
        image = image + ring * (1.0 if number == 3 else np.exp(1j * phase))
    if "unknown_crosstalk" in world.hidden:
        # every second column takes from its right neighbour
        given = np.zeros_like(image)
        given[:, 0:-1:2] = image[:, 1::2][:, : given[:, 0:-1:2].shape[1]]
        image = image + world.hidden["unknown_crosstalk"] * given
    return image


def _bounce(
    world: World, station: int, rays: np.ndarray, centre: Hits, places: dict[str, Placement]
) -> np.ndarray:
    """Phasor that reaches each pixel by one diffuse reflection at another surface, in counts.

    Every surface is cut into patches; a patch of area a and reflectivity r receives E = cos / d^2 and
    sends r E a cos / (pi s^2) on to a point at distance s, both being Lambertian. Nothing shades.
    """
    key = ("bounce", station)
    if key not in world.memory:
        world.memory[key] = _one_bounce(world, station, rays, centre, places)
    found: np.ndarray = world.memory[key]
    return found


def _one_bounce(
    world: World, station: int, rays: np.ndarray, centre: Hits, places: dict[str, Placement]
) -> np.ndarray:
    seen = np.flatnonzero(centre.surface >= 0)
    points = rays[seen] * centre.distance[seen, None]
    normals = centre.normal[seen]
    total = np.zeros(len(seen), complex)
    albedo = np.empty(len(seen))
    for number, surface in enumerate(world.scene.surfaces):
        own = centre.surface[seen] == number
        albedo[own] = world.reflectivity[surface.name].ravel()[centre.tile[seen][own]]
    for number, surface in enumerate(world.scene.surfaces):
        if surface.kind == "sphere":
            continue
        place, (wide, high) = places[surface.name], surface.size or (2 * _PLANE, 2 * _PLANE)
        x, y = (((np.arange(_PATCHES) + 0.5) / _PATCHES - 0.5)[:, None] * side for side in (wide, high))
        x, y = (grid.ravel() for grid in np.meshgrid(x.ravel(), y.ravel()))
        rows, columns = surface.values.shape
        i = np.floor(y / surface.cell[1]).astype(int) % rows
        j = np.floor(x / surface.cell[0]).astype(int) % columns
        ground = place.position + np.stack([x, y], axis=1) @ place.rotation[:, :2].T
        far = np.linalg.norm(ground, axis=1)
        normal = -place.rotation[:, 2] * np.sign(-(ground @ -place.rotation[:, 2]).mean())
        facing = np.abs(ground @ normal) / far
        lit = (ground[:, 2] > 0.05) * facing / far**2 * (wide * high / _PATCHES**2) / np.pi
        lit = lit * fall_off(world, np.arccos(np.clip(ground[:, 2] / far, -1, 1)) ** 2)
        lit = lit * world.reflectivity[surface.name][i, j]
        others = np.flatnonzero(centre.surface[seen] != number)
        for part in np.array_split(others, max(1, len(others) // 2000)):
            between = points[part][:, None, :] - ground[None, :, :]
            step = np.linalg.norm(between, axis=2)
            leaves = np.maximum(between @ normal, 0) / step
            arrives = np.maximum(-np.einsum("ijk,ik->ij", between, normals[part]), 0) / step
            path = (far[None, :] + step + centre.distance[seen[part], None]) / 2
            wave = np.exp(2j * np.pi * path / world.sensor.ambiguity)
            total[part] += (lit * leaves * arrives / np.maximum(step, 0.03) ** 2 * wave).sum(axis=1)
    level = world.gain * world.settings[station] * world.power[station]
    found = np.zeros(len(centre.surface), complex)
    found[seen] = level * albedo * total
    return found
