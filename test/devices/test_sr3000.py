"""The SwissRanger as a device, through the real ctypes code on a stand-in for the vendor's library."""

from __future__ import annotations

import threading
import time
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.devices import sr3000
from rim_camera_ros.devices.swissranger_settings import AutoExposure, CameraSettings
from rim_camera_ros.errors import DeviceError, InputError
from rim_camera_ros.frame import NANOSECONDS, Intrinsics, RawFrame
from test.devices.conftest import Make
from test.devices.standin import COLUMNS, ROWS, Control, expected, is_as_stated, until


def frame_of(device: sr3000.SwissRanger) -> RawFrame:
    frame = device.next_frame()
    assert frame is not None
    return frame


def when(device: sr3000.SwissRanger, condition: Any) -> RawFrame:
    """Take frames until one fulfils a condition, at most 500."""
    for _ in range(500):
        frame = frame_of(device)
        assert is_as_stated(frame)
        if condition(frame):
            return frame
    raise AssertionError("no frame fulfilled the condition")


# --- frames -------------------------------------------------------------------------------------


def test_a_frame_is_what_the_library_delivers(make: Make) -> None:
    geometry = Intrinsics(width=176, height=144, fx=200.0, fy=201.0, cx=90.0, cy=82.0)
    device = make(intrinsics=geometry)
    device.open()
    before = time.time_ns()
    frame = frame_of(device)
    assert frame.shape == (ROWS, COLUMNS)
    assert frame.distance.dtype == frame.amplitude.dtype == np.uint16
    # row 100, column 7, register 90, 20 MHz: 1000 + 13100 + 49 + 192 and 2000 + 900 + 21 + 500
    assert frame.distance[100, 7] == 14341
    assert frame.amplitude[100, 7] == 3421
    assert is_as_stated(frame)
    assert frame.device == "SR-3000"
    assert frame.intrinsics == geometry
    assert frame.settings.integration_time == 90.0
    assert frame.settings.modulation_frequency == 20e6
    assert frame.settings.extra | {"acquisition_time": ""} == {
        "mode": "raw",
        "amplitude_threshold": "0",
        "auto_exposure": "off",
        "acquisition_time": "",
        "library": "libmesasr 1.0.14.747",
        "serial_number": "0x4000002f",
    }
    assert before - NANOSECONDS < frame.stamp < time.time_ns()
    assert not device.notes


def test_frames_own_their_images(make: Make) -> None:
    device = make()
    device.open()
    first = frame_of(device)
    kept = first.distance.copy(), first.amplitude.copy()
    device.set_integration_time(7)
    when(device, lambda frame: frame.settings.integration_time == 7.0)
    device.close()
    assert np.array_equal(first.distance, kept[0])
    assert np.array_equal(first.amplitude, kept[1])


def test_the_stamp_is_the_middle_of_the_acquisition(make: Make, control: Control) -> None:
    control.set(period_us=40000)
    device = make()
    device.open()
    frames, ages = [], []
    for _ in range(6):
        frames.append(frame_of(device))
        ages.append((time.time_ns() - frames[-1].stamp) / NANOSECONDS)
    took = [float(frame.settings.extra["acquisition_time"]) for frame in frames]
    assert min(took) >= 0.04
    share = min(age / time for age, time in zip(ages, took, strict=True))
    assert 0.5 <= share < 0.75  # 0 would be the end, 1 the beginning
    for (one, before), (later, after) in pairwise(zip(frames, took, strict=True)):
        assert (later.stamp - one.stamp) / NANOSECONDS >= (before + after) / 2 - 1e-5
    assert 2.0 < device.frame_rate < 25.0


def test_an_sr2_has_its_own_size(make: Make, control: Control) -> None:
    control.set(ids="0852:0071", rows=124, columns=160)
    device = make()
    device.open()
    frame = frame_of(device)
    assert frame.device == "SR-2"
    assert frame.shape == (124, 160)
    assert is_as_stated(frame)


def test_opening_twice_is_one_camera_and_a_closed_one_opens_again(make: Make) -> None:
    device = make()
    with pytest.raises(DeviceError, match=r"^the camera is not open \(open it first\)$"):
        device.next_frame()
    device.open()
    device.open()
    assert device.starts == 1
    frame_of(device)
    device.close()
    device.close()
    assert device.process_id is None
    assert device.next_frame() is None
    device.open()
    assert is_as_stated(frame_of(device))
    assert device.starts == 2


