"""Finding, judging and resetting cameras on USB, by pyusb on a stand-in backend; and ``rim info usb``."""

from __future__ import annotations

import errno
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rim_camera_ros.devices.mesa_library import LIBRARY_VARIABLE
from rim_camera_ros.devices.usb import (
    MODELS,
    UsbCamera,
    UsbCameras,
    UsbUnavailable,
    udev_rule,
    udev_rules,
    users_of,
)
from rim_camera_ros.errors import DeviceError
from test.devices.standin import Control, usb_backend
from test.helpers_cli import run

ROOT = Path(__file__).resolve().parents[2]
RULE = (
    'SUBSYSTEM=="usb", ATTR{idVendor}=="1ad2", ATTR{idProduct}=="0074", '
    'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
)


@pytest.fixture
def backend(control: Control) -> Any:
    pytest.importorskip("usb", reason="pyusb is an optional extra")
    return usb_backend(control)


def test_ids_are_the_published_ones() -> None:
    assert {f"{v:04x}:{p:04x}": model.name for (v, p), model in MODELS.items()} == {
        "0852:0071": "SR-2",
        "0852:0074": "SR-3000",
        "1ad2:0074": "SR-3000",
        "1ad2:0075": "SR-4000",
    }


def test_a_camera_is_found_among_other_devices(backend: Any) -> None:
    assert UsbCameras(backend).find() == [
        UsbCamera(vendor=0x1AD2, product=0x0074, bus=3, address=4, state="ready")
    ]
    assert backend.claimed == []  # the library must be able to claim it
    assert backend.opened == backend.closed == 1
    UsbCameras(backend).check()


def test_nothing_connected(backend: Any, control: Control) -> None:
    control.set(plugged=0)
    cameras = UsbCameras(backend)
    assert cameras.find() == []
    with pytest.raises(
        DeviceError, match=r"^no SwissRanger is connected to USB \(ids 0852:0071, .*1ad2:0075\)"
    ):
        cameras.check()


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (
            errno.EACCES,
            "/dev/bus/usb/003/004: no permission to use the SR-3000 (write to "
            f"/etc/udev/rules.d/70-swissranger.rules: {RULE} then: "
            "sudo udevadm control --reload && sudo udevadm trigger, and plug the camera in anew)",
        ),
        (errno.EBUSY, "/dev/bus/usb/003/004: another process has the SR-3000 (end that process)"),
        (
            errno.EIO,
            "/dev/bus/usb/003/004: the SR-3000 does not answer: Input/output error (plug it in anew)",
        ),
    ],
)
def test_what_keeps_a_camera_from_being_used(backend: Any, control: Control, number: int, text: str) -> None:
    control.set(usb_error=number)
    with pytest.raises(DeviceError, match=f"^{re.escape(text)}$"):
        UsbCameras(backend).check()
    assert backend.opened == backend.closed


def test_one_camera_that_can_be_used_is_enough(control: Control) -> None:
    pytest.importorskip("usb", reason="pyusb is an optional extra")
    backend = usb_backend(control, (0x1AD2, 0x0075), (0x0852, 0x0074))
    cameras = UsbCameras(backend)
    assert [str(one.error() or "usable") for one in cameras.find()] == [
        "/dev/bus/usb/003/004: the SR-4000 is not supported (connect an SR-2 or SR-3000)",
        "usable",
    ]
    cameras.check()
    assert cameras.reset() == backend.resets == 1  # the SR-4000 is left alone


def test_reset(backend: Any, control: Control) -> None:
    cameras = UsbCameras(backend)
    assert cameras.reset() == backend.resets == 1
    control.set(reset_error=errno.ENODEV)
    with pytest.raises(
        DeviceError, match=r"^/dev/bus/usb/003/004: the SR-3000 cannot be reset: No such device"
    ):
        cameras.reset()
    control.set(usb_error=errno.EBUSY, reset_error=0)
    assert cameras.reset() == 0  # somebody else works with it
    assert backend.resets == 1


def test_without_pyusb_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("usb", "usb.core", "usb.util"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        UsbUnavailable, match=r"^pyusb is not installed \(sudo apt install python3-usb, or pip"
    ):
        UsbCameras().find()
    with pytest.raises(UsbUnavailable):
        UsbCameras().reset()
    UsbCameras().check()


