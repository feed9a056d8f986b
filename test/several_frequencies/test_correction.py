"""Several frequencies through the chain, against the scene's true distances and one frequency alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera, with_effects
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.emitter_offset import EmitterOffset
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Flag, Pose, RawFrame, Settings
from rim_camera_ros.measurement import measurement_of
from rim_camera_ros.pipeline.correct import Correction
from rim_camera_ros.pipeline.several_frequencies import ResolvedFrame, SeveralCorrections, SeveralSimulations
from rim_camera_ros.pipeline.simulate import Exposure, Simulation
from rim_camera_ros.scene import Scene, load_scene

CAMERA = """
format: rim_camera/1
device: three
sensor: {width: 40, height: 30, modulation_frequency: [80.0e6, 16.0e6, 120.0e6]}
optics: {fx: 60.0, fy: 60.0, cx: 19.2, cy: 14.6}
radiometry: {gain: 900.0, gain_sigma: 0.0, pattern_sigma: 0.0}
noise: {floor: 0.0, amplitude: [6.0, 20.0, 5.0]}
measurement: {type: several_frequencies, range: [0.3, 18.4]}
effects:
  cyclic_error:
  - harmonics: [{order: 4, amplitude: 0.004, phase: 0.4}]
  - harmonics: [{order: 4, amplitude: 0.031, phase: -0.9}, {order: 8, amplitude: 0.006, phase: 1.9}]
  - null