def test_closing_ends_the_wait_for_a_frame(make: Make, control: Control) -> None:
    device = make(watchdog=60.0)
    device.open()
    frame_of(device)
    control.set(fault="hang")
    taken: list[RawFrame | None] = []

    def take() -> None:
        while not taken or taken[-1] is not None:
            taken.append(device.next_frame())

    thread = threading.Thread(target=take)
    thread.start()
    until(control.stands_still)
    begun = time.monotonic()
    device.close()
    thread.join(10.0)
    assert taken[-1] is None
    assert time.monotonic() - begun < 3.0


def test_the_library_does_not_write_to_standard_output(make: Make, capfd: pytest.CaptureFixture[str]) -> None:
    device = make()
    device.open()
    frame_of(device)
    out, err = capfd.readouterr()
    assert out == ""
    assert "a library that writes to standard output" in err


def test_frames_that_are_not_taken_are_skipped_and_counted(
    make: Make, control: Control, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sr3000, "_STALE", 0)
    device = make()
    device.open()
    frame_of(device)
    until(lambda: control.acquisitions > 20)
    stale = control.acquisitions
    newest = time.time_ns()
    frame = frame_of(device)  # of the four that waited, the newest
    assert frame.stamp < newest
    while frame.stamp < newest:
        frame = frame_of(device)
    assert is_as_stated(frame)
    assert stale - 12 <= device.skipped <= control.acquisitions
    assert device.starts == 1


# --- settings -----------------------------------------------------------------------------------


def test_raw_is_the_default_and_other_modes_are_recorded(make: Make) -> None:
    device = make(settings=CameraSettings(mode="fixed_pattern+median"))
    device.open()
    frame = frame_of(device)
    assert frame.settings.extra["mode"] == "fixed_pattern+median"
    assert is_as_stated(frame, mode=5)  # bits 1 and 4 of the library
    device.change(mode="raw")
    for _ in range(200):
        frame = frame_of(device)
        if frame.settings.extra["mode"] == "raw":
            break
    assert is_as_stated(frame, mode=0)


def test_a_mode_that_is_not_taken_is_reported(make: Make, control: Control) -> None:
    control.set(stuck_mode=4)
    device = make()
    device.open()
    frame = frame_of(device)
    assert frame.settings.extra["mode"] == "median"
    assert is_as_stated(frame, mode=4)
    assert device.notes == {"the camera works in mode median although raw was requested"}


def test_settings_change_together_between_two_frames(make: Make) -> None:
    """Every frame is all of the one or all of the other, in pixels and in what it states."""
    device = make()
    device.open()
    both = (
        {"integration_time": 30, "modulation_frequency": 19e6, "amplitude_threshold": 2600},
        {"integration_time": 200, "modulation_frequency": 30e6, "amplitude_threshold": 4300},
    )
    seen = []
    for change in both * 20:
        device.change(**change)
        frame = when(device, lambda frame, c=change: frame.settings.integration_time == c["integration_time"])
        seen.append(
            (
                frame.settings.integration_time,
                frame.settings.modulation_frequency,
                int(frame.settings.extra["amplitude_threshold"]),
            )
        )
        assert seen[-1] == tuple(change.values())
    assert len(set(seen)) == 2
    assert device.starts == 1
    # with register 200 amplitudes are 4000 + 3 u + 5 v: at the threshold 4300 a corner has no distance
    assert (frame.distance[0, :100] == 0).all()
    assert frame.distance[0, 100] == 1000 + 700 + 64
    assert frame.distance[59, 0] == 0
    assert frame.distance[60, 0] == 1000 + 60 * 131 + 64


def test_settings_of_many_threads_never_mix(make: Make) -> None:
    device = make()
    device.open()
    stop = threading.Event()

    def change(register: int, frequency: float) -> None:
        while not stop.is_set():
            device.change(integration_time=register, modulation_frequency=frequency)

    threads = [threading.Thread(target=change, args=one) for one in ((40, 21e6), (80, 40e6))]
    for thread in threads:
        thread.start()
    try:
        frames = [frame_of(device) for _ in range(60)]
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    stated = {(one.settings.integration_time, one.settings.modulation_frequency) for one in frames}
    assert stated <= {(90.0, 20e6), (40.0, 21e6), (80.0, 40e6)}
    assert all(is_as_stated(one) for one in frames)


