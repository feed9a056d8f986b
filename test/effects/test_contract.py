"""What every effect owes, over ORDER: to be undone, fitted, written, and to survive bad pixels."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Optics, Sensor
from rim_camera_ros.camera_file import load_camera, save_camera, with_effects
from rim_camera_ros.effects import ORDER, SECTIONS, Effect
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.frame import Flag, RawFrame, Settings
from rim_camera_ros.parameters import NestedList, flatten, with_values
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import CameraMotion, Scene, ScenePose, Surface, Texture

VOCABULARY = {
    "cyclic_error", "amplitude_offset", "incidence_angle", "integration_time_offset", "fixed_pattern_offset",
    "warm_up_drift", "ambient_temperature", "distance_scale", "scattering", "emitter_offset",
    "emission_pattern", "mixed_pixels", "saturation_bleed", "multipath", "background_light", "interference",
    "motion", "amplitude_nonlinearity", "reference_path", "integral_table", "empirical", "lens_distortion",
    "camera_constant", "noise", "radiometry",
}  # fmt: skip

#: Effects without derivative columns, and why.
WITHOUT_COLUMNS = {
    "interference": "acts through the variance: its phase is random",
    "fixed_pattern_offset": "a map: its column is the pixel",
    "integral_table": "a table: its columns are the interpolation weights",
    "empirical": "a table: its columns are the interpolation weights",
    "reference_path": "replaces the drift terms and moves no pixel of the scene",
}

SETTINGS = Settings(
    integration_time=72.0,
    modulation_frequency=20e6,
    uptime=95.0,
    body_temperature=31.0,
    ambient_temperature=24.5,
)


def camera(width: int = 41, height: int = 33) -> Camera:
    """A distorted lens before an odd-sized array, without noise floor to speak of."""
    return Camera(
        sensor=Sensor(width=width, height=height, pixel_pitch=(1.6e-4, 1.6e-4), modulation_frequency=20e6),
        optics=Optics(
            fx=49.0, fy=51.0, cx=width / 2 - 1.3, cy=height / 2 + 0.7, d=(-0.11, 0.05, 0.0011, -0.0023, 0.0)
        ),
        device="contract",
        minimum_amplitude=0.0,
    )


def tilted_board() -> Scene:
    """One tilted plane with dark and bright tiles, at 1.3 .. 2.6 m."""
    values = np.array([[0.9, 0.2, 0.55], [0.3, 0.75, 0.12]])
    return Scene(
        surfaces=(
            Surface(
                name="board",
                type="plane",
                pose=ScenePose(
                    (0.05, -0.1, 1.9), (0.21, -0.17, 0.03, float(np.sqrt(1 - 0.21**2 - 0.17**2 - 0.03**2)))
                ),
                texture=Texture(cell=(0.31, 0.23), values=NestedList(values)),
            ),
        )
    )


def room() -> Scene:
    """The board, and a bright near plate before it."""
    plate = Surface(
        name="plate", type="rectangle", size=(0.3, 0.22), reflectivity=0.85, pose=ScenePose((-0.15, 0.1, 0.9))
    )
    return Scene(surfaces=(*tilted_board().surfaces, plate))


def corner() -> Scene:
    """Two walls that light each other, at a right angle before the camera."""
    return Scene(
        surfaces=(
            Surface(
                name="left", type="plane", pose=ScenePose((0.0, 0.0, 2.0), (0.0, -0.38268, 0.0, 0.92388))
            ),
            Surface(
                name="right", type="plane", pose=ScenePose((0.0, 0.0, 2.0), (0.0, 0.38268, 0.0, 0.92388))
            ),
        )
    )


def scene_for(kind: type[Effect]) -> Scene:
    """A scene in which an effect shows: only walls that face each other light each other."""
    return corner() if kind.name == "multipath" else room()


def frame_of(scene: Scene, cam: Camera, **settings: Any) -> tuple[Simulation, Exposure, RawFrame]:
    simulation = Simulation(cam, scene, seed=5, noise=False, quantised=False)
    exposure = Exposure(stamp=10**18, settings=replace(SETTINGS, **settings), poses=scene.fixed_poses())
    return simulation, exposure, simulation.frame(exposure)


def lit(cam: Camera, scene: Scene) -> tuple[Signal, Context]:
    """The ideal signal of a scene, and its context with saturated pixels."""
    simulation = Simulation(cam, scene, seed=5)
    exposure = Exposure(stamp=10**18, settings=SETTINGS, poses=scene.fixed_poses())
    context = simulation.context(exposure)
    assert context.geometry is not None
    assert context.geometry_at is not None
    saturated = np.zeros(cam.shape, bool)
    saturated[cam.shape[0] // 3, cam.shape[1] // 4] = True
    context.saturated = saturated
    return Signal(context.geometry.distance, context.geometry_at(0.0)[1]), context


def test_the_vocabulary_is_complete() -> None:
    names = [one.name for one in ORDER]
    assert len(names) == len(set(names))
    # light that describes unknown physics, and is no name
    assert set(names) | set(SECTIONS) == VOCABULARY | {"added_light"}


@pytest.mark.parametrize("kind", ORDER, ids=lambda one: one.name)
class TestEffect:
    def test_says_what_it_is(self, kind: type[Effect]) -> None:
        effect = kind.example(camera())
        for text in (kind.title, kind.observable, kind.refuted_by, effect.sentence()):
            assert len(text) > 10
            assert text == text.strip()
        assert any(c.isdigit() for c in effect.sentence())
        bounds, priors = effect.bounds(), effect.priors()
        assert set(bounds) == set(flatten(effect))
        for path, value in flatten(effect).items():
            assert bounds[path][0] <= value <= bounds[path][1]
        assert all(size > 0 for size in priors.values())

    def test_the_finest_form_is_one_of_the_same_effect(self, kind: type[Effect]) -> None:
        effect = kind.example(camera())
        finest = effect.finest()
        assert type(finest) is kind
        assert finest.finest() == finest
        assert (finest == effect) == (kind.name != "mixed_pixels")

    def test_does_something(self, kind: type[Effect]) -> None:
        cam = camera()
        scene = scene_for(kind)
        scene = replace(scene, camera_motion=CameraMotion((0.3, 0.0, 0.4), (0.0, 0.1, 0.0)))
        signal, context = lit(cam, scene)
        after = kind.example(cam).simulate(signal, context)
        if kind.name == "reference_path":
            return
        moved = np.nanmax(np.abs(after.measured - signal.measured))
        brighter = np.nanmax(np.abs(after.published_amplitude / signal.published_amplitude - 1))
        assert moved > 5e-4 or brighter > 1e-3

    def test_correct_undoes_simulate(self, kind: type[Effect]) -> None:
        """By itself, on the signal: to 1e-5 m where it declares to be exact."""
        cam = camera()
        effect = kind.example(cam)
        signal, context = lit(cam, scene_for(kind))
        after = effect.simulate(signal, context)
        back = effect.correct(
            Signal(after.measured % context.ambiguity, after.amplitude, published=after.published), context
        )
        usable = np.isfinite(after.measured) & (context.saturated == False)  # noqa: E712
        error = np.abs(back.distance - signal.distance)[usable]
        if kind.undo in ("exact", "planes", "partial"):
            assert error.max() < 1e-5
            if kind.name not in ("emitter_offset",):
                np.testing.assert_allclose(back.amplitude[usable], signal.amplitude[usable], rtol=1e-5)

    @pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
    def test_the_pipeline_undoes_it(self, kind: type[Effect], exact: bool) -> None:
        """Through the whole correction, which has only the frame: 0.01 mm; incidence on planes 1 mm."""
        cam = with_effects(camera(), {kind.name: kind.example(camera())})
        scene = tilted_board()
        simulation, exposure, frame = frame_of(scene, cam)
        corrected = Correction(cam, exact=exact).correct(frame)
        truth = simulation.true_distance(exposure)
        usable = np.isfinite(corrected.distance)
        assert usable.mean() > 0.9
        error = np.abs(corrected.distance - truth)
        if kind.undo == "planes":
            # the fast path estimates the angle once, from distances that still hold the term
            steep = simulation.geometry(exposure.poses).incidence > np.radians(54)
            inner = np.zeros_like(steep)
            inner[4:-4, 4:-4] = True
            assert error[inner & (exact | ~steep)].max() < 1e-3
            assert error[inner].max() < 2e-3
        elif kind.undo in ("exact", "partial"):
            assert error[usable].max() < 1e-5
        else:
            assert np.isfinite(error[usable]).all()

    def test_columns_are_finite_differences(self, kind: type[Effect]) -> None:
        cam = camera()
        effect = kind.example(cam)
        scene = replace(scene_for(kind), camera_motion=CameraMotion((0.3, 0.0, 0.4), (0.0, 0.1, 0.0)))
        signal, context = lit(cam, scene)
        if kind.name in WITHOUT_COLUMNS:
            assert effect.columns(signal, context) == {}
            return
        # a temperature that has changed, so that the lag's derivative is not zero
        context.memory.clear()
        columns = self._columns(effect, signal, context)
        assert set(columns) == set(flatten(effect))
        for path, (by_distance, by_amplitude) in columns.items():
            value = flatten(effect)[path]
            step = 1e-6 * max(abs(value), 1e-3)
            upper = self._after(with_values(effect, {path: value + step}), signal, context)
            lower = self._after(with_values(effect, {path: value - step}), signal, context)
            for column, high, low in (
                (by_distance, upper.measured, lower.measured),
                (by_amplitude, upper.published_amplitude, lower.published_amplitude),
            ):
                difference = (high - low) / (2 * step)
                column = np.broadcast_to(column, difference.shape)
                usable = np.isfinite(difference) & np.isfinite(column)
                scale = max(np.abs(difference[usable]).max(), 1e-6)
                limit = 2e-2 if kind.name == "motion" else 2e-4
                assert np.abs(column - difference)[usable].max() <= limit * scale, path

    def test_only_what_remembers_touches_the_memory(self, kind: type[Effect]) -> None:
        """Others may be computed for several stations at once."""
        cam = camera()
        effect = kind.example(cam)
        signal, context = lit(cam, scene_for(kind))
        context = replace(context, memory={})
        effect.simulate(signal, context)
        effect.columns(signal, context)
        assert bool(context.memory) == kind.remembers

    @staticmethod
    def _warm(effect: Effect, signal: Signal, context: Context) -> Context:
        """A context 200 s after one that was 6 degrees colder."""
        context = replace(context, memory={})
        if effect.name == "ambient_temperature":
            before = replace(context, stamp=context.stamp - 200 * 10**9)
            before.settings = replace(before.settings, ambient_temperature=18.5)
            effect.simulate(signal, before)
        return context

    def _columns(self, effect: Effect, signal: Signal, context: Context) -> dict[str, Any]:
        return effect.columns(signal, self._warm(effect, signal, context))

    def _after(self, effect: Effect, signal: Signal, context: Context) -> Signal:
        return effect.simulate(signal, self._warm(effect, signal, context))

    def test_a_fit_recovers_the_parameters(self, kind: type[Effect]) -> None:
        """One Gauss-Newton step from nearby, on noisy data: within the predicted sigma."""
        if kind.name in WITHOUT_COLUMNS or kind.name == "motion":
            pytest.skip(
                "no columns to fit with" if kind.name != "motion" else "the camera rests in this scene"
            )
        cam = camera()
        true = kind.example(cam)
        rng = np.random.default_rng(3)
        signal, context = lit(cam, scene_for(kind))
        start = with_values(true, {path: value * 1.0005 for path, value in flatten(true).items()})
        sigma_d, sigma_a = 1e-5, 1e-5 * signal.amplitude
        data = self._after(true, signal, context)
        model = self._after(start, signal, context)
        columns = self._columns(start, signal, context)
        design, residual = [], []
        for part, (measured, modelled, sigma) in enumerate(
            (
                (data.measured, model.measured, sigma_d),
                (data.published_amplitude, model.published_amplitude, sigma_a),
            )
        ):
            noisy = measured + sigma * rng.standard_normal(measured.shape)
            rows = [np.broadcast_to(columns[p][part], measured.shape) / sigma for p in columns]
            usable = np.isfinite(noisy) & np.all([np.isfinite(one) for one in rows], axis=0)
            design.append(np.stack([one[usable] for one in rows], axis=-1))
            residual.append(((noisy - modelled) / sigma)[usable])
        a, b = np.concatenate(design), np.concatenate(residual)
        seen = np.linalg.norm(a, axis=0) > 0
        scale = np.where(seen, np.linalg.norm(a, axis=0), 1.0)
        u, s, vt = np.linalg.svd(a[:, seen] / scale[seen], full_matrices=False)
        known = s > 1e-5 * s[0]
        # in the directions that the data determine, where each combination is normal with sigma 1 / s
        found = (u.T @ b)[known] / s[known]
        names = np.array(list(columns))[seen]
        wanted = np.array([flatten(true)[n] - flatten(start)[n] for n in names]) * scale[seen]
        score = ((found - (vt @ wanted)[known]) * s[known]) ** 2
        assert known.any()
        assert score.max() < 25

    def test_yaml_round_trip(self, kind: type[Effect], tmp_path: Path) -> None:
        cam = with_effects(camera(), {kind.name: kind.example(camera())})
        save_camera(cam, tmp_path / "camera.yaml")
        again = load_camera(tmp_path / "camera.yaml")
        assert again.effects[kind.name] == cam.effects[kind.name]
        save_camera(again, tmp_path / "again.yaml")
        assert (tmp_path / "again.yaml").read_text() == (tmp_path / "camera.yaml").read_text()

    @pytest.mark.parametrize("shape", [(33, 41), (1, 1), (1, 7), (9, 1), (4, 4), (5, 6)], ids=str)
    def test_bad_pixels_and_any_shape(self, kind: type[Effect], shape: tuple[int, int]) -> None:
        """NaN, no light, saturation: no exception, no warning, flags."""
        cam = camera(shape[1], shape[0])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            cam = with_effects(cam, {kind.name: self._fitting(kind, cam)})
            rng = np.random.default_rng(1)
            distance = rng.integers(0, 65536, shape).astype(np.uint16)
            amplitude = rng.integers(0, 65536, shape).astype(np.uint16)
            distance.ravel()[::3] = 0
            amplitude.ravel()[::4] = 0
            amplitude.ravel()[1::5] = 65535
            for exact in (False, True):
                correction = Correction(cam, exact=exact)
                frame = RawFrame(stamp=10**18, distance=distance, amplitude=amplitude, settings=SETTINGS)
                one = correction.correct(frame)
                assert one.distance.shape == shape
                assert (one.flags[distance == 0] & Flag.NO_MEASUREMENT.value).all()
                assert (one.flags[amplitude == 65535] & Flag.SATURATED.value).all()
                assert np.isnan(one.distance[(distance == 0) | (amplitude == 0) | (amplitude == 65535)]).all()
                metres = np.where(distance == 0, np.nan, distance * cam.sensor.lsb)
                floats = replace(frame, distance=metres, amplitude=amplitude.astype(float))
                assert correction.correct(floats).distance.shape == shape

    @staticmethod
    def _fitting(kind: type[Effect], cam: Camera) -> Effect:
        if kind.name == "reference_path":
            return replace(kind.example(camera()), pixels=(0, 0, 0, 0))  # type: ignore[type-var]
        return kind.example(cam if kind.name == "fixed_pattern_offset" else camera())


@pytest.mark.parametrize("exact", [True, False], ids=["exact", "fast"])
def test_all_that_can_be_undone_together(exact: bool) -> None:
    names = {one.name for one in ORDER if one.undo == "exact"}
    effects = {one.name: one.example(camera()) for one in ORDER if one.name in names}
    cam = with_effects(camera(), effects)
    simulation, exposure, frame = frame_of(tilted_board(), cam)
    corrected = Correction(cam, exact=exact).correct(frame)
    usable = np.isfinite(corrected.distance)
    error = np.abs(corrected.distance - simulation.true_distance(exposure))[usable]
    assert usable.mean() > 0.9
    assert error.max() < 1e-5
    raw = np.abs(frame.distance - simulation.true_distance(exposure))[usable]
    assert np.median(raw) > 0.02


def test_no_effect_no_change() -> None:
    """The null: without effects the corrected distance is the raw one, to float32."""
    simulation, exposure, frame = frame_of(tilted_board(), camera())
    corrected = Correction(camera()).correct(frame)
    np.testing.assert_allclose(corrected.distance, simulation.true_distance(exposure), atol=5e-7)


def test_the_core_does_not_need_ros_or_matplotlib() -> None:
    code = (
        "import sys\n"
        "for name in ('rclpy', 'matplotlib', 'sensor_msgs'):\n"
        "    sys.modules[name] = None\n"
        "import rim_camera_ros.cli, rim_camera_ros.pipeline.correct, rim_camera_ros.devices.timeline\n"
        "from rim_camera_ros.effects import registry\n"
        "print(len(registry()))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= len(ORDER)
