"""How effects combine, are read out and are corrected: the rules of the camera file, number by number."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

from rim_camera_ros.camera import Camera, Noise, Optics, Radiometry, Sensor, Validity
from rim_camera_ros.camera_file import draw_parameters, load_camera, with_effects
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.background_light import BackgroundLight
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.incidence_angle import IncidenceAngle
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.effects.interference import Interference
from rim_camera_ros.effects.mixed_pixels import MixedPixels
from rim_camera_ros.effects.reference_path import ReferencePath
from rim_camera_ros.effects.saturation_bleed import SaturationBleed
from rim_camera_ros.effects.scattering import Ghost, Kernel, Scattering
from rim_camera_ros.effects.warm_up_drift import Exponential, WarmUpDrift
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera
from rim_camera_ros.frame import Flag, Pose, RawFrame, Settings
from rim_camera_ros.phasor import Waveform
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, ScenePose, Surface

L = 299792458.0 / 40e6
SETTINGS = Settings(integration_time=60.0, uptime=100.0, ambient_temperature=20.0)


def camera(**sensor: Any) -> Camera:
    return Camera(
        sensor=Sensor(width=40, height=30, pixel_pitch=(1e-4, 1e-4), modulation_frequency=20e6, **sensor),
        optics=Optics(fx=50.0, fy=48.0, cx=19.2, cy=15.1),
        noise=Noise(floor=0.003, shot=0.0, amplitude=15.0),
    )


def wall(z: float = 2.5, reflectivity: float = 0.7) -> Scene:
    pose = ScenePose((0.0, 0.0, z))
    return Scene(surfaces=(Surface(name="wall", type="plane", pose=pose, reflectivity=reflectivity),))


def simulate(cam: Camera, scene: Scene, *, station: int = 0, stamp: int = 10**9, **options: Any) -> RawFrame:
    settings = options.pop("settings", SETTINGS)
    simulation = Simulation(cam, scene, **options)
    return simulation.frame(
        Exposure(stamp=stamp, settings=settings, poses=scene.fixed_poses(), station=station)
    )


def exact(cam: Camera, scene: Scene, **options: Any) -> RawFrame:
    return simulate(cam, scene, noise=False, quantised=False, **options)


def test_radiometry_and_distance() -> None:
    """Amplitude = gain * integration_time * reflectivity * cos(incidence) / distance^2."""
    cam = replace(camera(), radiometry=Radiometry(gain=321.0))
    frame = exact(cam, wall())
    cosine = cam.rays[..., 2]
    np.testing.assert_allclose(frame.distance, 2.5 / cosine, rtol=1e-12)
    np.testing.assert_allclose(frame.amplitude, 321.0 * 60 * 0.7 * cosine / (2.5 / cosine) ** 2, rtol=1e-12)


def test_terms_are_evaluated_at_the_delivered_light_and_add_up() -> None:
    """Not one after the other: each sees the distance and amplitude without the others."""
    cyclic = CyclicError((Harmonic(4, 0.05, 0.4), Harmonic(8, 0.01, -0.7)), (0.002, -0.001))
    offset = AmplitudeOffset(MappingProxyType({60.0: Hyperbola(237.0, 15.71)}))
    scale = DistanceScale(0.01)
    cam = with_effects(
        camera(), {"cyclic_error": cyclic, "amplitude_offset": offset, "distance_scale": scale}
    )
    frame, plain = exact(cam, wall()), exact(camera(), wall())
    d, a = plain.distance, plain.amplitude
    v, u = np.mgrid[:30, :40]
    psi = 0.002 * (u - 19.2) - 0.001 * (v - 15.1)
    expected = (
        d
        + 0.05 * np.sin(4 * 2 * np.pi * d / L + 0.4 + psi)
        + 0.01 * np.sin(8 * 2 * np.pi * d / L - 0.7 + psi)
    )
    expected += 237.0 / (a - 15.71) + 0.01 * d
    np.testing.assert_allclose(frame.distance, expected, atol=1e-12)


def test_scattering_by_its_definition() -> None:
    """Against a plain sum over pixels, with the direct light's period."""
    effect = Scattering((Kernel(0.12, (5.0, 3.0)), Kernel(0.06, (1.1, 20.0))), Ghost(0.01, (3.0, -2.0)))
    near = Surface(name="near", type="rectangle", size=(0.4, 0.3), pose=ScenePose((0.2, 0.1, 0.8)))
    scene = Scene(surfaces=(*wall(8.9).surfaces, near))
    cam = camera()
    plain = Simulation(cam, scene, noise=False)
    exposure = Exposure(stamp=10**9, settings=SETTINGS, poses=scene.fixed_poses())
    light = plain.signal(plain.context(exposure))
    s = light.amplitude * np.exp(2j * np.pi * light.distance / L)
    expected = (1 - 0.12 - 0.06 - 0.01) * s
    k = np.arange(-400, 401)
    for weight, su, sv in ((0.12, 5.0, 3.0), (0.06, 1.1, 20.0)):
        gu, gv = (np.exp(-0.5 * (k / x) ** 2) / np.exp(-0.5 * (k / x) ** 2).sum() for x in (su, sv))
        for i in range(30):
            for j in range(40):
                kernel = np.outer(gv[np.arange(30) - i + 400], gu[np.arange(40) - j + 400])
                expected[i, j] += weight * (kernel * s).sum()
    ghost = np.zeros_like(s)
    ghost[:-2, 3:] = s[2:, :-3]
    expected += 0.01 * ghost
    simulation = Simulation(with_effects(cam, {"scattering": effect}), scene, noise=False)
    found = simulation.signal(simulation.context(exposure))
    np.testing.assert_allclose(found.amplitude, np.abs(expected), rtol=1e-9)
    phase = np.angle(expected) / (2 * np.pi) * L
    phase += L * np.rint((light.distance - phase) / L)
    np.testing.assert_allclose(found.distance, phase, atol=1e-9)
    assert found.distance.max() > L


