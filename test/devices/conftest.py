"""The stand-ins for libmesasr and for the USB bus."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rim_camera_ros.devices.mesa_library import LIBRARY_VARIABLE
from rim_camera_ros.devices.sr3000 import SwissRanger
from rim_camera_ros.devices.usb import UsbCameras
from test.devices.standin import CONTROL_VARIABLE, Control, usb_backend

SOURCE = Path(__file__).with_name("libmesasr_standin.c")

Make = Callable[..., SwissRanger]


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The stand-in, compiled."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    built = tmp_path_factory.mktemp("standin") / "libmesasr.so"
    flags = ["-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "-o", str(built), str(SOURCE)], check=True)
    return str(built)


@pytest.fixture
def control(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Control:
    made = Control(tmp_path)
    monkeypatch.setenv(CONTROL_VARIABLE, str(made.path))
    monkeypatch.delenv(LIBRARY_VARIABLE, raising=False)
    return made


@pytest.fixture
def cameras(control: Control) -> UsbCameras:
    """The USB bus with the stand-in camera, or without pyusb nothing that could be asked."""
    if importlib.util.find_spec("usb") is None:
        return UsbCameras()
    return UsbCameras(usb_backend(control))


@pytest.fixture
def make(library: str, control: Control, cameras: UsbCameras) -> Iterator[Make]:
    """Make devices on the stand-ins, which are closed at the end."""
    made: list[SwissRanger] = []

    def device(**options: Any) -> SwissRanger:
        defaults: dict[str, Any] = {"library": library, "cameras": cameras, "transfer_timeout": 0.2}
        made.append(SwissRanger(**{**defaults, **options}))
        return made[-1]

    yield device
    for one in made:
        one.close()
