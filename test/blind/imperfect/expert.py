"""What an expert could decide: how much of an effect is left after everything ordinary, in nats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .electrons import sigma
from .forms import GON, draw_shape, hidden_terms, known_terms, lagged, response
from .geometry import mixed
from .world import Light, World, illuminate

#: Prior widths: offset of a pixel [m], its gain, reflectivity of a tile, scale of distance.
OFFSET, GAIN, TILE, SCALE = 0.05, 0.02, 0.1, 0.02
#: Prior width of every other coefficient, in units that its column has been scaled to (RMS 1 sigma).
FREE = 1e3
FRAMES = 3
#: RMS of distances over single-frame sigma below which an effect moves no distances.
_MOVES = 0.05


@dataclass(frozen=True)
class Sight:
    """What a world shows without noise, (stations, height, width): distance [m], log amplitude."""

    distance: np.ndarray
    log_amplitude: np.ndarray

    def minus(self, other: Sight, ambiguity: float) -> Sight:
        """The difference, distances modulo a period."""
        off = (self.distance - other.distance + ambiguity / 2) % ambiguity - ambiguity / 2
        return Sight(off, self.log_amplitude - other.log_amplitude)


def observe(world: World, *, area: bool = False) -> Sight:
    """What all stations show without noise; of a pixel's light only its centre unless `area`."""
    distance, amplitude = [], []
    before = None
    for station in range(len(world.settings)):
        light = illuminate(world, station, area=area)
        far, strong = published(world, station, light, before=before)
        before = light
        distance.append(far)
        amplitude.append(strong)
    with np.errstate(divide="ignore"):
        logarithm = np.log(np.stack(amplitude))
    return Sight(np.stack(distance), np.where(np.isfinite(logarithm), logarithm, np.nan))


