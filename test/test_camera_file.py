"""Camera files: what they say by default, by path, round trip; every shipped one."""

from __future__ import annotations

# ruff: noqa: E501 -- one fault a line
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Covariance, Noise, Optics, Radiometry, Sensor, Validity
from rim_camera_ros.camera_file import (
    camera_numbers,
    draw_parameters,
    load_camera,
    save_camera,
    with_effects,
    with_numbers,
)
from rim_camera_ros.effects import ORDER, registry
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.distance_scale import DistanceScale
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.warm_up_drift import WarmUpDrift
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.files import find_camera, find_scene, share_folder, shipped
from rim_camera_ros.fit.decimation import decimated_camera
from rim_camera_ros.frame import Settings
from rim_camera_ros.geometry import see
from rim_camera_ros.parameters import ArrayFile
from rim_camera_ros.scene import load_scene

TEXT = """\
format: rim_camera/1
sensor: {width: 12, height: 9, pixel_pitch: [40e-6, 50e-6], modulation_frequency: 20.0e6}
optics: {fx: 20, fy: 21.5, cx: 5.5, cy: 4}
"""


def load(tmp_path: Path, text: str) -> Camera:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    return load_camera(path)


def test_defaults(tmp_path: Path) -> None:
    """Of the format's description, and no effect is on."""
    camera = load(tmp_path, TEXT)
    sensor = camera.sensor
    assert (sensor.width, sensor.height, sensor.pixel_pitch) == (12, 9, (40e-6, 50e-6))
    assert (sensor.saturation, sensor.amplitude_threshold, sensor.exposure) == (65535, 0, (0.0002, 0.0002))
    assert sensor.integration_time is None
    assert camera.optics == Optics(20.0, 21.5, 5.5, 4.0, (0.0, 0.0, 0.0, 0.0, 0.0))
    assert (camera.radiometry.gain, camera.radiometry.gain_sigma) == (500, 0)
    assert camera.noise == Noise(0.0045, 0.0, 28.0)
    assert dict(camera.effects) == {}
    assert camera.validity == Validity()
    assert camera.covariance is None
    assert camera.shape == (9, 12)
    assert camera.rays.shape == (9, 12, 3)
    with pytest.raises(ValueError, match="read-only"):
        camera.rays[0, 0, 0] = 1


def test_counts_of_a_sensor() -> None:
    def sensor(lsb: float | None) -> Sensor:
        return Sensor(
            width=2, height=2, pixel_pitch=(1e-4, 1e-4), modulation_frequency=30e6, distance_lsb=lsb
        )

    ambiguity = 299792458 / 60e6
    assert sensor(None).ambiguity == pytest.approx(ambiguity)
    assert sensor(None).lsb == pytest.approx(ambiguity / 65536)
    assert sensor(None).wraps
    # 65536 lsb <= L (1 + 1e-6)
    assert sensor(ambiguity / 65536 * (1 + 9e-7)).wraps
    assert not sensor(ambiguity / 65536 * (1 + 2e-6)).wraps
    assert not sensor(0.001).wraps
    assert sensor(1e-5).wraps
    assert sensor(None).exposure_seconds(100.0) == pytest.approx(0.0202)


