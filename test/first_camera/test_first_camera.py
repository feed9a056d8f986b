"""``rim camera`` against recordings whose noise, gain, step and saturation are known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rim_camera_ros.bags import Recording, RecordingWriter
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.first_camera.counts import Counts
from rim_camera_ros.first_camera.estimate import Stated, first_camera
from rim_camera_ros.first_camera.noise_model import fit_noise_model
from rim_camera_ros.first_camera.repeated import NoiseClass
from rim_camera_ros.frame import Intrinsics, RawFrame, Settings
from test.helpers_cli import run

SHAPE = (60, 80)
FLOOR, SHOT, SLOPE = 0.0021, 0.055, 1.7
RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "recordings"

INTRINSICS = Intrinsics(width=80, height=60, fx=90.0, fy=91.0, cx=39.2, cy=30.4)


def rays() -> Any:
    v, u = np.mgrid[0:60, 0:80]
    xyz = np.stack([(u - 39.2) / 90.0, (v - 30.4) / 91.0, np.ones(SHAPE)], axis=-1)
    return xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)


def frames(
    count: int = 40, *, lsb: float | None = None, move: float = 0.0, seed: int = 3, dark: float = 150.0
) -> list[RawFrame]:
    """Return frames of a tilted plane with amplitudes of ``dark`` to 12000 counts from column to column."""
    rng = np.random.default_rng(seed)
    normal = np.array([0.3, -0.1, 1.0]) / np.linalg.norm([0.3, -0.1, 1.0])
    amplitude = np.broadcast_to(np.geomspace(dark, 12_000, 80), SHAPE)
    sigma = np.sqrt(FLOOR**2 + SHOT**2 / amplitude + (SLOPE / amplitude) ** 2)
    result = []
    for i in range(count):
        distance = (1.6 + move * i) / (rays() @ normal) + sigma * rng.standard_normal(SHAPE)
        values: Any = distance.astype(np.float32)
        if lsb is not None:
            values = np.rint(distance / lsb).astype(np.uint16)
        result.append(
            RawFrame(
                stamp=10**9 + i * 40_000_000,
                distance=values,
                amplitude=np.rint(amplitude).astype(np.uint16),
                settings=Settings(integration_time=4.0, modulation_frequency=30e6),
                intrinsics=INTRINSICS,
                device="made",
            )
        )
    return result


def sigma_of(noise: Any, amplitude: Any) -> Any:
    return np.sqrt(noise.floor**2 + noise.shot**2 / amplitude + (noise.amplitude / amplitude) ** 2)


@pytest.mark.parametrize("lsb", [None, 0.001, 0.004])
def test_noise_of_repeated_frames(lsb: float | None) -> None:
    """The model is found through rounding of up to twice the noise, with parameters within their errors."""
    stated = Stated() if lsb is None else Stated(distance_lsb=lsb)
    found = first_camera(frames(lsb=lsb), stated)
    assert found.noise is not None
    assert not found.data.moving
    assert found.data.frames == 40
    a = np.geomspace(200, 11_000, 9)
    truth = np.sqrt(FLOOR**2 + SHOT**2 / a + (SLOPE / a) ** 2)
    assert np.abs(sigma_of(found.noise.noise, a) / truth - 1).max() < 0.04
    for name, value in (("floor", FLOOR), ("shot", SHOT), ("amplitude", SLOPE)):
        error = getattr(found.noise.sigma, name)
        assert abs(getattr(found.noise.noise, name) - value) < 3.5 * error
        assert error < 0.5 * value


def test_stated_errors_are_those_of_repetitions() -> None:
    results = [first_camera(frames(12, seed=seed), Stated()).noise for seed in range(12)]
    for name in ("floor", "shot"):
        values = [getattr(one.noise, name) for one in results if one is not None]
        stated = np.mean([getattr(one.sigma, name) for one in results if one is not None])
        assert 0.4 < np.std(values) / stated < 1.6


def test_moving_frames_are_said_to_move() -> None:
    """Ten millimetres from frame to frame are fifty times the noise that is found nevertheless."""
    found = first_camera(frames(move=0.01), Stated())
    assert found.data.moving
    assert found.noise is not None
    a = np.geomspace(300, 10_000, 7)
    truth = np.sqrt(FLOOR**2 + SHOT**2 / a + (SLOPE / a) ** 2)
    assert np.abs(sigma_of(found.noise.noise, a) / truth - 1).max() < 0.15
    assert any(
        "the frames move: the noise is what neighbouring pixels do not share" in x for x in found.notes
    )


def test_one_frame_tells_no_noise() -> None:
    found = first_camera(frames(1), Stated())
    assert found.noise is None
    assert found.why["noise.floor"] == "ASSUMED: no repeated frames"
    assert any("record 50 frames at rest" in x for x in found.notes)


def test_narrow_amplitudes_tell_one_parameter() -> None:
    classes = tuple(NoiseClass(1000.0 + 50 * k, (2.0 / (1000.0 + 50 * k)) ** 2, 1e-9, 400) for k in range(8))
    found = fit_noise_model(classes)
    assert found is not None
    assert not found.whole
    assert (found.noise.floor, found.noise.shot) == (0.0, 0.0)
    assert found.noise.amplitude == pytest.approx(2.0, rel=1e-6)
    assert fit_noise_model(()) is None


def test_gain_of_a_known_surface() -> None:
    """A = g t rho cos / d^2 with g = 700 on the tilted plane; the angle is found from its points."""
    normal = np.array([0.3, -0.1, 1.0]) / np.linalg.norm([0.3, -0.1, 1.0])
    cosine = rays() @ normal
    distance = 1.6 / cosine
    amplitude = 700.0 * 4.0 * 0.85 * cosine / distance**2
    many = [
        replace(one, distance=distance.astype(np.float32), amplitude=amplitude.astype(np.float32))
        for one in frames(3)
    ]
    found = first_camera(many, Stated(reflectivity=0.85, region=(30, 20, 50, 40))).gain
    assert found.value == pytest.approx(700.0, rel=2e-3)
    assert found.relative_sigma == pytest.approx(0.1, rel=0.02)
    assert found.pixels == 21 * 21
    assert np.cos(found.angle) == pytest.approx(np.median(cosine[20:41, 30:51]), abs=1e-4)
    with pytest.raises(
        InputError, match=r"--region: 30 20 90 40 does not lie within 80 x 60 pixels \(u0 v0 u1"
    ):
        first_camera(many, Stated(region=(30, 20, 90, 40)))
    many = [replace(one, distance=one.distance * 0) for one in many]
    with pytest.raises(InputError, match="--region: 0 pixels with a measurement in 0 0 79 59"):
        first_camera(many, Stated())


def test_the_gain_is_of_the_first_scene_where_nobody_tells_poses() -> None:
    """A board in the hand is 0.3 m farther off in every fourth frame: mixed, its points lie in no plane."""
    normal = np.array([0.3, -0.1, 1.0]) / np.linalg.norm([0.3, -0.1, 1.0])
    cosine = rays() @ normal
    many = []
    for number, frame in enumerate(frames(16)):
        distance = (1.0 + 0.3 * (number // 4)) / cosine
        amplitude = 700.0 * 4.0 * 0.85 * cosine / distance**2
        # of the first scene every second column: the median reflectivity is 0.6 of the bright one
        amplitude[:, :: 2 + number // 4] *= 0.2
        many.append(
            replace(frame, distance=distance.astype(np.float32), amplitude=amplitude.astype(np.float32))
        )
    found = first_camera(many, Stated(reflectivity=0.85 * 0.6, region=(31, 20, 50, 40))).gain
    assert found.distance == pytest.approx(np.median(1.0 / cosine[20:41, 31:51]), rel=1e-6)
    assert found.value == pytest.approx(700.0, rel=2e-3)


def test_saturation_is_where_amplitudes_pile_up() -> None:
    rng = np.random.default_rng(5)
    counts = Counts()
    frame = frames(1)[0]
    grey = np.minimum(rng.normal(9000, 4000, SHAPE), 12_345.0).clip(0).astype(np.uint16)
    counts.add(replace(frame, amplitude=grey))
    assert counts.saturation() == 12_345
    free = Counts()
    free.add(replace(frame, amplitude=rng.normal(9000, 2000, SHAPE).clip(0).astype(np.uint16)))
    assert free.saturation() is None
    eight = Counts()  # infrared of eight bits, each 257 counts
    grey = np.minimum(rng.normal(200, 60, SHAPE), 255.0).clip(0).astype(np.uint16) * 257
    eight.add(replace(frame, amplitude=grey))
    assert eight.saturation() == 65_535


def test_steps_of_counts() -> None:
    counts = Counts()
    counts.add(replace(frames(1)[0], distance=(np.arange(4800, dtype=np.uint16) * 4).reshape(SHAPE)))
    assert counts.grid == 4
    assert counts.greatest_distance == 4799 * 4
    many = [replace(one, distance=one.distance // 4 * 4) for one in frames(3, lsb=0.0003)]
    found = first_camera(many, Stated(distance_lsb=0.0003))
    assert found.why["sensor.distance_lsb"].endswith("all counts are multiples of 4")


def write(path: Path, many: list[RawFrame]) -> Path:
    with RecordingWriter(path) as writer:
        for one in many:
            writer.write_raw(one)
    return path


def test_command_writes_a_file_with_a_comment_at_every_key(tmp_path: Path, capsys: Any) -> None:
    extra = {"distance_lsb": "0.0005"}
    many = [replace(one, settings=replace(one.settings, extra=extra)) for one in frames(6, lsb=0.0005)]
    bag, out = write(tmp_path / "bag", many), tmp_path / "camera.yaml"
    status, said, notes = run(
        capsys, "camera", bag, "--out", out, "--reflectivity", "0.4", "--device", "Mine 7"
    )
    assert status == 0, notes
    assert "6 frames read, camera file written" in said
    camera = load_camera(out)
    assert camera.device == "Mine 7"
    assert camera.sensor.distance_lsb == 0.0005
    assert camera.sensor.integration_time == 4.0
    assert (camera.optics.fx, camera.optics.cy) == (90.0, 30.4)
    lines = out.read_text().splitlines()
    keys = [one for one in lines if re.match(r"\s*[a-z_]+: \S", one)]
    before = lines[: lines.index("provenance:")]
    for line in keys:
        if line in before:
            assert re.search(r" # \S", line), line
    # every field that the file may hold is there
    data = yaml.safe_load(out.read_text())
    for section in ("sensor", "optics", "radiometry", "noise"):
        assert set(data[section]) == set(getattr(camera, section).__dataclass_fields__)
    assert "by the driver's profile" in out.read_text()
    assert run(capsys, "info", out)[0] == 0
    status, _, error = run(capsys, "camera", bag, "--out", out)
    assert (status, "exists already (--force replaces it)" in error) == (2, True)


def test_what_is_assumed_is_said(tmp_path: Path, capsys: Any) -> None:
    many = [replace(one, settings=Settings()) for one in frames(3, lsb=0.001)]
    bag = write(tmp_path / "bag", many)
    status, _, notes = run(capsys, "camera", bag, "--out", tmp_path / "camera.yaml")
    assert status == 0
    for words in (
        "the modulation frequency is not known: 20 MHz is assumed; --modulation-frequency states it",
        "if that is millimetres, --distance-lsb 0.001",
        "no integration time is stated: 1 is taken for all frames",
        "the gain is by an assumed reflectivity of 0.5",
    ):
        assert words in notes
    assert (tmp_path / "camera.yaml").read_text().count("ASSUMED") >= 5  # the heading names the word as well


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--reflectivity", "1.2"], "--reflectivity: must be at most 1, found 1.2"),
        (["--saturation", "-5"], "argument --saturation: must be positive, found -5"),
        (["--region", "1", "2", "3"], "argument --region: expected 4 arguments"),
        (["--region", "1", "2", "300", "4"], "bag: --region: 1 2 300 4 does not lie within 80 x 60"),
    ],
)
def test_bad_usage_is_one_line(tmp_path: Path, capsys: Any, options: list[str], error: str) -> None:
    bag = write(tmp_path / "bag", frames(2))
    status, _, said = run(capsys, "camera", bag, "--out", tmp_path / "camera.yaml", *options)
    assert (status, said.count("\n")) == (2, 1)
    assert error in said
    assert not (tmp_path / "camera.yaml").exists()


def test_without_geometry_the_remedy_is_named(tmp_path: Path, capsys: Any) -> None:
    bag = write(tmp_path / "bag", [replace(one, intrinsics=None) for one in frames(2)])
    status, _, said = run(capsys, "camera", bag, "--out", tmp_path / "camera.yaml")
    assert status == 2
    assert (
        "no camera_info: the geometry is not known (record camera_info, or rim import BAG --camera-info"
        in said
    )


@pytest.mark.skipif(
    not RECORDINGS.is_dir(), reason="the real recordings are not beside this checkout (../shared/recordings)"
)
def test_noise_of_a_real_camera(tmp_path: Path, capsys: Any) -> None:
    """O3D303, three frames: sigma by class of amplitude as plain sample variances over the frames have it."""
    bag = RECORDINGS / "o3d303_wall" / "recording"
    out = tmp_path / "camera.yaml"
    assert run(capsys, "camera", bag, "--out", out, "--distance-lsb", "0.001")[0] == 0
    camera = load_camera(out)
    with Recording(bag) as recording:
        many = list(recording.frames())
    distance = np.stack([one.distance.astype(float) for one in many])
    amplitude = np.stack([one.amplitude.astype(float) for one in many]).mean(axis=0)
    good = (distance > 0).all(axis=0)
    variance = distance.var(axis=0, ddof=1) * 1e-6
    checked = 0
    for low, high in ((200, 300), (300, 500), (500, 800), (800, 1200), (1200, 1800), (1800, 2900)):
        mine = good & (amplitude > low) & (amplitude <= high)
        # two degrees of freedom: the median of chi-square is 2 ln 2
        sigma = np.sqrt(np.median(variance[mine]) / np.log(2))
        model = camera.noise.sigma_distance(np.array([np.exp(np.log(amplitude[mine]).mean())]))[0]
        assert model == pytest.approx(sigma, rel=0.15)
        checked += 1
    assert checked == 6