def published(
    world: World,
    station: int,
    light: Light,
    rng: np.random.Generator | None = None,
    *,
    before: Light | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m], not wrapped, and amplitude [counts] of one exposure; without `rng` free of noise.

    `before`: light of the exposure before it, of which a sensor with a memory keeps a part.
    """
    harmonics, power = light.harmonics, light.power
    if "unknown_memory" in world.hidden and before is not None:
        kept = world.hidden["unknown_memory"]
        harmonics = (harmonics[0] + kept * before.harmonics[0], *harmonics[1:])
        power = power + kept * before.power
    if "interference" in world.hidden:
        other = _second_camera(world, station, light, rng)
        harmonics, power = (harmonics[0] + other, *harmonics[1:]), power + np.abs(other)
    phasor = world.true_sensor.demodulate(harmonics, power, rng)
    measured = np.angle(phasor) % (2 * np.pi) * world.sensor.ambiguity / (2 * np.pi)
    terms = known_terms(world, station, light) + hidden_terms(world, station, light) + world.pattern
    return measured + terms, response(world, np.abs(phasor))


def _second_camera(world: World, station: int, light: Light, rng: np.random.Generator | None) -> np.ndarray:
    phase = (rng or np.random.default_rng(1000 + station)).uniform(0, 2 * np.pi)
    height, width = light.distance.shape
    v, u = np.mgrid[0:height, 0:width]
    down, across = world.drawn("interference", "tilt")
    shade = 1 + across * (2 * u / width - 1) + down * (2 * v / height - 1)
    found: np.ndarray = world.hidden["interference"] * shade * np.exp(1j * phase)
    return found


@dataclass(frozen=True)
class Judgement:
    """`size`: RMS of distance effect / single-frame sigma; `amplitude_size` likewise of the amplitude.

    `share` of its energy that ordinary things leave, what that is worth in `nats`, the best single `rival`
    and by how many nats that is worse than the truth; `map`: RMS over stations of effect / sigma per pixel,
    of distances, or of amplitudes where an effect moves these alone.
    """

    size: float
    amplitude_size: float
    share: float
    nats: float
    rival: str | None
    rival_nats: float
    map: np.ndarray


class Expert:
    """Columns of everything ordinary for one recording; judges effects by linear projection."""

    def __init__(
        self,
        world: World,
        *,
        noise: dict[str, float],
        threshold: float,
        power_sigma: float,
        edges: bool = False,
    ) -> None:
        self.world, self.edges = world, edges
        self.stations = len(world.settings)
        self.sight = observe(world, area=edges)
        self.lights = [illuminate(world, k, area=False) for k in range(self.stations)]
        amplitude = np.exp(np.nan_to_num(self.sight.log_amplitude, nan=-9.0))
        self.sigma = sigma(noise, amplitude)
        valid = np.isfinite(self.sight.distance) & (amplitude > 1.15 * threshold)
        valid &= np.stack([light.surface >= 0 for light in self.lights])
        if not edges:
            changing = [
                mixed(world.true_lens, world.scene.shape, world.scene.surfaces, world.scene.places[k])
                for k in range(self.stations)
            ]
            valid &= ~np.stack(changing)
        self.weight = np.where(valid, 1 / self.sigma, 0.0)
        self.phase_weight = self.weight * world.sensor.ambiguity / (2 * np.pi)
        self.power_sigma = max(power_sigma, 1e-4)
        self._smooth: dict[str, list[Sight]] | None = None
        self._simulated: dict[str, list[Sight]] | None = None

    def size(self, effect: Sight) -> tuple[float, float]:
        """RMS of effect / single-frame sigma, of distances and of amplitudes."""
        valid = self.weight > 0
        relative = (np.nan_to_num(effect.distance) * self.weight)[valid]
        bright = (np.nan_to_num(effect.log_amplitude) * self.phase_weight)[valid]
        if not len(relative):
            return 0.0, 0.0
        return float(np.sqrt((relative**2).mean())), float(np.sqrt((bright**2).mean()))

    def judge(
        self,
        effect: Sight,
        *,
        own: Iterable[str],
        baseline: Iterable[str],
        fitted: Sequence[Sight] = (),
        simulated: bool = True,
    ) -> Judgement:
        """Judge an effect; `own` families are neither rivals nor baseline, `baseline` is always fitted.

        So is what stands in `fitted`. Without `simulated` rivals that must be simulated are passed over.
        """
        own = set(own)
        off = np.nan_to_num(effect.distance)
        other = np.nan_to_num(effect.log_amplitude)
        valid = self.weight > 0
        relative = (off * self.weight)[valid]
        bright = (other * self.phase_weight)[valid]
        columns = {name: found for name, found in self.columns(simulated).items() if name not in own}
        names = [name for name in columns if name in set(baseline)]
        rivals = [name for name in columns if name not in names]
        vectors: list[Sight] = [effect, *fitted]
        owner: list[str | None] = [None] * len(vectors)
        for name in names + rivals:
            vectors += columns[name]
            owner += [name] * len(columns[name])
        gram = self._distance_gram([one.distance for one in vectors])
        gram2 = self._amplitude_gram([one.log_amplitude for one in vectors])
        fixed = [i for i, name in enumerate(owner) if i and (name is None or name in names)]
        energy = float((relative**2).sum() + (bright**2).sum()) * FRAMES
        left = _left(gram, fixed) + _left(gram2, fixed)
        best, least = None, np.inf
        for name in rivals:
            index = fixed + [i for i, one in enumerate(owner) if one == name]
            rest = _left(gram, index) + _left(gram2, index)
            if rest < least:
                best, least = name, rest
        sites, sizes = valid.sum(axis=0), self.size(effect)
        # as in the other generator: distances, or amplitudes where an effect moves these alone
        seen = off * self.weight if sizes[0] > _MOVES else other * self.phase_weight
        total = np.where(valid, seen**2, 0.0).sum(axis=0)
        return Judgement(
            size=sizes[0],
            amplitude_size=sizes[1],
            share=left / energy if energy > 0 else 0.0,
            nats=left / 2,
            rival=best,
            rival_nats=min(least, left) / 2,
            map=np.sqrt(total / np.maximum(sites, 1)).astype(np.float32),
        )

    def _distance_gram(self, vectors: list[np.ndarray]) -> np.ndarray:
        """Gram matrix of columns after pixels' offsets and errors of poses, with priors."""
        return absorbed(vectors, self.weight * np.sqrt(FRAMES), self.pose_columns(), OFFSET)

    def pose_columns(self) -> list[np.ndarray]:
        """Columns (n, height, width) of every station's pose errors, scaled by their prior widths."""
        return [self._pose_columns(k) for k in range(self.stations)]

    def _amplitude_gram(self, vectors: list[np.ndarray]) -> np.ndarray:
        """The same of log amplitudes, after pixels' gains, power per station, and reflectivities."""
        one = np.ones((1, *self.world.scene.shape)) * self.power_sigma
        tiles = self._tile_columns()
        found = absorbed(vectors + tiles, self.phase_weight * np.sqrt(FRAMES), [one] * self.stations, GAIN)
        n = len(vectors)
        inner = found[n:, n:] + np.eye(len(tiles))
        reduced: np.ndarray = found[:n, :n] - found[:n, n:] @ np.linalg.solve(inner, found[n:, :n])
        return reduced

    def _tile_columns(self) -> list[np.ndarray]:
        kinds = np.stack([light.surface * 1000 + light.tile for light in self.lights])
        here = np.unique(kinds[self.weight > 0])
        return [np.where(kinds == kind, TILE, 0.0) for kind in here]

    def _pose_columns(self, station: int) -> np.ndarray:
        """Columns (n, height, width) of one station's pose errors, scaled by their prior widths."""
        light, found = self.lights[station], []
        slant = 1 / np.maximum(np.cos(light.angle), 0.05)
        along, tilt = self.world.scene.pose_sigma
        for number, surface in enumerate(self.world.scene.surfaces):
            own = light.surface == number
            if not own.any():
                continue
            place = self.world.scene.places[station][surface.name]
            found.append(np.where(own, slant * along, 0.0))
            if surface.kind != "sphere":
                arm = np.nan_to_num(light.points - place.position) @ place.rotation[:, :2]
                found += [np.where(own, slant * arm[..., axis] * tilt, 0.0) for axis in (0, 1)]
        return np.stack(found) if found else np.zeros((1, *self.world.scene.shape))

    def columns(self, simulated: bool = True) -> dict[str, list[Sight]]:
        """Families of columns, by the name of the effect that they stand for."""
        if self._smooth is None:
            self._smooth = self._smooth_columns()
        if simulated and self._simulated is None:
            self._simulated = self._simulated_columns()
        return self._smooth | (self._simulated or {} if simulated else {})

    def _smooth_columns(self) -> dict[str, list[Sight]]:
        world = self.world
        amplitude = np.stack([np.maximum(light.amplitude, 1.0) for light in self.lights])
        distance = np.stack([light.distance for light in self.lights])
        x = np.stack([np.minimum(light.angle * GON, 90) / 50 for light in self.lights])
        setting = np.array(world.settings)
        phase = 2 * np.pi * distance / world.sensor.ambiguity
        each = [(setting == one)[:, None, None] for one in np.unique(setting)]
        everywhere = np.ones_like(distance)
        found = {
            "cyclic_error": [part(order * phase) for order in (4, 8) for part in (np.sin, np.cos)],
            "amplitude_offset": [own * (100 / amplitude) ** power for own in each for power in (1, 2)],
            "incidence_angle": [own * x**power for own in each for power in (1, 2, 3, 4)],
            "warm_up_drift": [
                everywhere * np.exp(-world.uptime / tau)[:, None, None]
                for tau in (30, 60, 150, 300, 600, 1500)
            ],
            "ambient_temperature": [
                everywhere * lagged(world.air_history, lag, world.uptime)[:, None, None]
                for lag in (1, 60, 150, 400, 1000)
            ],
            "distance_scale": [distance],
        }
        if len(each) > 1:
            found["integration_time_offset"] = [everywhere * own for own in each]
        silent = np.zeros_like(distance)
        out = {name: [Sight(one, silent) for one in parts] for name, parts in found.items()}
        rays = np.stack([light.points for light in self.lights])
        with np.errstate(invalid="ignore"):
            q = np.arccos(np.clip(rays[..., 2] / np.linalg.norm(rays, axis=-1), -1, 1)) ** 2
        out["emission_pattern"] = [Sight(silent, np.nan_to_num(q**power)) for power in (1, 2)]
        out["amplitude_nonlinearity"] = [Sight(silent, amplitude * 1e-3)]
        return out

    def _simulated_columns(self) -> dict[str, list[Sight]]:
        world, rng = self.world, np.random.default_rng(5)
        trials: dict[str, list[tuple[float, dict[str, object]]]] = {
            "camera_constant": [(0.003, {})],
            "lens_distortion": [
                (0.01, {"direction": tuple(np.eye(5)[i] * (1.0 if i < 2 else 0.05))}) for i in range(4)
            ],
            "scattering": [(0.02, {"radius": r, "exponent": 1.7}) for r in (2.0, 6.0)],
            "emitter_offset": [
                (0.05, {"lamps": [lamp]}) for lamp in ((1.0, 0, 0), (0, 1.0, 0), (-1.0, 0, 0))
            ],
        }
        if world.scene.style in ("corner", "room", "boxes"):
            trials["multipath"] = [(0.5, {})]
        found: dict[str, list[Sight]] = {}
        bare = replace(world, hidden={})
        before = self.sight if not world.hidden and not self.edges else observe(bare)
        for name, variants in trials.items():
            for strength, shape in variants:
                drawn = {**draw_shape(name, rng, (16, 60, 100)), **shape}
                after = observe(replace(bare, hidden={name: strength}, shape={name: drawn}))
                found.setdefault(name, []).append(after.minus(before, world.sensor.ambiguity))
        return found