FAULTS = {
    "covariance of nothing": ("covariance: {parameters: [noise.floor, effects.cyclic_error.harmonics.0.amplitude], matrix: c2.npy}\n", r"camera\.yaml: covariance\.parameters\.1 \(line 4\): unknown parameter 'effects\.cyclic_error\.harmonics\.0\.amplitude'"),
    "covariance misspelt": ("covariance:\n  parameters:\n  - noise.floor\n  - noise.shott\n  matrix: c2.npy\n", r"covariance\.parameters\.1 \(line 7\): unknown parameter 'noise\.shott' \(did you mean 'noise\.shot'\?\)"),
    "covariance of the wrong size": ("covariance: {parameters: [noise.floor], matrix: c2.npy}\n", r"covariance \(line 4\): matrix has shape \(2, 2\), expected \(1, 1\)"),
    "covariance without matrix": ("covariance: {parameters: [noise.floor]}\n", r"covariance \(line 4\): key 'matrix' is missing"),
    "effects as a list": ("effects: [cyclic_error]\n", r"effects \(line 4\): expected a group of effects by name"),
    "lens_distortion": ("effects: {lens_distortion: {}}\n", r"effects\.lens_distortion \(line 4\): has no parameters here \(they belong to the section 'optics'\)"),
    "camera_constant": ("effects: {camera_constant: {}}\n", r"effects\.camera_constant .*section 'optics'"),
    "noise": ("effects: {noise: {floor: 0.1}}\n", r"effects\.noise .*section 'noise'"),
    "radiometry": ("effects: {radiometry: {}}\n", r"effects\.radiometry .*section 'radiometry'"),
    "effect without parameters": ("effects: {cyclic_error: }\n", r"effects\.cyclic_error \(line 4\): key 'harmonics' is missing"),
    "no harmonics": ("effects: {cyclic_error: {harmonics: []}}\n", r"effects\.cyclic_error \(line 4\): harmonics is empty: give at least one"),
    "order twice": ("effects:\n  cyclic_error:\n    harmonics: [{order: 4, amplitude: 0.1, phase: 0}, {order: 4, amplitude: 0.1, phase: 1}]\n", r"effects\.cyclic_error \(line 6\): harmonics: an order is given twice"),
    "half an order": ("effects: {cyclic_error: {harmonics: [{order: 4.5, amplitude: 0.1, phase: 0}]}}\n", r"effects\.cyclic_error\.harmonics\.0\.order \(line 4\): expected a whole number, found the number 4\.5"),
    "amplitude with a unit": ("effects: {cyclic_error: {harmonics: [{order: 4, amplitude: 8 cm, phase: 0}]}}\n", r"harmonics\.0\.amplitude \(line 4\): expected a number in m, found the text '8 cm'"),
    "no rows": ("effects: {integration_time_offset: {offset: {}}}\n", r"effects\.integration_time_offset \(line 4\): offset is empty: give one row, by integration time"),
    "no hyperbola": ("effects: {amplitude_offset: {hyperbola: {}}}\n", r"hyperbola is empty"),
    "row 0": ("effects: {amplitude_offset: {hyperbola: {0: {a: 1, b: 1}}}}\n", r"effects\.amplitude_offset\.hyperbola\.0 .*greater than 0"),
    "cubic": ("effects: {incidence_angle: {polynomial: {60: [1, 2, 3]}}}\n", r"effects\.incidence_angle\.polynomial\.60 \(line 4\): expected 4 values, found 3"),
    "time constant 0": ("effects: {warm_up_drift: {terms: [{amplitude: 0.1, time_constant: 0}]}}\n", r"warm_up_drift\.terms\.0\.time_constant .*greater than 0 s"),
    "no terms": ("effects: {warm_up_drift: {terms: []}}\n", r"terms is empty: give at least one"),
    "negative weight": ("effects: {scattering: {kernels: [{weight: -0.1, sigma: [3, 3]}]}}\n", r"scattering\.kernels\.0\.weight .*at least 0, found -0\.1"),
    "one sigma": ("effects: {scattering: {kernels: [{weight: 0.1, sigma: 3}]}}\n", r"scattering\.kernels\.0\.sigma \(line 4\): expected a list, found the number 3"),
    "strong ghost": ("effects: {scattering: {kernels: [{weight: 0.5, sigma: [3, 3]}], ghost: {weight: 0.3, shift: [1, 2]}}}\n", r"effects\.scattering \(line 4\): the ghost's weight 0\.3 must stay below"),
    "blur": ("effects: {mixed_pixels: {blur: 21}}\n", r"effects\.mixed_pixels\.blur .*at most 20 px, found 21"),
    "scale": ("effects: {distance_scale: {scale: 0.6}}\n", r"effects\.distance_scale\.scale .*at most 0\.5, found 0\.6"),
    "reference beside the sensor": ("effects: {reference_path: {nominal: 0.8, pixels: [10, 0, 12, 1]}}\n", r"effects\.reference_path \(line 4\): pixels \[10, 0, 12, 1\] do not lie within 12 x 9"),
    "knots": ("effects: {empirical: {covariates: [row], knots: [[1, 0]], values: [0, 0]}}\n", r"effects\.empirical \(line 4\): knots of row must be an increasing list"),
    "covariate": ("effects: {empirical: {covariates: [rows], knots: [[0, 1]], values: [0, 0]}}\n", r"effects\.empirical \(line 4\): unknown covariate 'rows' \(did you mean 'row'\?\)"),
    "table": ("effects: {integral_table: {knots: [[0, 11], [0, 8], [1, 2]], values: c2.npy}}\n", r"effects\.integral_table \(line 4\): values have shape \(2, 2\), expected \(2, 2, 2\) by the knots"),
    "validity upside down": ("validity: {distance: [5, 1]}\n", r"validity \(line 4\): distance: the first value must not exceed the second"),
    "region upside down": ("validity: {region: [5, 1, 3, 2]}\n", r"validity \(line 4\): region: expected u0 v0 u1 v1 with u0 <= u1 and v0 <= v1"),
    "gain": ("radiometry: {gain: 0}\n", r"radiometry\.gain .*greater than 0"),
    "gain sigma": ("radiometry: {gain_sigma: 1}\n", r"radiometry\.gain_sigma .*less than 1, found 1"),
    "minimum amplitude": ("minimum_amplitude: -1\n", r"minimum_amplitude \(line 4\): must be at least 0 counts, found -1"),
    "provenance": ("provenance: me\n", r"provenance \(line 4\): expected a group of keys"),
    "unknown section": ("nois: {floor: 0}\n", r"nois \(line 4\): unknown key \(did you mean 'noise'\?\)"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(tmp_path: Path, fault: str) -> None:
    text, match = FAULTS[fault]
    np.save(tmp_path / "c2.npy", np.eye(2))
    with pytest.raises(InputError, match=match):
        load(tmp_path, TEXT + text)


@pytest.mark.parametrize(
    ("before", "after", "match"),
    [
        ("width: 12", "width: 0", r"sensor\.width \(line 2\): must be at least 1 px, found 0"),
        ("[40e-6, 50e-6]", "[40e-6, 0]", r"sensor\.pixel_pitch\.1 \(line 2\): must be greater than 0 m, found 0"),
        ("20.0e6}", "20.0e6, distance_lsb: 0}", r"sensor\.distance_lsb .*greater than 0 m"),
        ("20.0e6}", "20.0e6, exposure: [0.1]}", r"sensor\.exposure .*expected 2 values, found 1"),
        ("20.0e6}", "20.0e6, exposure: [-0.1, 0]}", r"sensor\.exposure\.0 .*at least 0 s"),
        ("fx: 20", "fx: -20", r"optics\.fx \(line 3\): must be greater than 0 px, found -20"),
        ("cy: 4", "cy: 4, d: [0, 0, 0, 0]", r"optics\.d \(line 3\): expected 5 values, found 4"),
        ("cy: 4", "cy: .inf", r"optics\.cy \(line 3\): must be finite, found inf"),
        ("rim_camera/1", "rim_camera", r"format \(line 1\): not a camera file: format is 'rim_camera' \(expected format: rim_camera/1\)"),
        ("format: rim_camera/1\n", "", r"camera\.yaml: line 1: not a camera file: format is None"),
        (TEXT, "- 1\n", r"camera\.yaml: line 1: not a camera file \(expected format: rim_camera/1\)"),
        (TEXT, "", r"camera\.yaml: .*not a camera file"),
    ],
)  # fmt: skip
def test_faults_of_the_sensor_and_the_lens(tmp_path: Path, before: str, after: str, match: str) -> None:
    assert before in TEXT
    with pytest.raises(InputError, match=match):
        load(tmp_path, TEXT.replace(before, after))


def every_effect(tmp_path: Path) -> Camera:
    camera = load(tmp_path, TEXT)
    camera = with_effects(camera, {one.name: one.example(camera) for one in reversed(ORDER)})
    return replace(
        camera,
        device="one",
        minimum_amplitude=123.0,
        radiometry=Radiometry(321.5, 0.02),
        validity=Validity(distance=(0.5, 7.0), region=(1.0, 0.0, 9.0, 8.0)),
        covariance=Covariance(
            ("noise.floor", "effects.distance_scale.scale", "effects.amplitude_offset.hyperbola.60.b"),
            ArrayFile("c.npy", np.diag([1e-8, 1e-9, 0.01])),
        ),
        provenance={"recordings": [{"sha256": "ab"}], "n": 3},
    )


def test_round_trip_of_everything(tmp_path: Path) -> None:
    camera = every_effect(tmp_path)
    (tmp_path / "other").mkdir()
    path = tmp_path / "other" / "camera.yaml"
    save_camera(camera, path, comment="by test")
    again = load_camera(path)
    assert again == replace(camera, provenance=again.provenance)
    assert dict(again.provenance) == {"recordings": [{"sha256": "ab"}], "n": 3}
    assert camera_numbers(again) == camera_numbers(camera)
    assert path.read_text().startswith("# by test\nformat: rim_camera/1\n")
    assert sorted(p.name for p in path.parent.iterdir()) == [
        "c.npy",
        "camera.yaml",
        "fixed_pattern.npy",
        "integral_table.npy",
    ]


def test_effects_are_ordered_along_the_light(tmp_path: Path) -> None:
    assert list(every_effect(tmp_path).effects) == [one.name for one in ORDER]
    camera = load(
        tmp_path,
        TEXT + "effects: {distance_scale: {}, background_light: {level: 3}, multipath: {strength: 1}}\n",
    )
    assert list(camera.effects) == ["multipath", "background_light", "distance_scale"]
    assert camera.effects["distance_scale"] == DistanceScale(0.0)
    assert camera.background == 3.0


def test_numbers_by_path(tmp_path: Path) -> None:
    camera = every_effect(tmp_path)
    numbers = camera_numbers(camera)
    assert numbers["sensor.modulation_frequency"] == 20e6
    assert numbers["optics.d.4"] == 0.0
    assert numbers["effects.scattering.ghost.shift.1"] == camera.effects["scattering"].ghost.shift[1]
    assert numbers["effects.integration_time_offset.offset.16"] == -0.073
    changed = with_numbers(
        camera,
        {
            "noise.floor": 0.001,
            "effects.cyclic_error.harmonics.1.phase": 2.5,
            "effects.cyclic_error.gradient.0": 0.0,
        },
    )
    expected = {
        **numbers,
        "noise.floor": 0.001,
        "effects.cyclic_error.harmonics.1.phase": 2.5,
        "effects.cyclic_error.gradient.0": 0.0,
    }
    assert camera_numbers(changed) == expected
    for path in ("noise.flor", "nose.floor", "effects.cyclic.gradient.0", "effects.cyclic_error", "device"):
        with pytest.raises(KeyError):
            with_numbers(camera, {path: 1.0})
    with pytest.raises(InputError, match=r"effects\.emission_pattern: falloff must leave"):
        with_numbers(camera, {"effects.emission_pattern.falloff.0": -1e3})


def test_effects_that_do_not_fit(tmp_path: Path) -> None:
    camera = load(tmp_path, TEXT)
    with pytest.raises(InputError, match=r"unknown effect 'cyclic' \(did you mean 'cyclic_error'\?\)"):
        with_effects(camera, {"cyclic": DistanceScale(0.1)})
    small = FixedPatternOffset(ArrayFile("m.npy", np.zeros((12, 9))))
    with pytest.raises(
        InputError,
        match=r"effects\.fixed_pattern_offset: map 'm\.npy' has shape \(12, 9\), expected \(9, 12\)",
    ):
        with_effects(camera, {"fixed_pattern_offset": small})


def test_maps_in_a_folder_below(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "m.npy", np.full((9, 12), 0.25, np.float32))
    camera = load(tmp_path, TEXT + "effects: {fixed_pattern_offset: {map: maps/m.npy}}\n")
    (tmp_path / "out").mkdir()
    save_camera(camera, tmp_path / "out" / "camera.yaml")
    assert load_camera(tmp_path / "out" / "camera.yaml").effects == camera.effects
    with pytest.raises(RimError, match="cannot be written"):
        save_camera(camera, tmp_path / "none" / "camera.yaml")
    assert not (tmp_path / "none").exists()


def test_drawn_parameters_have_the_stated_covariance(tmp_path: Path) -> None:
    camera = every_effect(tmp_path)
    matrix = np.array([[4e-8, 1e-8, 0.0], [1e-8, 9e-8, -2e-5], [0.0, -2e-5, 0.01]])
    assert camera.covariance is not None
    names = camera.covariance.parameters
    camera = replace(camera, covariance=Covariance(names, ArrayFile("c.npy", matrix)))
    rng = np.random.default_rng(12)
    before = camera_numbers(camera)
    several = [camera_numbers(draw_parameters(camera, rng)) for _ in range(500)]
    drawn = np.array([[one[n] for n in names] for one in several])
    size = np.sqrt(np.diag(matrix))
    found = np.cov((drawn / size).T)
    # 500 draws: correlations to 0.045, variances to 6 %
    np.testing.assert_allclose(found, matrix / np.outer(size, size), atol=0.2)
    assert np.abs((drawn.mean(0) - [before[n] for n in names]) / size).max() < 4 / math.sqrt(500)
    with pytest.raises(InputError, match="covariance: the camera file states no covariance"):
        draw_parameters(replace(camera, covariance=None), rng)


@pytest.mark.parametrize(
    ("frame", "file", "expected"), [(60.0, None, 60.0), (None, 100.0, 100.0), (16.0, 100.0, 16.0)]
)
def test_integration_time(tmp_path: Path, frame: float | None, file: float | None, expected: float) -> None:
    camera = load(tmp_path, TEXT)
    camera = replace(camera, sensor=replace(camera.sensor, integration_time=file))
    assert camera.integration_time(Settings(integration_time=frame)) == expected


@pytest.mark.parametrize("value", [0.0, -3.0, math.nan])
def test_integration_time_that_is_none(tmp_path: Path, value: float) -> None:
    camera = load(tmp_path, TEXT)
    with pytest.raises(InputError, match=r"integration_time must be positive, found .* \(check frame_info\)"):
        camera.integration_time(Settings(integration_time=value))


# --- shipped files --------------------------------------------------------------------------------


#: width, height, pitch [m] (tables 2.2, 2.3, appendices A and C), fx, fy from the camera constant
SENSORS: dict[str, tuple[Any, ...]] = {
    "sr2": (160, 124, 39.2e-6, 54.8e-6, 7.656e-3),
    "sr3000": (176, 144, 40e-6, 40e-6, 7.9955e-3),
    "pmd768s": (32, 24, 210.8e-6, 155.3e-6, 8.0e-3),
    "pmd1ks2": (64, 16, 155.3e-6, 210.8e-6, 8.0e-3),
    "pmd3ks": (64, 48, 100e-6, 100e-6, 8.0e-3),
    "pmd19k": (160, 120, 40e-6, 40e-6, 8.0e-3),
}

#: Table 2.3: fill factor [%], dynamic range [dB], its increase by suppression of background light [dB]
PMD = {
    "pmd768s": (42.0, 78.0, 50.0),
    "pmd1ks2": (42.0, 78.0, 50.0),
    "pmd3ks": (32.0, 74.0, 50.0),
    "pmd19k": (31.0, 65.0, 0.0),
}


@pytest.mark.parametrize("name", [*SENSORS, "sr3000_every_effect"])
def test_shipped_cameras(name: str, tmp_path: Path) -> None:
    assert name in shipped("calibration")
    camera = load_camera(find_camera(name))
    assert np.isfinite(camera.rays).all()
    assert camera.covariance is not None
    matrix = camera.covariance.matrix.values
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > 0
    for effect in camera.effects.values():
        bounds = effect.bounds()
        for path, value in camera_numbers(replace(camera, effects={effect.name: effect})).items():
            key = path.removeprefix(f"effects.{effect.name}.")
            if key in bounds and path.startswith("effects."):
                assert bounds[key][0] <= value <= bounds[key][1], path
    save_camera(camera, tmp_path / "again.yaml")
    assert camera_numbers(load_camera(tmp_path / "again.yaml")) == camera_numbers(camera)


def test_every_effect_is_in_the_shipped_demonstration() -> None:
    """Those that have their own file aside."""
    assert set(load_camera(find_camera("sr3000_every_effect")).effects) == set(registry())


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_of_the_thesis(name: str) -> None:
    camera = load_camera(find_camera(name))
    width, height, pitch_u, pitch_v, constant = SENSORS[name]
    assert (camera.sensor.width, camera.sensor.height) == (width, height)
    assert camera.sensor.pixel_pitch == pytest.approx((pitch_u, pitch_v))
    assert camera.optics.fx == pytest.approx(constant / pitch_u, rel=1e-6)
    assert camera.optics.fy == pytest.approx(constant / pitch_v, rel=1e-6)
    assert camera.sensor.ambiguity == pytest.approx(7.49481, abs=1e-5)


@pytest.mark.parametrize("name", PMD)
def test_pmd_sensors_of_table_2_3(name: str) -> None:
    camera = load_camera(find_camera(name))
    fill, dynamic_range, suppression = PMD[name]
    assert camera.sensor.background_suppression == suppression
    in_the_dark = 2 * np.pi / 7.49481145 * camera.noise.amplitude
    assert 20 * np.log10(camera.sensor.saturation / in_the_dark) == pytest.approx(dynamic_range, abs=0.001)
    assert camera.radiometry.gain == pytest.approx(2000.0 * fill / 32.0, rel=1e-9)
    # eq. 2.8 with B = A: a full well of 1e6 electrons per 100 x 100 um
    pitch = camera.sensor.pixel_pitch
    assert pitch is not None
    electrons = 1e6 * pitch[0] * pitch[1] / 1e-8 / 65535.0
    assert camera.noise.shot == pytest.approx(7.49481145 / np.sqrt(8) / 2 / np.sqrt(electrons), rel=1e-3)


def test_lens_of_the_sr3000_to_first_order() -> None:
    """k1 = -K1 c^2, p1 = -P2 c, p2 = -P1 c."""
    k1, _, p1, p2, _ = load_camera(find_camera("sr3000")).optics.d
    assert k1 == pytest.approx(-0.106, abs=0.004)
    assert p1 == pytest.approx(0.00115, abs=1.5e-4)
    assert p2 == pytest.approx(-0.00254, abs=2.5e-4)


def test_tables_3_4_and_3_5_are_in_the_shipped_camera() -> None:
    effects = load_camera(find_camera("sr3000")).effects
    found = {key: (row.a, row.b) for key, row in effects["amplitude_offset"].hyperbola.items()}
    assert found == {16: (85.71, 0.995), 60: (237.0, 15.71), 100: (383.3, 4.036)}
    assert dict(effects["incidence_angle"].polynomial) == {
        16: (5.768e-9, -4.555e-7, 9.834e-6, 5.655e-4),
        60: (4.122e-9, -1.806e-7, 1.757e-6, 2.996e-4),
        100: (3.065e-9, -1.691e-7, 4.899e-6, 2.817e-4),
    }


def test_cyclic_error_of_the_sr2() -> None:
    """Fig. 3.45: +-8 cm, offset about 30 cm."""
    effects = load_camera(find_camera("sr2")).effects
    cyclic = effects["cyclic_error"]
    assert isinstance(cyclic, CyclicError)
    assert cyclic.harmonics[0] == Harmonic(4, 0.08, cyclic.harmonics[0].phase)
    assert effects["integration_time_offset"].offset[100] == pytest.approx(0.3)
    assert isinstance(effects["warm_up_drift"], WarmUpDrift)


@pytest.mark.parametrize("name", ["wall", "board", "corner", "room", "track_line"])
def test_shipped_scenes(name: str) -> None:
    assert name in shipped("config")
    scene = load_scene(find_scene(name))
    rays = load_camera(find_camera("sr3000")).rays[::4, ::4]
    poses = {**scene.fixed_poses()}
    for station in scene.schedule:
        poses.update({n: one.pose for n, one in station.poses.items()})
        if set(poses) == {one.name for one in scene.surfaces}:
            assert see(scene, poses, rays).hit.mean() > 0.02


def test_shipped_arrays_are_what_their_script_makes() -> None:
    script = share_folder() / "calibration" / "tools" / "make_shipped_arrays.py"
    done = subprocess.run(
        [sys.executable, str(script), "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all as this script makes them" in done.stdout


def test_pixel_pitch_need_not_be_known(tmp_path: Path) -> None:
    without = TEXT.replace("pixel_pitch: [40e-6, 50e-6], ", "")
    assert without != TEXT
    camera = load(tmp_path, without)
    assert camera.sensor.pixel_pitch is None
    assert decimated_camera(camera, 2).sensor.pixel_pitch is None
    assert decimated_camera(load(tmp_path, TEXT), 2).sensor.pixel_pitch == pytest.approx((80e-6, 100e-6))
    save_camera(camera, tmp_path / "again.yaml")
    assert "pixel_pitch" not in (tmp_path / "again.yaml").read_text()
    assert load_camera(tmp_path / "again.yaml") == camera
