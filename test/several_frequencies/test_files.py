"""Camera files of several frequencies: lists and what holds for all, and what is wrong in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera, save_camera, save_camera_apart
from rim_camera_ros.errors import InputError

CAMERA = """
format: rim_camera/1
device: two
sensor: {width: 6, height: 4, modulation_frequency: [100.0e6, 80.0e6], saturation: [30000, 40000],
         exposure: [0.1, 0.2]}
optics: {fx: 5.0, fy: 5.0, cx: 2.5, cy: 1.5}
radiometry: {gain: [210.0, 190.0]}
noise: {floor: 0.002, amplitude: [2.0, 3.0]}
minimum_amplitude: [20, 30]
effects:
  cyclic_error: [{harmonics: [{order: 4, amplitude: 0.003, phase: 0.7}]}, null]
  distance_scale: {scale: 0.001}
"""


def test_lists_are_by_frequency_and_all_else_holds_for_all(tmp_path: Path) -> None:
    camera = load_camera(_written(tmp_path, CAMERA))
    first, second = camera.channels
    assert [one.sensor.modulation_frequency for one in camera.channels] == [100e6, 80e6]
    assert [one.sensor.saturation for one in camera.channels] == [30000, 40000]
    assert [one.radiometry.gain for one in camera.channels] == [210, 190]
    assert [one.noise.amplitude for one in camera.channels] == [2, 3]
    assert [one.noise.floor for one in camera.channels] == [0.002, 0.002]
    assert [one.minimum_amplitude for one in camera.channels] == [20, 30]
    assert first.sensor.exposure == second.sensor.exposure == (0.1, 0.2)
    assert list(first.effects) == ["cyclic_error", "distance_scale"]
    assert list(second.effects) == ["distance_scale"]
    # all phases repeat where 20 MHz does: 7.49 m
    assert camera.sensor.ambiguity == pytest.approx(299_792_458 / 40e6)
    # inverse variances add up, at the mean gain of 200
    weight = (210 / 200 / 2.0) ** 2 + (190 / 200 / 3.0) ** 2
    assert camera.noise.amplitude == pytest.approx(weight**-0.5)
    assert camera.measurement.resolved(camera).effects.keys() == {"distance_scale"}


def _written(folder: Path, text: str) -> Path:
    path = folder / "camera.yaml"
    path.write_text(text)
    return path


def test_a_file_that_is_written_says_the_same(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((4, 6), 0.01, np.float32))
    np.save(tmp_path / "b.npy", np.full((4, 6), -0.02, np.float32))
    text = CAMERA + "  fixed_pattern_offset: [{map: a.npy}, {map: b.npy}]\n"
    text += "measurement: {type: several_frequencies, range: [0.2, 7.0], odds: 30, wraps: [[0, 0], [1, 1]]}\n"
    camera = load_camera(_written(tmp_path, text))
    save_camera(camera, tmp_path / "again.yaml")
    assert load_camera(tmp_path / "again.yaml") == camera
    (tmp_path / "other").mkdir()
    apart = save_camera_apart(camera, tmp_path / "other" / "mine.yaml")
    read = load_camera(tmp_path / "other" / "mine.yaml")
    assert read == apart
    maps = [one.effects["fixed_pattern_offset"].map.values[0, 0] for one in read.channels]
    assert maps == pytest.approx([0.01, -0.02])


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[2.0, 3.0]", "[2.0, 3.0, 4.0]", r"noise\.amplitude \(line 8\): 3 entries for 2 frequencies"),
        ("[2.0, 3.0]", "[2.0, -3.0]", r"noise\.amplitude \(line 8\): must be at least 0"),
        ("phase: 0.7", "phse: 0.7", r"cyclic_error\.harmonics\.0\.phse.*did you mean 'phase'"),
        ("null]", "{harmonics: []}]", "harmonics is empty"),
        ("[100.0e6, 80.0e6]", "[100.0e6]", "a list of one frequency"),
        ("[100.0e6, 80.0e6]", "[100.0e6, 100.0e6]", "a frequency is given twice"),
        ("[100.0e6, 80.0e6]", "100.0e6", "expected a number in counts, found a list"),
        ("exposure: [0.1, 0.2]", "distance_lsb: 0.001", "counts must wrap at each frequency's"),
        (
            "effects:",
            "measurement: {type: several_frequencies, range: [0.5, 7.6]}\neffects:",
            r"phases of all frequencies repeat from 7\.495 m, 7\.6 m is beyond",
        ),
        (
            "effects:",
            "measurement: {type: several_frequencies, range: [0.5, 4.0], wraps: [[0, 0], [3, 2]]}\neffects:",
            r"wraps: \[3, 2\] lie beyond the range of 4 m",
        ),
        (
            "effects:",
            "measurement: {type: several_frequencies, wraps: [[0, 0, 1]]}\neffects:",
            r"wraps: \[0, 0, 1\] has 3 entries for 2 frequencies",
        ),
        (
            "effects:",
            "measurement: {type: several_frequencies, range: [3.0, 2.0]}\neffects:",
            "the first value must be less",
        ),
        (
            "effects:",
            "measurement: {type: several_frequencies, two_paths: true}\neffects:",
            "two_paths needs three frequencies",
        ),
        ("effects:", "measurement: {type: several}\neffects:", r"unknown type.*several_frequencies"),
        ("effects:", "measurement: {odds: 3}\neffects:", r"expected a group of keys with a type"),
        ("effects:", "measurement: {type: single_photon}\neffects:", "has one modulation frequency"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in CAMERA
    with pytest.raises(InputError, match=match) as caught:
        load_camera(_written(tmp_path, CAMERA.replace(old, new)))
    assert "\n" not in str(caught.value)


def test_several_frequencies_of_one_number_are_refused(tmp_path: Path) -> None:
    text = "\n".join(
        [
            "format: rim_camera/1",
            "sensor: {width: 6, height: 4, modulation_frequency: 20.0e6}",
            "optics: {fx: 5.0, fy: 5.0, cx: 2.5, cy: 1.5}",
            "measurement: {type: several_frequencies}",
        ]
    )
    with pytest.raises(InputError, match=r"needs a list at sensor\.modulation_frequency"):
        load_camera(_written(tmp_path, text))