def test_mixed_pixels_are_a_gaussian_of_the_complex_image() -> None:
    near = Surface(name="near", type="rectangle", size=(0.4, 0.3), pose=ScenePose((0.2, 0.1, 0.8)))
    scene = Scene(surfaces=(*wall().surfaces, near))
    plain, mixed = (
        exact(camera(), scene),
        exact(with_effects(camera(), {"mixed_pixels": MixedPixels(0.8)}), scene),
    )
    s = plain.amplitude * np.exp(2j * np.pi * plain.distance / L)
    blurred = scipy.ndimage.gaussian_filter(s.real, 0.8) + 1j * scipy.ndimage.gaussian_filter(s.imag, 0.8)
    np.testing.assert_allclose(mixed.amplitude, np.abs(blurred), rtol=1e-4)
    between = (mixed.distance > 0.9) & (mixed.distance < 2.4)
    assert between.any()
    flags = (
        Correction(camera()).correct(replace(mixed, amplitude=mixed.amplitude, distance=mixed.distance)).flags
    )
    found = (flags & Flag.MIXED_PIXEL.value) > 0
    assert found[between].mean() > 0.6
    assert not found[:5].any()


class TestReadOut:
    def test_wrapping_camera(self) -> None:
        """Modulo L first; a count of 0 becomes 1."""
        lsb = L / 65536
        frame = simulate(camera(), wall(L + 0.3), noise=False)
        cosine = camera().rays[..., 2]
        expected = np.rint(((L + 0.3) / cosine % L) / lsb)
        np.testing.assert_array_equal(frame.distance, np.maximum(expected, 1))
        middle = replace(camera(), optics=Optics(fx=50.0, fy=48.0, cx=19.0, cy=15.0))
        assert simulate(middle, wall(L + 1e-6), noise=False).distance[15, 19] == 1
        assert simulate(middle, wall(L - 1e-6), noise=False).distance[15, 19] == 1

    def test_camera_that_resolves_its_ambiguity(self) -> None:
        """No wrap; counts outside 1 .. 65535 are 0."""
        cam = camera(distance_lsb=0.001)
        assert not cam.sensor.wraps
        frame = simulate(cam, wall(11.0), noise=False)
        assert frame.distance[15, 19] == 11000
        assert (simulate(cam, wall(66.0, 0.9), noise=False).distance == 0).all()

    def test_threshold_and_saturation(self) -> None:
        bright = exact(camera(), wall()).amplitude
        middle = float(np.median(bright))
        frame = simulate(camera(amplitude_threshold=middle), wall(), noise=False)
        below = np.rint(bright) < middle
        assert below.any()
        assert (frame.amplitude[below] == 0).all()
        assert (frame.distance[below] == 0).all()
        assert (frame.distance[~below] > 0).all()
        frame = simulate(camera(saturation=int(middle)), wall(), noise=False)
        assert frame.amplitude.max() == int(middle)
        flags = Correction(camera(saturation=int(middle))).correct(frame).flags
        np.testing.assert_array_equal((flags & Flag.SATURATED.value) > 0, np.rint(bright) >= int(middle))

    def test_no_measurement_below_the_pole(self) -> None:
        dark = exact(camera(), wall()).amplitude
        pole = float(np.median(dark)) - 1.0
        effect = AmplitudeOffset(MappingProxyType({1.0: Hyperbola(5.0, pole)}))
        frame = simulate(with_effects(camera(), {"amplitude_offset": effect}), wall(), noise=False)
        np.testing.assert_array_equal(frame.distance == 0, dark <= pole + 1)