def test_without_libusb_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("usb", reason="pyusb is an optional extra")
    calls = []

    def absent() -> None:
        calls.append(1)

    for name in ("libusb0", "libusb1", "openusb"):
        monkeypatch.setattr(f"usb.backend.{name}.get_backend", absent)
    cameras = UsbCameras()
    for _ in range(3):
        with pytest.raises(
            UsbUnavailable, match=r"^libusb 1.0 is not installed \(sudo apt install libusb-1.0-0\)$"
        ):
            cameras.find()
    assert len(calls) == 3  # one round over the three backends; looking again takes a tenth of a second


def test_who_has_a_file_open(tmp_path: Path) -> None:
    file = tmp_path / "device"
    file.write_text("")
    assert users_of(str(file)) == []
    script = "import sys; f = open(sys.argv[1]); print(flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", script, str(file)], **pipes) as other:  # type: ignore[call-overload]
        other.stdout.readline()
        assert users_of(str(file)) == [
            f"{Path(f'/proc/{other.pid}/comm').read_text().strip()}, process {other.pid}"
        ]
        other.communicate()
    with file.open():
        assert users_of(str(file)) == []  # this process itself is no news


def test_the_shipped_rules_are_those_of_the_models() -> None:
    assert udev_rule(0x1AD2, 0x0074) == RULE
    shipped = ROOT / "config" / "udev" / "70-swissranger.rules"
    assert shipped.read_text() == udev_rules()
    assert udev_rules().count("SUBSYSTEM") == 3
    assert RULE in (ROOT / "docs" / "sr3000.md").read_text()


# --- rim info usb -------------------------------------------------------------------------------


@pytest.fixture
def bus(backend: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What the command finds by itself is the stand-in."""
    monkeypatch.setattr("usb.backend.libusb1.get_backend", lambda: backend)
    return backend


def test_info_usb_where_all_is_there(
    bus: Any, library: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, library)
    assert run(capsys, "info", "usb") == (
        0,
        "SR-3000 (1ad2:0074) at /dev/bus/usb/003/004: ready\n"
        f"libmesasr 1.0.14.747: {library}\n"
        "frames can be taken\n",
        "",
    )
    status, out, _ = run(capsys, "info", "usb", "--json")
    assert status == 0
    assert json.loads(out) == {
        "kind": "usb",
        "cameras": [
            {
                "model": "SR-3000",
                "ids": "1ad2:0074",
                "file": "/dev/bus/usb/003/004",
                "state": "ready",
                "problem": None,
            }
        ],
        "library": {"file": library, "version": "1.0.14.747"},
        "missing": [],
    }


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"plugged": 0}, "missing: no SwissRanger is connected (plug it in and switch it on)"),
        (
            {"usb_error": errno.EACCES},
            f"missing: /dev/bus/usb/003/004: no permission .* {re.escape(RULE)} then",
        ),
        ({"usb_error": errno.EBUSY}, "missing: /dev/bus/usb/003/004: another process has the SR-3000"),
        ({"version": "2.0.0.1"}, "missing: .*: version 2.0.0.1 numbers its modulation frequencies"),
    ],
)
def test_info_usb_says_what_is_missing(
    bus: Any,
    control: Control,
    library: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    values: dict[str, Any],
    text: str,
) -> None:
    monkeypatch.setenv(LIBRARY_VARIABLE, library)
    control.set(**values)
    status, out, err = run(capsys, "info", "usb")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    missing = [line for line in lines if line.startswith("missing: ")]
    assert len(missing) == 1
    assert re.match(text.replace("(plug", r"\(plug").replace("on)", r"on\)"), missing[0])
    assert "frames can be taken" not in lines
    status, out, _ = run(capsys, "info", "usb", "--json")
    assert json.loads(out)["missing"] == [missing[0].removeprefix("missing: ")]


def test_info_usb_without_pyusb_and_library(
    control: Control, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("usb", "usb.core", "usb.util"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setenv(LIBRARY_VARIABLE, "/no/libmesasr.so")
    status, out, _ = run(capsys, "info", "usb")
    assert status == 0
    first, second = out.splitlines()
    assert first.startswith("missing: pyusb is not installed (")
    assert second.startswith("missing: /no/libmesasr.so: the vendor's library is not installed (")


def test_info_usb_takes_no_camera_file(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "info", "usb", "--camera", "sr3000")
    assert (status, out) == (2, "")
    assert err == "rim: --camera: usb takes no camera file (leave --camera out)\n"


def test_a_file_named_usb_is_given_by_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "usb").write_bytes((ROOT / "calibration" / "sr2.yaml").read_bytes())
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, "info", "./usb")
    assert status == 2  # read as a recording, which it is not: a camera file ends in .yaml
    assert out == ""
    assert err.startswith("rim: usb: ")