def test_defaults_are_those_that_the_camera_had(make: Make) -> None:
    device = make()
    device.open()
    device.set_integration_time(33)
    device.change(modulation_frequency=40e6)
    when(device, lambda frame: frame.settings.modulation_frequency == 40e6)
    device.apply(CameraSettings())
    frame = when(device, lambda frame: frame.settings.modulation_frequency == 20e6)
    assert frame.settings.integration_time == 90.0


def test_auto_exposure_states_the_time_of_each_frame(make: Make) -> None:
    device = make(settings=CameraSettings(auto_exposure=AutoExposure(least=20, greatest=26)))
    device.open()
    frames = [frame_of(device) for _ in range(9)]
    assert [one.settings.integration_time for one in frames] == [20, 21, 22, 23, 24, 25, 26, 26, 26]
    assert all(is_as_stated(one) for one in frames)
    assert frames[0].settings.extra["auto_exposure"] == "20 to 26, 10 % above 45"
    device.change(auto_exposure=None, integration_time=50)
    frame = when(device, lambda frame: frame.settings.extra["auto_exposure"] == "off")
    assert frame.settings.integration_time == 50.0
    assert frame_of(device).settings.integration_time == 50.0


def test_a_refused_change_leaves_all_settings_as_they_were(make: Make, control: Control) -> None:
    device = make(settings=CameraSettings(integration_time=60))
    device.open()
    frame_of(device)
    control.set(fault="refuse")
    device.change(integration_time=120, modulation_frequency=30e6, amplitude_threshold=9)
    while not device.notes:
        frame = frame_of(device)
        assert is_as_stated(frame)
    assert device.notes == {
        "settings were not changed: the camera refused SR_SetModulationFrequency(1), result -7"
    }
    frame = frame_of(device)
    assert frame.settings.integration_time == 60.0
    assert frame.settings.modulation_frequency == 20e6
    assert frame.settings.extra["amplitude_threshold"] == "0"
    assert device.starts == 1


def test_a_frame_rate_is_kept(make: Make) -> None:
    device = make()
    device.open()
    device.set_frame_rate(50.0)
    assert device.frame_rate == 50.0
    frames = [frame_of(device) for _ in range(13)][-9:]
    assert (frames[-1].stamp - frames[0].stamp) / NANOSECONDS == pytest.approx(8 / 50, abs=0.05)
    device.set_frame_rate(None)
    frame_of(device)
    assert device.frame_rate > 0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"integration_time": 256}, r"^integration_time: 256 is not a whole number from 0 to 255$"),
        ({"integration_time": 12.5}, r"^integration_time: 12.5 is not a whole number from 0 to 255$"),
        ({"integration_time": float("nan")}, r"^integration_time: nan is not a whole number"),
        (
            {"modulation_frequency": 22e6},
            r"^modulation_frequency: the camera has no modulation frequency 22 MHz "
            r"\(known: 40, 30, 21, 20, 19 MHz\)$",
        ),
        ({"amplitude_threshold": -1}, r"^amplitude_threshold: -1 is not a whole number from 0 to 65535$"),
        ({"frame_rate": 0.0}, r"^frame_rate: frame rate 0 Hz is not positive$"),
        ({"mode": "medain"}, r"^mode: no mode 'medain' \(did you mean 'median'\?\)$"),
        (
            {"integration_time": 9, "auto_exposure": AutoExposure()},
            r"^integration_time: auto exposure sets the integration time itself",
        ),
    ],
)
def test_impossible_settings_change_nothing(make: Make, change: dict[str, Any], text: str) -> None:
    device = make()
    before = device.settings
    with pytest.raises(InputError, match=text):
        device.change(**change)
    assert device.settings == before


def test_limits_of_auto_exposure() -> None:
    with pytest.raises(InputError, match=r"^auto_exposure.least: 255 is not a whole number from 0 to 254$"):
        AutoExposure(least=255)  # the library takes that as off
    with pytest.raises(InputError, match=r"^auto_exposure.least: least 90 is above greatest 40$"):
        AutoExposure(least=90, greatest=40)


def test_the_formula_is_not_what_it_checks(make: Make) -> None:
    """A pixel that is off, or a setting that is misstated, is seen by the comparison of these tests."""
    device = make()
    device.open()
    frame = frame_of(device)
    distance, amplitude = expected(frame)
    assert np.array_equal(frame.distance, distance)
    amplitude[5, 9] += 1
    assert not np.array_equal(frame.amplitude, amplitude)
    assert not is_as_stated(frame, mode=4)