def absorbed(
    vectors: list[np.ndarray], weight: np.ndarray, local: list[np.ndarray], pixel_sigma: float
) -> np.ndarray:
    """Gram matrix of `vectors` (stations, height, width) after one value per pixel and local columns.

    The pixel values have the prior `pixel_sigma`; local columns are scaled to a prior of 1.
    """
    stations, pixels = len(weight), weight[0].size
    w = weight.reshape(stations, pixels)
    z = np.stack([np.nan_to_num(one).reshape(stations, pixels) for one in vectors]) * w
    widths = [len(one) for one in local]
    starts = np.concatenate([[0], np.cumsum(widths)])
    n, k = len(vectors), int(starts[-1])
    own = np.zeros((n + k, n + k))
    cross = np.zeros((n + k, pixels))  # columns times the pixels' indicator
    own[:n, :n] = np.einsum("asp,bsp->ab", z, z, optimize=True)
    cross[:n] = np.einsum("asp,sp->ap", z, w, optimize=True)
    for s in range(stations):
        columns = local[s].reshape(widths[s], pixels) * w[s]
        at = slice(n + starts[s], n + starts[s + 1])
        own[at, at] = columns @ columns.T
        own[:n, at] = z[:, s] @ columns.T
        own[at, :n] = own[:n, at].T
        cross[at] = columns * w[s]
    own[n:, n:] += np.eye(k)
    inverse = 1 / ((w**2).sum(axis=0) + 1 / pixel_sigma**2)
    own -= (cross * inverse) @ cross.T
    reduced: np.ndarray = own[:n, :n] - own[:n, n:] @ np.linalg.solve(own[n:, n:], own[n:, :n])
    return reduced


def _left(gram: np.ndarray, index: list[int]) -> float:
    """Energy of the first column after projection on those of `index`."""
    if not index:
        return float(max(gram[0, 0], 0.0))
    inner = gram[np.ix_(index, index)]
    scale = 1 / np.sqrt(np.maximum(np.diag(inner), 1e-12))
    inner = inner * scale[:, None] * scale[None, :] + 1e-9 * np.eye(len(index))
    side = gram[0, index] * scale
    return float(max(gram[0, 0] - side @ np.linalg.solve(inner, side), 0.0))


def scaled_to(
    size: float, measure: Callable[[float], float], start: float, *, limit: float
) -> tuple[float, float]:
    """The strength whose effect has a size, by proportion, at most `limit`; and the size that it has."""
    strength, found = start, measure(start)
    for _ in range(4):
        if abs(found / size - 1) < 0.02:
            break
        strength = float(np.clip(strength * size / max(found, 1e-9), -limit, limit))
        found = measure(strength)
    return strength, found