class TestNoise:
    def frames(self, cam: Camera, n: int = 400) -> tuple[np.ndarray, np.ndarray]:
        simulation = Simulation(cam, wall(), seed=8)
        exposures = [
            Exposure(stamp=10**9 + i, settings=SETTINGS, poses=wall().fixed_poses()) for i in range(n)
        ]
        frames = [simulation.frame(one) for one in exposures]
        return np.array([f.distance for f in frames]) * cam.sensor.lsb, np.array(
            [f.amplitude for f in frames]
        ) * 1.0

    def test_sigma_and_independence(self) -> None:
        """sigma_d^2 = floor^2 + (amplitude / A)^2, sigma_A = 2 pi A sigma_d / L, both independent."""
        cam = camera()
        distance, amplitude = self.frames(cam)
        a = exact(cam, wall()).amplitude
        sigma_d = np.sqrt(0.003**2 + (15.0 / a) ** 2)
        # 400 x 1200 values: the ratio of variances is known to 0.2 %
        ratio = (distance.var(axis=0, ddof=1) / sigma_d**2).mean()
        assert ratio == pytest.approx(1.0, abs=0.01)
        sigma_a = 2 * np.pi / L * a * sigma_d
        ratio = ((amplitude.var(axis=0, ddof=1) - 1 / 12) / sigma_a**2).mean()
        assert ratio == pytest.approx(1.0, abs=0.01)
        d = (distance - distance.mean(axis=0)) / distance.std(axis=0)
        b = (amplitude - amplitude.mean(axis=0)) / amplitude.std(axis=0)
        assert abs((d * b).mean()) < 0.005
        assert abs((d[1:] * d[:-1]).mean()) < 0.005
        assert abs((d[:, :, 1:] * d[:, :, :-1]).mean()) < 0.005

    def test_background_adds_photon_noise(self) -> None:
        """The variance gains shot^2 * level / A^2."""
        cam = replace(camera(), noise=Noise(floor=0.0, shot=0.5, amplitude=0.0))
        lit = with_effects(cam, {"background_light": BackgroundLight(level=30000.0)})
        a = exact(cam, wall()).amplitude
        for one, variance in ((cam, 0.25 / a), (lit, 0.25 / a + 0.25 * 30000.0 / a**2)):
            distance, _ = self.frames(one)
            assert (distance.var(axis=0, ddof=1) / variance).mean() == pytest.approx(1.0, abs=0.01)

    @pytest.mark.parametrize(
        ("suppression", "takes"), [(None, 1e12), (0.0, 65535.0), (50.0, 65535.0 * 316.227766)]
    )
    def test_unmodulated_light_fills_pixels_beyond_its_suppression(
        self, suppression: float | None, takes: float
    ) -> None:
        """A pixel takes (saturation - A) * 10^(suppression / 20) of it, 50 dB being a factor of 316."""
        cam = camera(background_suppression=suppression)
        amplitude = exact(cam, wall()).amplitude
        room = (65535.0 - float(amplitude[3, 5])) / 65535.0
        for share, saturated in ((0.9999, False), (1.0001, suppression is not None)):
            lit = with_effects(cam, {"background_light": BackgroundLight(level=takes * room * share)})
            frame = exact(lit, wall())
            assert (frame.amplitude[3, 5] == 65535.0) == saturated
            flagged = Correction(lit).correct(simulate(lit, wall(), noise=False)).flags[3, 5]
            assert bool(flagged & Flag.SATURATED) == saturated
            if not saturated:
                assert frame.amplitude[3, 5] == pytest.approx(amplitude[3, 5], rel=1e-12)

    def test_pixels_that_unmodulated_light_fills_bleed(self) -> None:
        """The pixel that sees most light fills first; its row measures 21 mm less, its column 8 mm."""
        cam, scene = camera(background_suppression=20.0), wall()
        quiet = exact(cam, scene)
        v, u = np.unravel_index(np.argmax(quiet.amplitude), quiet.amplitude.shape)
        second = np.sort(quiet.amplitude.ravel())[-2:]
        level = 10.0 * (65535.0 - float(second.mean()))
        effects = {
            "background_light": BackgroundLight(level=level),
            "saturation_bleed": SaturationBleed(row=-0.021, column=-0.008),
        }
        shift = exact(with_effects(cam, effects), scene).distance - quiet.distance
        expected = np.zeros(shift.shape)
        expected[v, :], expected[:, u], expected[v, u] = -0.021, -0.008, 0.0
        np.testing.assert_allclose(shift, expected, atol=1e-9)

    def test_seed_and_emitted_power(self) -> None:
        cam = replace(camera(), radiometry=Radiometry(gain_sigma=0.05))
        same = [simulate(cam, wall(), seed=3).distance for _ in range(2)]
        np.testing.assert_array_equal(*same)
        assert (simulate(cam, wall(), seed=4).distance != same[0]).any()
        power = [Simulation(cam, wall(), seed=3).power(i) for i in range(2000)]
        assert np.std(power) == pytest.approx(0.05, rel=0.06)
        assert Simulation(cam, wall(), seed=3).power(7) == power[7]

    def test_interference_is_one_phase_per_frame(self) -> None:
        """Amplitude times the envelope of eq. 2.11: 1 / (pi df T_w)."""
        cam = replace(camera(), noise=Noise(floor=0.0, shot=0.0, amplitude=0.0))
        cam = with_effects(cam, {"interference": Interference(frequency=20e6 + 700.0, amplitude=90.0)})
        plain = exact(camera(), wall())
        s = plain.amplitude * np.exp(2j * np.pi * plain.distance / L)
        window = 0.0002 + 0.0002 * 60
        simulation = Simulation(cam, wall(), seed=2, noise=False, quantised=False)
        phases = []
        for i in range(20):
            frame = simulation.frame(Exposure(stamp=10**9 + i, settings=SETTINGS, poses=wall().fixed_poses()))
            added = frame.amplitude * np.exp(2j * np.pi * frame.distance / L) - s
            np.testing.assert_allclose(np.abs(added), 90.0 / (np.pi * 700.0 * window), rtol=1e-6)
            phases.append(np.angle(added[0, 0]))
            np.testing.assert_allclose(np.angle(added / added[0, 0]), 0, atol=1e-6)
        assert np.std(phases) > 1


