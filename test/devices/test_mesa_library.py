"""The binding of the vendor's library, against a stand-in with the signatures of its public header."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.devices.mesa_library import LIBRARY_VARIABLE, MesaLibrary, ShortFrame
from rim_camera_ros.devices.supervision import probe_library
from rim_camera_ros.devices.swissranger_settings import (
    AutoExposure,
    CameraSettings,
    mode_bits,
    mode_name,
    modes,
)
from rim_camera_ros.errors import DeviceError, InputError
from test.devices.standin import Control


def compiled(folder: Path, text: str) -> str:
    source, built = folder / "other.c", folder / "libother.so"
    source.write_text(text)
    compiler = shutil.which("cc")
    assert compiler is not None
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(built), str(source)], check=True)
    return str(built)


def test_an_image_is_copied_from_a_pointer_of_64_bits(library: str, control: Control) -> None:
    camera = MesaLibrary(library).open()
    assert camera._handle.value is not None
    assert camera._handle.value > 2**32  # an int would cut it
    camera.apply(CameraSettings(integration_time=50, modulation_frequency=21e6))
    camera.acquire()
    images = np.zeros((2, camera.rows, camera.columns), np.uint16)
    camera.copy_images(images.ctypes.data)
    # row 143, column 175: 1000 + 18733 + 1225 + 64 * 2 and 2000 + 500 + 525 + 715
    assert images[:, 143, 175].tolist() == [21086, 3740]
    assert images[:, 0, 0].tolist() == [1128, 2500]
    assert camera.state() == {
        "integration_time": 50,
        "modulation_frequency": 21e6,
        "amplitude_threshold": 0,
        "mode": 0,
    }
    camera.close()


def test_what_the_camera_says_of_itself(library: str, control: Control) -> None:
    camera = MesaLibrary(library).open(serial=0x4000002F)
    assert camera.usb_ids == (0x1AD2, 0x0074)
    assert (camera.rows, camera.columns, camera.serial) == (144, 176, 0x4000002F)
    assert camera.defaults == {
        "integration_time": 90,
        "modulation_frequency": 3,
        "amplitude_threshold": 0,
        "mode": 5,  # the vendor's default is not raw
    }
    camera.close()


def test_bytes_that_are_missing_are_reported(library: str, control: Control) -> None:
    camera = MesaLibrary(library).open()
    control.set(fault="short")
    with pytest.raises(ShortFrame, match=r"^a frame has 76032 bytes instead of 101376$"):
        camera.acquire()
    control.set(fault="fail")
    with pytest.raises(DeviceError, match=r"\(SR_Acquire returned -1\) \(check the cable and the camera's"):
        camera.acquire()
    camera.close()


@pytest.mark.parametrize("version", ["1.0.10.614", "1.1.14.747", "0.0.0.0"])
def test_an_unknown_version_is_refused(library: str, control: Control, version: str) -> None:
    control.set(version=version)
    text = (
        rf"^{library}: version {version} numbers its modulation frequencies in an unknown way "
        r"\(known: 1.0.14\)$"
    )
    with pytest.raises(InputError, match=text):
        MesaLibrary(library)
    with pytest.raises(InputError, match=text):
        probe_library(library)


def test_the_library_is_found_by_the_environment(
    library: str, control: Control, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, library)
    assert probe_library(None) == {"file": library, "version": "1.0.14.747"}


def test_an_absent_library_is_reported(control: Control, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"^/no/libmesasr.so: the vendor's library is not installed \(give the"
    ):
        probe_library("/no/libmesasr.so")
    try:
        ctypes.CDLL("libmesasr.so")
    except OSError:
        text = r"^libmesasr.so: the vendor's library is not installed \(install it, or set RIM_LIBMESASR"
        with pytest.raises(InputError, match=text):
            probe_library(None)


def test_something_else_than_the_library_is_reported(library: str, control: Control, tmp_path: Path) -> None:
    text = tmp_path / "libtext.so"
    text.write_text("no library")
    with pytest.raises(InputError, match=rf"^{text}: cannot be loaded: .*(too short|invalid ELF header)"):
        probe_library(str(text))
    other = compiled(tmp_path, "int SR_GetVersion(unsigned short v[4]) { v[3] = 1; return 0; }\n")
    with pytest.raises(InputError, match=rf"^{other}: has no function SR_OpenUSB \(install libmesasr 1.0.14"):
        probe_library(other)
    crashing = "#include <stdlib.h>\n__attribute__((constructor)) static void start(void) { abort(); }\n"
    other = compiled(tmp_path, crashing)
    with pytest.raises(DeviceError, match=rf"^{other}: the vendor's library crashes when it is loaded"):
        probe_library(other)


def test_a_library_that_the_library_needs_is_named(control: Control, tmp_path: Path) -> None:
    """Libmesasr needs the old libusb-0.1; the message names that, not libmesasr."""
    needed = tmp_path / "libusb-0.1.so.4"
    os.rename(compiled(tmp_path, "int usb_init(void) { return 0; }\n"), needed)
    source, built = tmp_path / "needs.c", tmp_path / "libmesasr.so"
    source.write_text("int usb_init(void); int SR_GetVersion(void) { return usb_init(); }\n")
    compiler = shutil.which("cc")
    assert compiler is not None
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(built), str(source), str(needed)], check=True)
    needed.unlink()
    with pytest.raises(
        InputError, match=rf"^{built}: needs .*libusb-0.1.so.4, which is missing \(install the"
    ):
        probe_library(str(built))


def test_modes_by_name() -> None:
    assert [mode_bits(one) for one in modes()] == [0, 1, 4, 5]
    assert [mode_name(one) for one in (0, 1, 4, 5, 0x14, 0x800)] == [
        "raw",
        "fixed_pattern",
        "median",
        "fixed_pattern+median",
        "median+0x10",
        "0x800",
    ]


def test_settings_survive_their_plain_form() -> None:
    for settings in (
        CameraSettings(integration_time=3, modulation_frequency=19e6, amplitude_threshold=7, mode="median"),
        CameraSettings(auto_exposure=AutoExposure(least=9, greatest=77, percent_over=3, position=60)),
    ):
        assert CameraSettings.from_plain(settings.to_plain()) == settings
