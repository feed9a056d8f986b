"""The calibration of simulated recordings: parameters within their sigma, what is determined, parts of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from scipy.stats import chi2

from rim_camera_ros.calibrate.provenance import checksum
from rim_camera_ros.calibrate.recordings import Cancelled
from rim_camera_ros.calibrate.run import Calibration, Request, calibrate
from rim_camera_ros.calibrate.solution import high_correlations, shrink
from rim_camera_ros.calibrate.validity import region
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset, Hyperbola
from rim_camera_ros.effects.cyclic_error import CyclicError, Harmonic
from rim_camera_ros.effects.fixed_pattern_offset import FixedPatternOffset
from rim_camera_ros.effects.integration_time_offset import IntegrationTimeOffset
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.noise import fit_noise
from rim_camera_ros.fit.pose_errors import pose_error_ratios, with_wider_poses
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.noise import Noise
from rim_camera_ros.parameters import ArrayFile

from .bags import frames, write
from .helpers import camera, record, scene


def effects(*, cyclic: float, phase: float, a: float, offset: float) -> tuple[CyclicError, AmplitudeOffset]:
    return (
        CyclicError((Harmonic(4, cyclic, phase),)),
        AmplitudeOffset(MappingProxyType({t: Hyperbola(a * t / 60, 1.2) for t in (16.0, 60.0, 100.0)})),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("calibration")


@pytest.fixture(scope="module")
def truth(folder: Path) -> Camera:
    plain = camera(folder, *effects(cyclic=0.013, phase=0.9, a=22.0, offset=0.0))
    rng = np.random.default_rng(5)
    v, u = np.mgrid[:36, :44]
    pattern = 0.004 * np.sin(u / 9.0) + 0.003 * (v / 36) + 0.002 * rng.standard_normal((36, 44))
    pattern_effect = FixedPatternOffset(ArrayFile("pattern.npy", pattern.astype(np.float32)))
    return with_effects(plain, {**plain.effects, "fixed_pattern_offset": pattern_effect})


@pytest.fixture(scope="module")
def bag(folder: Path, truth: Camera) -> Path:
    return write(folder / "bag", frames(truth, scene(folder), seed=3))


@pytest.fixture(scope="module")
def given(folder: Path) -> Camera:
    """What the calibration starts from: other numbers, a noise model that is too good."""
    start = camera(folder, *effects(cyclic=0.009, phase=0.5, a=15.0, offset=0.0))
    return replace(start, noise=Noise(floor=0.002, shot=0.0, amplitude=4.0))


@pytest.fixture(scope="module")
def result(folder: Path, bag: Path, given: Camera) -> Calibration:
    return calibrate(Request((bag,), given, scene(folder)))


def test_parameters_are_recovered_within_their_sigma(result: Calibration, truth: Camera) -> None:
    true, found, sigma = camera_numbers(truth), camera_numbers(result.camera), result.sigma
    assert result.found == []
    known = [p for p in result.paths if p.startswith("effects.") and p in true]
    assert len(known) >= 8
    z = np.array([(found[p] - true[p]) / sigma[p] for p in known])
    assert np.abs(z).max() < 4.0
    assert np.sum(z**2) < chi2.ppf(0.999, len(z))
    # far more than the prior says
    assert sigma["effects.cyclic_error.harmonics.0.amplitude"] < 0.0003
    assert abs(found["effects.cyclic_error.harmonics.0.amplitude"] - 0.013) < 0.001
    assert result.camera.radiometry.gain == pytest.approx(120.0, rel=0.02)


def test_held_out_poses_are_down_to_the_noise(result: Calibration) -> None:
    assert result.chi_square == pytest.approx(1.0, abs=0.08)
    one = result.accuracy
    assert one.held_out
    assert one.poses == 20
    assert one.after < 0.8 * one.before
    # dark pixels scatter by more than the slope of a / (A - b) says
    assert 0.98 * one.noise < one.after < 1.2 * np.hypot(one.noise, one.reference)
    assert one.systematic < 0.0015


def test_the_fixed_pattern_becomes_a_map(result: Calibration, truth: Camera) -> None:
    true = truth.effects["fixed_pattern_offset"].map.values
    found = result.camera.effects["fixed_pattern_offset"].map.values
    difference = found - true
    # a common offset is shared with the terms of distance and amplitude
    rest = difference - np.median(difference)
    assert np.std(true) > 0.0035
    assert np.sqrt(np.median(rest**2)) / 0.6745 < 0.0012


def test_noise_comes_from_repeated_frames(result: Calibration, truth: Camera) -> None:
    assert result.noise is not None
    assert not result.noise.confirmed
    amplitude = np.array([150.0, 500.0, 2000.0, 8000.0])
    found = result.camera.noise.sigma_distance(amplitude)
    np.testing.assert_allclose(found, truth.noise.sigma_distance(amplitude), rtol=0.03)


def test_a_true_noise_model_is_confirmed(folder: Path, truth: Camera) -> None:
    fitted = fit_noise(record(truth, scene(folder), seed=2), truth)
    assert fitted is not None
    assert fitted.confirmed
    assert fitted.noise == truth.noise
    assert fitted.misfit < 0.05


def test_without_repeated_frames_the_noise_stays(folder: Path, truth: Camera) -> None:
    assert fit_noise(record(truth, scene(folder), frames=1, poses=4), truth) is None


def test_validity_is_what_the_data_support(result: Calibration) -> None:
    limits = result.camera.validity
    assert limits.integration_time == (16.0, 100.0)
    assert limits.distance is not None
    assert 0.4 < limits.distance[0] < 0.9
    assert 3.5 < limits.distance[1] < 6.5
    assert limits.temperature == (16.0, 24.0)
    assert limits.region == (0.0, 0.0, 43.0, 35.0)


def test_region_is_where_half_the_pixels_are_seen() -> None:
    seen = np.zeros((10, 14), bool)
    seen[2:7, 3:12] = True
    seen[0, 0] = True
    assert region(seen) == (3.0, 2.0, 11.0, 6.0)
    assert region(np.zeros((4, 5), bool)) is None


def test_the_rest_is_absent_or_undetermined(result: Calibration) -> None:
    said = {one.effect: one for one in result.statuses}
    assert said["cyclic_error"].status == said["amplitude_offset"].status == "fitted"
    assert said["warm_up_drift"].status == "absent"
    assert said["warm_up_drift"].bound is not None
    assert said["warm_up_drift"].bound < 0.003
    assert said["saturation_bleed"].status == "undetermined"
    assert "no pixel of the recordings is saturated" in said["saturation_bleed"].text
    assert "record: a retro-reflective target" in said["saturation_bleed"].text
    assert said["motion"].status == "undetermined"


def test_the_bound_of_an_absent_effect_holds(folder: Path, given: Camera, truth: Camera) -> None:
    """An effect far above the bound of its absence is found instead."""
    drift = IntegrationTimeOffset(MappingProxyType({16.0: -0.012, 60.0: 0.0, 100.0: 0.003}))
    other = with_effects(truth, {**truth.effects, drift.name: drift})
    path = write(folder / "offset_bag", frames(other, scene(folder), seed=8))
    found = calibrate(Request((path,), given, scene(folder)), integral=False)
    assert found.found == ["integration_time_offset"]
    offset = found.camera.effects["integration_time_offset"].offset
    sigma = found.sigma["effects.integration_time_offset.offset.16"]
    assert offset[16.0] - offset[60.0] == pytest.approx(-0.012, abs=4 * sigma)
    assert found.chi_square == pytest.approx(1.0, abs=0.08)


def test_the_table_by_position_is_compared(result: Calibration) -> None:
    table = result.integral_accuracy
    assert table is not None
    # nearly the same pixels: each leaves out what disagrees with itself
    assert table.values == pytest.approx(result.accuracy.values, rel=0.02)
    # it removes most of the cyclic error, and cannot follow the amplitude
    assert table.after < result.accuracy.raw
    assert table.systematic > 2 * result.accuracy.systematic


@pytest.mark.long
def test_a_table_by_position_describes_errors_by_position(folder: Path, given: Camera) -> None:
    plain = camera(folder, CyclicError((Harmonic(4, 0.02, 0.4),)))
    path = write(folder / "cyclic_bag", frames(plain, scene(folder), poses=40, repeats=2, seed=6))
    start = with_effects(given, {})
    found = calibrate(Request((path,), start, scene(folder), effects=("integral_table",)))
    assert found.integral
    assert found.paths == []
    assert set(found.camera.effects) == {"integral_table", "fixed_pattern_offset"}
    assert found.integral_accuracy is not None
    assert found.integral_accuracy.before > 0.012
    assert found.integral_accuracy.systematic < 0.004
    table = found.camera.effects["integral_table"]
    middle = np.linspace(1.0, 4.0, 50)
    context_free = np.interp(middle, table.knots[2], table.values.values[4, 3])
    pattern = np.median(found.camera.effects["fixed_pattern_offset"].map.values)
    true = 0.02 * np.sin(4 * 2 * np.pi * middle / plain.sensor.ambiguity + 0.4)
    assert np.std(context_free + pattern - true) < 0.004


def test_exactly_the_effects_that_are_requested(
    folder: Path, bag: Path, given: Camera, truth: Camera
) -> None:
    start = with_effects(given, {"amplitude_offset": given.effects["amplitude_offset"]})
    asked = ("cyclic_error", "amplitude_offset")
    found = calibrate(Request((bag,), start, scene(folder), effects=asked), integral=False)
    assert {p.split(".")[1] for p in found.paths if p.startswith("effects.")} == set(asked)
    assert found.found == ["cyclic_error"]
    harmonic = found.camera.effects["cyclic_error"].harmonics[0]
    sigma = found.sigma["effects.cyclic_error.harmonics.0.amplitude"]
    assert harmonic.order == 4
    assert harmonic.amplitude == pytest.approx(0.013, abs=4 * sigma)


def test_effects_that_are_not_requested_stay(folder: Path, bag: Path, given: Camera, truth: Camera) -> None:
    found = calibrate(Request((bag,), given, scene(folder), effects=("amplitude_offset",)), integral=False)
    assert found.camera.effects["cyclic_error"] == given.effects["cyclic_error"]
    said = {one.effect: one.text for one in found.statuses}
    assert said["cyclic_error"] == "as in the file: not among --effects"
    assert found.chi_square is not None
    # the cyclic error of the file is not the true one: with the true one it is 0.97
    assert found.chi_square > 1.02


def test_a_smooth_function_of_amplitude(folder: Path, bag: Path, given: Camera, truth: Camera) -> None:
    start = with_effects(truth, {"cyclic_error": truth.effects["cyclic_error"]})
    asked = ("cyclic_error", "empirical:amplitude")
    found = calibrate(Request((bag,), start, scene(folder), effects=asked), integral=False)
    smooth = found.camera.effects["empirical"]
    knots, values = np.asarray(smooth.knots[0]), np.asarray(smooth.values.values)
    # settings differ in a, so that the curve lies between theirs
    low, high = (a / (knots - 1.2) for a in (22.0 * 16 / 60, 22.0 * 100 / 60))
    level = values - values[-1]
    # the darkest knots bridge the steepest part of the curve by a straight line
    middle = slice(2, -2)
    assert np.all(level[middle] > low[middle] - low[-1] - 0.003)
    assert np.all(level[middle] < high[middle] - high[-1] + 0.003)


@pytest.mark.long
def test_effects_without_overlap_with_the_data(folder: Path, bag: Path, given: Camera) -> None:
    match = r"--effects: saturation_bleed cannot be determined.*no pixel of the recordings is saturated"
    with pytest.raises(InputError, match=match):
        calibrate(Request((bag,), given, scene(folder), effects=("saturation_bleed",)))
    found = calibrate(
        Request((bag,), given, scene(folder), effects=("cyclic_error", "saturation_bleed")), integral=False
    )
    assert any("saturation_bleed cannot be determined" in note for note in found.notes)
    assert "saturation_bleed" not in found.camera.effects


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("cyclic_eror",), r"--effects: unknown effect 'cyclic_eror' \(did you mean 'cyclic_error'\?\)"),
        (("interference",), r"interference is not estimated from means of frames"),
        (("empirical:brightness",), r"unknown covariate 'brightness' of empirical"),
        (("cyclic_error:distance",), r"unknown effect 'cyclic_error:distance'"),
        (("cyclic_error", "integral_table"), r"integral_table .*give it alone"),
    ],
)
def test_names_that_are_wrong(
    folder: Path, bag: Path, given: Camera, words: tuple[str, ...], match: str
) -> None:
    with pytest.raises(InputError, match=match):
        calibrate(Request((bag,), given, scene(folder), effects=words))
    # said before a recording is read
    with pytest.raises(InputError, match=match):
        calibrate(Request((folder / "absent",), given, scene(folder), effects=words))


def test_cancelled_between_frames_and_between_steps(folder: Path, bag: Path, given: Camera) -> None:
    request = Request((bag,), given, scene(folder))
    with pytest.raises(Cancelled, match="cancelled; nothing was written"):
        calibrate(request, cancelled=lambda: True)
    seen: list[str] = []
    with pytest.raises(Cancelled, match="cancelled"):
        calibrate(
            request,
            progress=lambda words, done, total: seen.append(words),
            cancelled=lambda: any("candidates" in one for one in seen),
        )
    assert "reading frames" in seen
    assert "held-out poses" not in seen


def test_progress_counts_the_frames(folder: Path, bag: Path, given: Camera) -> None:
    counts: list[tuple[int | None, int | None]] = []

    def progress(words: str, done: int | None, total: int | None) -> None:
        if words == "reading frames":
            counts.append((done, total))

    with pytest.raises(InputError):
        calibrate(Request((bag,), given, scene(folder), effects=("saturation_bleed",)), progress=progress)
    assert counts == [(i + 1, 80) for i in range(80)]


def test_one_pose_or_one_distance_only(folder: Path, given: Camera, truth: Camera) -> None:
    one = write(folder / "one_pose", frames(truth, scene(folder), poses=1, repeats=5))
    with pytest.raises(InputError, match=r"one_pose: only one pose: .*20 poses or more"):
        calibrate(Request((one,), given, scene(folder)))
    level = frames(truth, scene(folder), poses=6, repeats=2, distances=(2.0, 2.001), tilt=0.01)
    same = write(folder / "one_distance", level)
    with pytest.raises(InputError, match=r"all at one distance: over the 6 poses .* only \d+ mm"):
        calibrate(Request((same,), given, scene(folder)))


def test_poses_off_by_a_metre_are_named(folder: Path, given: Camera, truth: Camera) -> None:
    few = write(folder / "few_off", frames(truth, scene(folder), seed=3, off={4: 1.1, 9: -0.8}))
    found = calibrate(
        Request((few,), given, scene(folder), effects=("cyclic_error", "amplitude_offset")), integral=False
    )
    note = next(one for one in found.notes if "excluded 2 of 20 poses" in one)
    assert "'board' in pose 4 at 220.1 s by -1." in note
    assert "in pose 9" in note
    assert found.poses == 18
    many = write(
        folder / "many_off", frames(truth, scene(folder), seed=3, off=dict.fromkeys(range(3, 12), 1.0))
    )
    with pytest.raises(
        InputError, match=r"many_off: 9 of 20 poses are off from what was recorded: 'board' in"
    ):
        calibrate(Request((many,), given, scene(folder)))
    shifted = write(
        folder / "all_off", frames(truth, scene(folder), seed=3, off=dict.fromkeys(range(20), 1.2))
    )
    with pytest.raises(InputError, match=r"differ from the scene's by -1\.\d\d m in the median pose"):
        calibrate(Request((shifted,), given, scene(folder)))


def test_poses_and_scene_must_be_there(folder: Path, bag: Path, given: Camera, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--scene: without a scene .*hold poses of board\).*pose: truth"):
        calibrate(Request((bag,), given, None))
    board = scene(folder)
    surface = board.surfaces[0]
    other = replace(board, surfaces=(replace(surface, name="plate"),))
    match = r"bag: /ground_truth/plate/pose: .*takes the pose of 'plate' .*holds poses of: board"
    with pytest.raises(InputError, match=match):
        calibrate(Request((bag,), given, other))


def test_recordings_of_two_cameras(folder: Path, bag: Path, given: Camera, truth: Camera) -> None:
    other = write(folder / "other_camera", frames(truth, scene(folder), poses=2, device="test 8"))
    match = (
        r"other_camera: it was made by 'test 8', but .*bag by 'test 7' \(calibrate each camera by itself\)"
    )
    with pytest.raises(InputError, match=match):
        calibrate(Request((bag, other), given, scene(folder)))


def test_another_modulation_frequency_or_size(folder: Path, bag: Path, given: Camera) -> None:
    faster = replace(given, sensor=replace(given.sensor, modulation_frequency=30e6), effects={})
    with pytest.raises(InputError, match=r"bag: frame_info: .* 20 MHz, the camera file says 30 MHz"):
        calibrate(Request((bag,), faster, scene(folder)))
    wider = replace(given, sensor=replace(given.sensor, width=45))
    with pytest.raises(InputError, match=r"bag: its images have 44 x 36 px, the camera file 45 x 36"):
        calibrate(Request((bag,), wider, scene(folder)))


def test_a_frequency_that_changes_in_the_recording(folder: Path, given: Camera, truth: Camera) -> None:
    def changing() -> list[RawFrame]:
        made = list(frames(truth, scene(folder), poses=3, repeats=2))
        settings = replace(made[-1].settings, modulation_frequency=21e6)
        return [*made[:-1], replace(made[-1], settings=settings)]

    path = write(folder / "changing", changing())
    with pytest.raises(InputError, match=r"changing: frame_info: .* 21 MHz"):
        calibrate(Request((path,), given, scene(folder)))


@pytest.mark.long
def test_worse_poses_than_stated_are_noticed(folder: Path, given: Camera, truth: Camera) -> None:
    path = write(folder / "shaky", frames(truth, scene(folder), seed=4, wrong=6.0))
    asked = ("cyclic_error", "amplitude_offset")
    found = calibrate(Request((path,), given, scene(folder), effects=asked), integral=False)
    assert any("pose_sigma of 'board' is [0.001, 0.0005]" in note for note in found.notes)
    sigma = found.solution.fit.scene.surfaces[0].pose_sigma
    assert sigma[0] == pytest.approx(0.006, rel=0.6)
    assert sigma[1] == pytest.approx(0.003, rel=0.6)
    true, got = camera_numbers(truth), camera_numbers(found.camera)
    z = [(got[p] - true[p]) / found.sigma[p] for p in found.paths if p.startswith("effects.")]
    assert np.abs(z).max() < 4.0


def test_good_poses_are_taken_as_stated(result: Calibration) -> None:
    fitted = result.solution.fit
    assert with_wider_poses(fitted.scene, fitted) is None
    offsets, tilts = pose_error_ratios(fitted)["board"]
    assert 0.4 < offsets < 1.5
    assert 0.25 < tilts < 1.5


def test_shrinking_a_pattern() -> None:
    rng = np.random.default_rng(1)
    smooth = 0.01 * np.sin(np.arange(60) / 12)[None, :] * np.ones((50, 1))
    white = 0.002 * rng.standard_normal((50, 60))
    variance = np.full((50, 60), 0.003**2)
    measured = smooth + white + 0.003 * rng.standard_normal((50, 60))
    error = np.std(shrink(measured, variance) - smooth - white)
    # the best linear estimate of the white part leaves tau sigma / sqrt(tau^2 + sigma^2) = 1.66 mm
    assert error < 0.0019
    unseen = variance.copy()
    unseen[20:24, 30:34] = np.inf
    filled = shrink(np.where(np.isfinite(unseen), measured, 0.0), unseen)
    assert np.abs(filled[20:24, 30:34] - smooth[20:24, 30:34]).max() < 0.002


def test_high_correlations_are_named() -> None:
    matrix = np.array([[4.0, 1.9, 0.0], [1.9, 1.0, 0.1], [0.0, 0.1, 9.0]])
    assert high_correlations(["a", "b", "c"], matrix) == [("a", "b", pytest.approx(0.95))]


def test_checksum_of_files_and_folders(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"abc")
    # sha256 of "abc": FIPS 180-2, appendix B.1
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert checksum(tmp_path / "one") == known
    before = checksum(tmp_path)
    (tmp_path / "two").write_bytes(b"")
    assert checksum(tmp_path) != before