class TestRows:
    def measured(self, time: float | None) -> float:
        rows = MappingProxyType({16.0: -0.1, 60.0: 0.02, 100.0: 0.3})
        cam = with_effects(camera(), {"integration_time_offset": IntegrationTimeOffset(rows)})
        frame = exact(cam, wall(), settings=Settings(integration_time=time))
        return float(frame.distance[15, 19] - exact(camera(), wall()).distance[15, 19])

    @pytest.mark.parametrize(
        ("time", "expected"), [(16, -0.1), (60, 0.02), (80, 0.16), (27, -0.07), (4, -0.1), (200, 0.3)]
    )
    def test_interpolation(self, time: float, expected: float) -> None:
        assert self.measured(time) == pytest.approx(expected, abs=1e-12)

    def test_the_term_is_interpolated_not_the_parameters(self) -> None:
        rows = MappingProxyType({16.0: Hyperbola(85.71, 0.995), 60.0: Hyperbola(237.0, 15.71)})
        cam = with_effects(camera(), {"amplitude_offset": AmplitudeOffset(rows)})
        settings = Settings(integration_time=38.0)
        a = exact(camera(), wall(), settings=settings).amplitude
        d = exact(camera(), wall(), settings=settings).distance
        expected = d + 0.5 * 85.71 / (a - 0.995) + 0.5 * 237.0 / (a - 15.71)
        np.testing.assert_allclose(exact(cam, wall(), settings=settings).distance, expected, atol=1e-12)

    def test_outside_the_rows_is_flagged(self) -> None:
        rows = MappingProxyType({16.0: -0.1, 60.0: 0.02})
        cam = with_effects(camera(), {"integration_time_offset": IntegrationTimeOffset(rows)})
        bit = Flag.OUTSIDE_CALIBRATION.value
        for time, outside in ((16.0, False), (40.0, False), (61.0, True), (10.0, True)):
            frame = simulate(cam, wall(), settings=Settings(integration_time=time))
            assert bool((Correction(cam).correct(frame).flags & bit).any()) == outside

    def test_unknown_setting(self) -> None:
        rows = MappingProxyType({16.0: -0.1, 60.0: 0.02})
        cam = with_effects(camera(), {"integration_time_offset": IntegrationTimeOffset(rows)})
        frame = replace(simulate(cam, wall()), settings=Settings())
        with pytest.raises(InputError, match=r"no integration_time .*give sensor\.integration_time"):
            Correction(cam).correct(frame)
        known = replace(cam, sensor=replace(cam.sensor, integration_time=60.0))
        assert np.isfinite(Correction(known).correct(frame).distance).all()
        single = with_effects(
            camera(), {"integration_time_offset": IntegrationTimeOffset(MappingProxyType({16.0: -0.1}))}
        )
        assert np.isfinite(Correction(single).correct(frame).distance).all()


