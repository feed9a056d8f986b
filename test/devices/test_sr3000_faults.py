"""What goes wrong with a camera: every fault is reported in words, and frames come again when it has gone."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from rim_camera_ros.devices import sr3000
from rim_camera_ros.devices.acquisition import Acquisition
from rim_camera_ros.devices.sr3000 import SwissRanger
from rim_camera_ros.devices.swissranger_settings import CameraSettings
from rim_camera_ros.devices.usb import UsbCameras
from rim_camera_ros.errors import DeviceError, InputError, RimError
from rim_camera_ros.frame import Intrinsics, RawFrame
from test.devices.conftest import Make
from test.devices.standin import Control, is_as_stated, until, usb_backend

#: Seconds in which a camera that is there again must deliver.
_LIMIT = 3.0


def frame_of(device: SwissRanger) -> RawFrame:
    frame = device.next_frame()
    assert frame is not None
    return frame


def fault_of(device: SwissRanger) -> RimError:
    """Take frames until the device fails, and return the error."""
    begun = time.monotonic()
    while time.monotonic() - begun < 30.0:
        try:
            frame_of(device)
        except RimError as error:
            return error
    raise AssertionError("the device does not fail")


def without_pyusb(monkeypatch: pytest.MonkeyPatch) -> UsbCameras:
    monkeypatch.setitem(sys.modules, "usb", None)
    monkeypatch.setitem(sys.modules, "usb.core", None)
    return UsbCameras()


# --- faults while frames are taken --------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("hang", r"^libmesasr hangs: no frame for 0.5 s \(it is started anew;"),
        ("crash", r"^the acquisition process was ended by SIGABRT \(it is started anew;"),
        ("fail", r"^the transfer of a frame failed \(SR_Acquire returned -1\) \(check the cable"),
        (
            "short",
            r"^5 short frames after each other: a frame has 76032 bytes instead of 101376 \(check the cable;",
        ),
        ("null_image", r"^libmesasr has no image 0 \(SR_GetImage returned NULL\)$"),
    ],
)
def test_a_fault_is_reported_and_frames_come_again(
    make: Make, control: Control, fault: str, text: str
) -> None:
    device = make(settings=CameraSettings(integration_time=41, amplitude_threshold=2500), watchdog=0.5)
    device.open()
    first = frame_of(device)
    before = device.process_id
    control.set(fault=fault)
    error = fault_of(device)
    assert isinstance(error, DeviceError)
    assert re.search(text, str(error)), error
    control.set(fault="none")
    begun = time.monotonic()
    frame = frame_of(device)
    assert time.monotonic() - begun < _LIMIT
    assert device.process_id != before
    assert frame.stamp > first.stamp
    assert frame.settings.integration_time == 41.0
    assert frame.settings.extra["amplitude_threshold"] == "2500"
    assert is_as_stated(frame)


def test_single_short_frames_are_dropped_and_counted(make: Make, control: Control) -> None:
    device = make()
    device.open()
    frame_of(device)
    control.set(fault="short", period_us=20000)
    count = control.acquisitions
    until(lambda: control.acquisitions >= count + 2)
    control.set(fault="none")
    while not device.short_frames:
        assert is_as_stated(frame_of(device))
    assert 1 <= device.short_frames <= 4
    assert device.starts == 1


def test_a_slow_camera_is_no_fault(make: Make, control: Control) -> None:
    control.set(period_us=300000)
    device = make(watchdog=0.5)
    device.open()
    frames = [frame_of(device) for _ in range(3)]
    assert frames[2].stamp - frames[0].stamp >= 600_000_000
    assert device.starts == 1


def test_a_killed_process_is_replaced(make: Make) -> None:
    device = make()
    device.open()
    device.set_integration_time(77)
    while frame_of(device).settings.integration_time != 77.0:
        pass
    killed = device.process_id
    assert killed is not None
    os.kill(killed, signal.SIGKILL)
    error = fault_of(device)
    assert "the acquisition process was ended by SIGKILL" in str(error)
    frame = frame_of(device)
    assert frame.settings.integration_time == 77.0
    assert device.process_id not in (None, killed)
    assert not Path(f"/proc/{killed}").exists()


@pytest.mark.parametrize("fault", ["none", "hang"])
def test_the_process_ends_with_its_supervisor(library: str, control: Control, fault: str) -> None:
    """Even when the supervisor is killed while the library hangs, nothing is left that holds the camera."""
    script = (
        "import sys\n"
        "sys.modules['usb'] = None  # the stand-in library has no camera on USB\n"
        "from rim_camera_ros.devices.sr3000 import SwissRanger\n"
        "device = SwissRanger(library=sys.argv[1], watchdog=60.0)\n"
        "device.open(); device.next_frame()\n"
        "print(device.process_id, flush=True)\n"
        "while True: device.next_frame()\n"
    )
    supervisor = subprocess.Popen([sys.executable, "-c", script, library], stdout=subprocess.PIPE, text=True)
    try:
        assert supervisor.stdout is not None
        worker = Path(f"/proc/{int(supervisor.stdout.readline())}")
        control.set(fault=fault)
        if fault == "hang":
            until(control.stands_still)
        assert worker.exists()
    finally:
        supervisor.kill()
        supervisor.communicate()
    assert until(lambda: not worker.exists()) < _LIMIT


# --- faults at the beginning --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("control_values", "text"),
    [
        (
            {"fault": "none_open"},
            r"^libmesasr cannot open a camera \(SR_OpenUSB returned 0\) \(rim info usb shows",
        ),
        ({"fault": "crash_open"}, r"^the acquisition process was ended by SIGABRT"),
        ({"fault": "hang_open"}, r"^libmesasr does not open the camera within 0.7 s"),
        ({"fault": "refuse"}, r"^the camera refused SR_SetModulationFrequency\(0\), result -7$"),
        (
            {"rows": 120, "columns": 161},
            r"^libmesasr delivers 161 x 120 pixels, an SR-3000 has 176 x 144 \(check which camera",
        ),
        ({"ids": "0852:0071"}, r"^libmesasr delivers 176 x 144 pixels, an SR-2 has 160 x 124"),
        ({"ids": "1ad2:0075"}, r"^the camera SR-4000 is not supported \(connect an SR-2 or SR-3000\)$"),
        ({"ids": "1234:5678"}, r"^the camera 1234:5678 is not supported"),
        (
            {"version": "1.0.10.614"},
            r"libmesasr.so: version 1.0.10.614 numbers its modulation frequencies in an unknown way "
            r"\(known: 1.0.14\)$",
        ),
    ],
)
def test_what_keeps_a_camera_from_opening(
    make: Make, control: Control, control_values: dict[str, Any], text: str
) -> None:
    control.set(**control_values)
    device = make(start_timeout=0.7, settings=CameraSettings(modulation_frequency=40e6))
    with pytest.raises(RimError, match=text):
        device.open()
    assert device.process_id is None
    control.set(fault="none", rows=144, columns=176, ids="1ad2:0074", version="1.0.14.748")
    device.open()
    assert frame_of(device).settings.extra["library"] == "libmesasr 1.0.14.748"


def test_the_geometry_must_be_that_of_the_camera(make: Make) -> None:
    geometry = Intrinsics(width=160, height=124, fx=195.0, fy=140.0, cx=77.0, cy=63.0)
    text = r"^camera: the SR-3000 delivers 176 x 144 pixels, the camera file describes 160 x 124 \(give the"
    with pytest.raises(InputError, match=text):
        make(intrinsics=geometry).open()


def test_a_serial_number_that_is_not_there(make: Make) -> None:
    with pytest.raises(
        DeviceError, match=r"the camera with serial number 0x00000007 \(SR_OpenUSB returned 0\)"
    ):
        make(serial=7).open()
    device = make(serial=0x4000002F)
    device.open()
    assert frame_of(device).settings.extra["serial_number"] == "0x4000002f"


@pytest.mark.parametrize("wait", [False, True])
def test_without_the_library_opening_fails(make: Make, tmp_path: Path, wait: bool) -> None:
    path = tmp_path / "libmesasr.so"
    device = make(library=str(path), wait_for_camera=wait)
    with pytest.raises(InputError, match=rf"^{path}: the vendor's library is not installed \(give the path"):
        device.open()


def test_waiting_for_a_camera_that_is_plugged_in_later(make: Make, control: Control) -> None:
    control.set(plugged=0)
    with pytest.raises(DeviceError):
        make().open()
    device = make(wait_for_camera=True)
    device.open()
    with pytest.raises(DeviceError, match=r"no SwissRanger is connected|cannot open a camera"):
        device.next_frame()
    control.set(plugged=1)
    assert is_as_stated(frame_of(device))


# --- USB ----------------------------------------------------------------------------------------


def test_the_words_of_usb_come_before_those_of_the_library(library: str, control: Control) -> None:
    pytest.importorskip("usb", reason="pyusb is an optional extra")
    backend = usb_backend(control)
    device = SwissRanger(library=library, cameras=UsbCameras(backend))
    device.open()
    try:
        frame_of(device)
        control.set(plugged=0)
        assert str(fault_of(device)) == (
            "no SwissRanger is connected to USB (ids 0852:0071, 0852:0074, 1ad2:0074, 1ad2:0075) "
            "(plug it in and switch it on; it is taken by itself then)"
        )
        starts = device.starts
        control.set(plugged=1, usb_error=errno.EACCES)
        assert "no permission to use the SR-3000 (write to /etc/udev/rules.d/" in str(fault_of(device))
        control.set(usb_error=errno.EBUSY)
        assert "another process has the SR-3000 (end that process)" in str(fault_of(device))
        assert device.starts == starts
        control.set(usb_error=0)
        assert is_as_stated(frame_of(device))
        assert backend.claimed == []
        assert backend.opened == backend.closed
    finally:
        device.close()


def test_the_second_hang_resets_the_camera(library: str, control: Control) -> None:
    pytest.importorskip("usb", reason="pyusb is an optional extra")
    backend = usb_backend(control)
    device = SwissRanger(
        library=library, cameras=UsbCameras(backend), watchdog=0.3, start_timeout=0.4, transfer_timeout=0.1
    )
    device.open()
    try:
        frame_of(device)
        control.set(fault="hang")
        assert "libmesasr hangs: no frame for 0.3 s" in str(fault_of(device))
        assert backend.resets == 0
        control.set(fault="hang_open")
        assert "does not open the camera within 0.4 s" in str(fault_of(device))
        assert backend.resets == 1
        assert device.notes == {"1 camera(s) on USB were reset because libmesasr hung repeatedly"}
        control.set(fault="none")
        assert is_as_stated(frame_of(device))
        control.set(fault="hang")
        fault_of(device)
        assert backend.resets == 1
    finally:
        device.close()


@pytest.mark.parametrize("pyusb", [True, False])
def test_a_fault_is_reported_once_and_looking_becomes_slower(
    library: str, control: Control, monkeypatch: pytest.MonkeyPatch, pyusb: bool
) -> None:
    if pyusb:
        pytest.importorskip("usb", reason="pyusb is an optional extra")
    cameras = UsbCameras(usb_backend(control)) if pyusb else without_pyusb(monkeypatch)
    monkeypatch.setattr(sr3000, "_RETRY_AT_MOST", 0.5)  # 1 s takes longer to reach
    device = SwissRanger(library=library, cameras=cameras)
    device.open()
    frame_of(device)
    control.set(plugged=0)
    reported = {str(fault_of(device))}
    taken: list[RawFrame | RimError | None] = []

    def take() -> None:
        while not any(isinstance(one, RawFrame) for one in taken):
            try:
                taken.append(device.next_frame())
            except RimError as error:
                taken.append(error)

    thread = threading.Thread(target=take)
    thread.start()
    try:
        until(lambda: device._pause == 0.5)
        control.set(plugged=1)
        waited = until(lambda: any(isinstance(one, RawFrame) for one in taken))
        assert waited < _LIMIT
    finally:
        device.close()
        thread.join()
    again = [str(one) for one in taken if isinstance(one, RimError)]
    assert len(again) == len(set(again)) <= 1  # without pyusb: the transfer failed, then opening failed
    assert reported.isdisjoint(again)
    assert device._pause == 0.0


# --- unplugged and plugged in again and again ---------------------------------------------------


def resident() -> int:
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def children() -> set[str]:
    """Ids of the child processes, those included that ended and were not waited for."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def plug_cycles(device: SwissRanger, control: Control, count: int) -> list[float]:
    """Unplug and plug in again; return the seconds from plugging in to the first frame."""
    seconds = []
    for _ in range(count):
        control.set(plugged=0)
        fault_of(device)
        control.set(plugged=1)
        begun = time.monotonic()
        while True:
            try:
                frame = frame_of(device)
                break
            except DeviceError:
                continue
        seconds.append(time.monotonic() - begun)
        assert is_as_stated(frame)
    return seconds