"""
SCENE = """
format: rim_scene/1
surfaces: [{name: wall, type: plane, pose: truth, reflectivity: 0.7}]
"""
#: Combined noise in metres times counts: inverse variances add up.
TOGETHER = (6.0**-2 + 20.0**-2 + 5.0**-2) ** -0.5


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return load_camera(tmp_path / "camera.yaml")


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "scene.yaml").write_text(SCENE)
    return load_scene(tmp_path / "scene.yaml")


def exposure(scene: Scene, z: float, time: float = 100.0) -> Exposure:
    poses = scene.poses_for({"wall": Pose((0.0, 0.0, z))})
    return Exposure(10**9, Settings(integration_time=time, uptime=5e4), poses)


def with_terms(camera: Camera, *terms: object) -> Camera:
    """The camera with further effects at every frequency."""
    more = {one.name: one for one in terms}  # type: ignore[attr-defined]
    channels = tuple(with_effects(one, {**one.effects, **more}) for one in camera.channels)
    return camera.measurement.camera_of(channels)


@pytest.mark.parametrize("z", [0.5, 1.9, 3.7, 6.2, 9.3, 11.1, 14.9])
def test_distances_from_half_a_metre_to_fifteen(camera: Camera, scene: Scene, z: float) -> None:
    """At the amplitude of 10 sigma of the coarsest frequency and more; sigma as the noise adds up."""
    # 16 MHz: sigma_d = 20 / A is L / (2 pi) / 10 = 0.149 m at 134 counts; here 200 counts
    given = exposure(scene, z, time=200.0 * z**2 / 900 / 0.7)
    simulation = SeveralSimulations(camera, scene, seed=3)
    truth = simulation.true_distance(given)
    found = SeveralCorrections(camera).correct(simulation.frame(given))
    assert isinstance(found, ResolvedFrame)
    valid = np.isfinite(found.distance)
    assert valid.mean() > 0.99
    error = (found.distance - truth)[valid]
    assert np.abs(error).max() < 0.3  # no wrong wrap: the nearest is 0.9 m away
    assert found.wrong_wrap[valid].max() < 0.01
    assert np.std(error / found.sigma[valid]) == pytest.approx(1.0, abs=0.08)
    assert np.abs(np.mean(error)) < 5 * TOGETHER / 150 / np.sqrt(error.size)
    middle = found.sigma[15, 19]
    assert middle == pytest.approx(TOGETHER / found.amplitude[15, 19], rel=0.35)


def test_one_frequency_alone_folds_and_is_less_precise(camera: Camera, scene: Scene) -> None:
    given = exposure(scene, 11.1, time=2000.0)
    several = SeveralSimulations(camera, scene, seed=3)
    truth = several.true_distance(given)
    frame = several.frame(given)
    found = SeveralCorrections(camera).correct(frame)
    alone = Correction(camera.channels[1]).correct(several.channels[1].frame(given))
    assert np.nanmean(alone.distance - truth) == pytest.approx(-299_792_458 / 32e6, abs=0.02)
    modulo = np.nanstd(alone.distance - truth)
    assert np.nanstd(found.distance - truth) == pytest.approx(modulo * TOGETHER / 20.0, rel=0.1)


def test_terms_that_need_the_distance_itself_see_it(camera: Camera, scene: Scene) -> None:
    """0.1 % of 14.2 m are 14 mm, of the 0.4 m that is left of them at 120 MHz 0.4 mm."""
    terms = (DistanceScale(0.001), EmitterOffset((0.03, -0.02, 0.01)))
    given = exposure(scene, 14.2, time=2000.0)
    bent = with_terms(camera, *terms)
    simulation = SeveralSimulations(bent, scene, noise=False, quantised=False)
    truth, frame = simulation.true_distance(given), simulation.frame(given)
    left = SeveralCorrections(bent, without=("distance_scale",)).correct(frame)
    found = SeveralCorrections(bent).correct(frame)
    # the cyclic errors are evaluated 15 mm away then
    assert np.allclose(left.distance - truth, 0.001 * truth, atol=1.5e-3)
    assert np.abs(found.distance - truth).max() < 1e-4


def test_close_odds_are_flagged_and_have_no_distance(camera: Camera, scene: Scene) -> None:
    given = exposure(scene, 9.0, time=60.0 * 9.0**2 / 900 / 0.7)  # 4.5 sigma
    simulation = SeveralSimulations(camera, scene, seed=5)
    truth, frame = simulation.true_distance(given), simulation.frame(given)
    found = SeveralCorrections(camera).correct(frame)
    assert isinstance(found, ResolvedFrame)
    ambiguous = (found.flags & Flag.AMBIGUOUS.value) != 0
    assert 0.05 < ambiguous.mean() < 0.95
    assert np.isnan(found.distance[ambiguous]).all()
    # within odds of 100 : 1 of two
    known = np.isfinite(found.wrong_wrap)
    assert np.array_equal(ambiguous[known], found.wrong_wrap[known] > 1 / 101)
    lax = replace(camera, measurement=replace(camera.measurement, odds=1.0))
    every = SeveralCorrections(lax).correct(frame)
    wrong = np.abs(every.distance - truth) > 0.4
    assert wrong[ambiguous].mean() > 10 * wrong[~ambiguous].mean()
    assert wrong[~ambiguous].mean() < 1 / 100


def test_frequencies_have_their_own_noise_and_the_same_power(camera: Camera, scene: Scene) -> None:
    unsteady = camera.measurement.camera_of(
        tuple(
            replace(one, effects={}, radiometry=replace(one.radiometry, gain_sigma=0.2))
            for one in camera.channels
        )
    )
    simulation = SeveralSimulations(unsteady, scene, seed=9)
    images = simulation.frame(exposure(scene, 2.0)).by_role
    power = [images[f"amplitude_{i}"].astype(float).mean() for i in range(3)]
    assert power[1] == pytest.approx(power[0], rel=2e-3)
    assert power[2] == pytest.approx(power[0], rel=2e-3)
    residual = [images[f"amplitude_{i}"] - images[f"amplitude_{i}"].astype(float).mean() for i in range(3)]
    steady = SeveralSimulations(unsteady, scene, noise=False).frame(exposure(scene, 2.0)).by_role
    for i in range(3):
        residual[i] = images[f"amplitude_{i}"] / steady[f"amplitude_{i}"]
    shared = np.corrcoef([one.ravel() for one in residual])[np.triu_indices(3, 1)]
    assert np.abs(shared).max() < 0.12


def test_a_resolved_recording_is_an_ordinary_one(camera: Camera, scene: Scene) -> None:
    resolved = camera.measurement.resolved(camera)
    assert dict(resolved.effects) == {}  # cyclic errors are by frequency
    given = exposure(scene, 12.4, time=2000.0)
    frame = Simulation(resolved, scene, seed=1).frame(given)
    found = SeveralCorrections(camera).correct(frame)
    truth = Simulation(resolved, scene).true_distance(given)
    assert not isinstance(found, ResolvedFrame)
    assert np.nanstd((found.distance - truth) / found.sigma) == pytest.approx(1.0, abs=0.08)


# --- bad input ----------------------------------------------------------------------------------


@pytest.fixture
def frame(camera: Camera, scene: Scene) -> RawFrame:
    return SeveralSimulations(camera, scene).frame(exposure(scene, 2.0))


def without(frame: RawFrame, *roles: str, extra: dict[str, str] | None = None) -> RawFrame:
    images = {role: image for role, image in frame.images.items() if role not in roles}
    settings = replace(frame.settings, extra=MappingProxyType(extra or {}))
    return replace(frame, images=images, settings=settings)


def test_a_frequency_without_its_images_is_refused(camera: Camera, frame: RawFrame) -> None:
    with pytest.raises(InputError, match=r"a frequency without its images: there is no amplitude_2"):
        SeveralCorrections(camera).correct(without(frame, "amplitude_2"))
    fewer = camera.measurement.camera_of(camera.channels[:2])
    with pytest.raises(InputError, match="the frame has distance_2, the camera file 2 frequencies"):
        SeveralCorrections(fewer).correct(without(frame))


def test_other_frequencies_are_refused(camera: Camera, frame: RawFrame) -> None:
    swapped = camera.measurement.camera_of((camera.channels[1], camera.channels[0], camera.channels[2]))
    with pytest.raises(InputError, match="recorded at 80 16 120 MHz, the camera file says 16 80 120 MHz"):
        SeveralCorrections(swapped).correct(frame)
    with pytest.raises(InputError, match="recorded at '80, 16' MHz"):
        SeveralCorrections(camera).correct(without(frame, extra={"modulation_frequencies": "80, 16"}))


def test_an_ordinary_camera_refuses_them(camera: Camera, frame: RawFrame) -> None:
    with pytest.raises(InputError, match="holds the images of several modulation frequencies"):
        Correction(camera.channels[0]).correct(frame)


def test_an_effect_that_the_file_lacks_cannot_be_excluded(camera: Camera) -> None:
    with pytest.raises(InputError, match="effect 'multipath' is not in the camera file"):
        measurement_of(camera).correction(camera, without=("multipath",))