def test_default_minimum_amplitude() -> None:
    """Where |d term / dA| sigma_A = sigma_d, i.e. a / (A - b)^2 * 2 pi A / L = 1."""
    a, b = 237.0, 15.71
    cam = with_effects(
        camera(), {"amplitude_offset": AmplitudeOffset(MappingProxyType({60.0: Hyperbola(a, b)}))}
    )
    k = a * 2 * np.pi / L
    root = (2 * b + k + np.sqrt((2 * b + k) ** 2 - 4 * b * b)) / 2
    assert Correction(cam).minimum_for(SETTINGS) == pytest.approx(root, abs=1.0)
    assert Correction(cam, minimum_amplitude=50.0).minimum_for(SETTINGS) == 50.0
    assert Correction(camera()).minimum_for(SETTINGS) == 0.0
    dark = simulate(cam, wall(reflectivity=0.03))
    corrected = Correction(cam).correct(dark)
    low = dark.amplitude < Correction(cam).minimum_for(SETTINGS)
    assert low.any()
    np.testing.assert_array_equal((corrected.flags & Flag.LOW_AMPLITUDE.value) > 0, low)
    assert np.isnan(corrected.distance[low]).all()


def test_sigma_is_that_of_the_corrected_distances() -> None:
    """Of repeated frames, with the amplitude term's noise and undoing stray light."""
    effects = {
        "amplitude_offset": AmplitudeOffset(MappingProxyType({60.0: Hyperbola(237.0, 15.71)})),
        "amplitude_nonlinearity": AmplitudeNonlinearity(2e-5),
        "scattering": Scattering((Kernel(0.2, (8.0, 6.0)),)),
    }
    for names in (("amplitude_offset", "amplitude_nonlinearity"), ("scattering",), tuple(effects)):
        cam = with_effects(camera(), {name: effects[name] for name in names})
        simulation = Simulation(cam, wall(reflectivity=0.2), seed=6)
        correction = Correction(cam)
        found = []
        for i in range(300):
            exposure = Exposure(stamp=10**9 + i, settings=SETTINGS, poses=wall().fixed_poses())
            found.append(correction.correct(simulation.frame(exposure)))
        inner = (slice(4, -4), slice(4, -4))
        spread = np.std([one.distance for one in found], axis=0, ddof=1)[inner]
        predicted = np.mean([one.sigma for one in found], axis=0)[inner]
        assert (spread / predicted).mean() == pytest.approx(1.0, abs=0.05), names