@pytest.mark.parametrize("count", [10, pytest.param(200, marks=pytest.mark.slow)])
def test_unplugged_and_plugged_in(make: Make, control: Control, count: int) -> None:
    device = make()
    device.open()
    frame_of(device)
    others = children() - {str(device.process_id)}
    plug_cycles(device, control, 3)
    memory, files = resident(), descriptors()
    seconds = plug_cycles(device, control, count)
    assert max(seconds) < _LIMIT
    assert descriptors() == files
    assert resident() - memory < 3_000_000  # a leaked pair of images in shared memory is 100 kB a cycle
    assert children() - others == {str(device.process_id)}
    assert device.starts >= count + 4
    median = sorted(seconds)[count // 2]
    print(
        f"{count} cycles: median {median:.3f}, at most {max(seconds):.3f} s; {resident() - memory:+d} bytes"
    )


def test_the_nodes_acquisition_thread_gets_a_camera_back(make: Make, control: Control) -> None:
    """The thread of the driver node closes and opens a device that failed."""
    device = make()
    device.open()
    frames: list[RawFrame] = []
    faults: list[tuple[RimError, float | None]] = []
    recovered = threading.Event()

    class Listener:
        def on_frame(self, frame: RawFrame) -> bool:
            frames.append(frame)
            return True

        def on_end(self) -> None:
            raise AssertionError("a camera has no end")

        def on_fault(self, error: RimError, retry_in: float | None) -> None:
            faults.append((error, retry_in))

        def on_recovery(self) -> None:
            recovered.set()

    acquisition = Acquisition(device, Listener())
    acquisition.start()
    try:
        until(lambda: len(frames) > 3)
        control.set(plugged=0)
        until(lambda: bool(faults))
        control.set(plugged=1)
        assert recovered.wait(_LIMIT)
        count = len(frames)
        until(lambda: len(frames) > count + 3)
    finally:
        acquisition.stop()
    assert is_as_stated(frames[-1])
    assert device.process_id is None