class TestReferencePath:
    def camera(self, **reference: Any) -> Camera:
        return with_effects(
            camera(),
            {
                "warm_up_drift": WarmUpDrift((Exponential(-0.08, 60.0),)),
                "reference_path": ReferencePath(nominal=0.85, scale=0.8, **reference),
            },
        )

    @pytest.mark.parametrize("pixels", [(36, 0, 38, 1), None])
    def test_the_reading_replaces_a_wrong_drift(self, pixels: tuple[int, int, int, int] | None) -> None:
        """The correction does not know the drift, but the reference does."""
        simulated = self.camera(pixels=pixels)
        frame = exact(simulated, wall(), settings=replace(SETTINGS, uptime=20.0))
        drift = -0.08 * np.exp(-20 / 60)
        assert frame.settings.reference_distance == pytest.approx(0.85 + drift / 0.8, abs=1e-9)
        wrong = with_effects(
            simulated, {**simulated.effects, "warm_up_drift": WarmUpDrift((Exponential(0.5, 1000.0),))}
        )
        corrected = Correction(wrong, exact=True).correct(frame)
        usable = np.isfinite(corrected.distance)
        truth = exact(camera(), wall()).distance
        np.testing.assert_allclose(corrected.distance[usable], truth[usable], atol=1e-6)
        if pixels is not None:
            assert (corrected.flags[0:2, 36:39] & Flag.NO_MEASUREMENT.value).all()

    def test_without_a_reading_the_drift_terms_hold(self) -> None:
        simulated = self.camera(pixels=None)
        frame = exact(simulated, wall(), settings=replace(SETTINGS, uptime=20.0))
        frame = replace(frame, settings=replace(frame.settings, reference_distance=None))
        corrected = Correction(simulated, exact=True).correct(frame)
        np.testing.assert_allclose(corrected.distance, exact(camera(), wall()).distance, atol=1e-6)


def test_validity_is_flagged() -> None:
    cam = replace(
        camera(),
        validity=Validity(distance=(2.6, 5.0), temperature=(0.0, 30.0), region=(5.0, 3.0, 30.0, 20.0)),
    )
    frame = exact(camera(), wall())
    flags = Correction(cam).correct(frame).flags & Flag.OUTSIDE_CALIBRATION.value
    v, u = np.mgrid[:30, :40]
    inside = (u >= 5) & (u <= 30) & (v >= 3) & (v <= 20)
    np.testing.assert_array_equal(flags > 0, ~inside | (frame.distance < 2.6))
    hot = replace(frame, settings=replace(SETTINGS, ambient_temperature=31.0))
    assert (Correction(cam).correct(hot).flags & Flag.OUTSIDE_CALIBRATION.value).all()


def test_the_cyclic_error_emerges_from_the_waveform() -> None:
    """A third harmonic eps at sample level is a cyclic error of order 4: -eps L / 2 pi sin(4 phi)."""
    epsilon = 0.02
    cam = camera()
    frames = {
        name: exact(cam, wall(), waveform=waveform)
        for name, waveform in (
            ("sinusoid", Waveform.sinusoid()),
            ("third", Waveform(((3, epsilon),))),
            ("even", Waveform(((2, 0.3), (4, 0.2j), (6, -0.1)))),
        )
    }
    plain = exact(cam, wall()).distance
    np.testing.assert_allclose(frames["sinusoid"].distance, plain, atol=1e-12)
    np.testing.assert_allclose(frames["even"].distance, plain, atol=1e-12)
    closed = CyclicError((Harmonic(4, epsilon * L / (2 * np.pi), np.pi),))
    expected = exact(with_effects(cam, {"cyclic_error": closed}), wall()).distance
    difference = np.abs(frames["third"].distance - expected).max()
    # equal to first order: what is left is eps^2 / 2 L / 2 pi
    assert difference < 1.5 * epsilon**2 * L / (2 * np.pi)
    assert np.abs(expected - plain).max() > 0.01


@pytest.mark.parametrize(("time", "share"), [(16.0, 0.25), (60.0, 0.09), (100.0, 0.14)])
def test_amplitude_and_incidence_cancel_as_the_thesis_says(time: float, share: float) -> None:
    """Tables 3.4 and 3.5 with amplitude ~ cos, 0-60 gon at 2.5 m (sec. 3.3.6)."""
    shipped = load_camera(find_camera("sr3000"))
    hyperbola, incidence = shipped.effects["amplitude_offset"], shipped.effects["incidence_angle"]
    assert isinstance(hyperbola, AmplitudeOffset)
    assert isinstance(incidence, IncidenceAngle)
    gon = np.linspace(0, 60, 121)
    best = []
    for gain in np.linspace(420, 460, 9):
        amplitude = gain * time * np.cos(gon * np.pi / 200) / 2.5**2
        row = hyperbola.hyperbola[time]
        term = row.a / (amplitude - row.b)
        term -= term[0]
        a1, a2, a3, a4 = incidence.polynomial[time]
        angle = -(a1 * gon**4 + a2 * gon**3 + a3 * gon**2 + a4 * gon)
        best.append(np.sqrt(np.mean((term + angle) ** 2)) / np.sqrt(np.mean(angle**2)))
    assert min(best) == pytest.approx(share, abs=0.05)


def test_noise_of_table_3_3() -> None:
    """Sigma of one distance at about 2.6 m: c / sqrt 2 of the table's Gaussians."""
    cam = load_camera(find_camera("sr3000"))
    for time, distance, expected in ((16, 2.557, 26.4), (60, 2.621, 8.67), (100, 2.630, 6.17)):
        amplitude = np.array([cam.radiometry.gain * time * 0.88 / distance**2])
        assert cam.noise.sigma_distance(amplitude)[0] * 1e3 == pytest.approx(expected, rel=0.05)


def test_drawn_parameters_stay_near() -> None:
    cam = load_camera(find_camera("sr3000_every_effect"))
    drawn = draw_parameters(cam, np.random.default_rng(1))
    assert drawn.effects != cam.effects
    assert drawn.optics == cam.optics


def test_a_frame_of_another_pose() -> None:
    """A simulation keeps what it has seen by pose, not by name."""
    simulation = Simulation(camera(), wall(), noise=False, quantised=False)
    for z in (2.0, 3.0, 2.0):
        exposure = Exposure(stamp=10**9, settings=SETTINGS, poses={"wall": Pose((0.0, 0.0, z))})
        assert simulation.frame(exposure).distance[15, 19] == pytest.approx(z, rel=1e-3)
