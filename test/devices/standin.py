"""A SwissRanger that is a formula: its control file, what it delivers, and its side of pyusb."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import RawFrame

CONTROL_VARIABLE = "RIM_STANDIN_CONTROL"
#: Number of each modulation frequency in the library's enumeration.
FREQUENCY_NUMBERS = {40e6: 0, 30e6: 1, 21e6: 2, 20e6: 3, 19e6: 4}
ROWS, COLUMNS = 144, 176


class Control:
    """The file that both stand-ins read: what is plugged in and what goes wrong."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "control"
        self.count_path = folder / "count"
        self._values: dict[str, Any] = {}
        self._seen: list[int] = []
        self.set(plugged=1, count=self.count_path)

    def set(self, **values: Any) -> None:
        """Change values, all of them at once."""
        self._values |= values
        new = self.path.with_suffix(".new")
        new.write_text("".join(f"{key} {value}\n" for key, value in self._values.items()))
        os.replace(new, self.path)

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    @property
    def acquisitions(self) -> int:
        """Acquisitions of all processes so far."""
        return self.count_path.stat().st_size if self.count_path.exists() else 0

    def stands_still(self) -> bool:
        """Return whether there was no acquisition in the last twenty calls."""
        self._seen = [*self._seen[-19:], self.acquisitions]
        return len(self._seen) == 20 and len(set(self._seen)) == 1


def expected(frame: RawFrame, mode: int = 0) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the distance and amplitude that the formula gives with the settings that the frame states."""
    assert frame.settings.integration_time is not None
    assert frame.settings.modulation_frequency is not None
    v, u = np.mgrid[: frame.shape[0], : frame.shape[1]]
    amplitude = 2000 + 10 * int(frame.settings.integration_time) + 3 * u + 5 * v + 1000 * mode
    distance = 1000 + 131 * v + 7 * u + 64 * FREQUENCY_NUMBERS[frame.settings.modulation_frequency]
    distance[amplitude < int(frame.settings.extra["amplitude_threshold"])] = 0
    return distance, amplitude


def is_as_stated(frame: RawFrame, mode: int = 0) -> bool:
    """Return whether all pixels are what the formula gives with the settings that the frame states."""
    distance, amplitude = expected(frame, mode)
    return bool(np.array_equal(frame.distance, distance) and np.array_equal(frame.amplitude, amplitude))


def until(condition: Callable[[], bool], *, timeout: float = 10.0) -> float:
    """Wait for a condition and return the seconds that it took; fail where it does not come true."""
    begun, pause = time.monotonic(), threading.Event()
    while not condition():
        assert time.monotonic() - begun < timeout, "the condition did not come true"
        pause.wait(0.002)
    return time.monotonic() - begun


def usb_backend(control: Control, *cameras: tuple[int, int]) -> Any:
    """Return a backend of pyusb with cameras of these ids, an SR-3000 where none is given, and a mouse.

    Cameras are there while the control file says ``plugged``; ``usb_error`` there is the errno of claiming an
    interface, ``reset_error`` that of a reset. ``claimed`` holds what is claimed, ``resets`` counts.
    """
    import usb.backend
    import usb.core

    ids = cameras or ((0x1AD2, 0x0074),)

    class Backend(usb.backend.IBackend):
        def __init__(self) -> None:
            self.claimed: list[int] = []
            self.opened = self.closed = self.resets = self.listed = 0

        def enumerate_devices(self) -> Any:
            self.listed += 1
            return [(0x046D, 0xC077, 1), *((*one, 4 + i) for i, one in enumerate(ids) if control["plugged"])]

        def get_device_descriptor(self, dev: Any) -> Any:
            names = ("bDeviceClass", "bDeviceSubClass", "bDeviceProtocol")
            zero = dict.fromkeys((*names, "iManufacturer", "iProduct", "iSerialNumber"), 0)
            return SimpleNamespace(
                bLength=18, bDescriptorType=1, bcdUSB=0x200, bMaxPacketSize0=64, bcdDevice=0,
                bNumConfigurations=1, idVendor=dev[0], idProduct=dev[1], bus=3, address=dev[2],
                port_number=1, port_numbers=(1,), speed=3, **zero,
            )  # fmt: skip

        def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
            return SimpleNamespace(
                bLength=9, bDescriptorType=2, wTotalLength=18, bNumInterfaces=1, bConfigurationValue=1,
                iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
            )  # fmt: skip

        def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
            if intf or alt:
                raise IndexError
            return SimpleNamespace(
                bLength=9, bDescriptorType=4, bInterfaceNumber=2, bAlternateSetting=0, bNumEndpoints=0,
                bInterfaceClass=255, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0,
                extra_descriptors=[],
            )  # fmt: skip

        def open_device(self, dev: Any) -> Any:
            self.opened += 1
            return dev

        def close_device(self, dev_handle: Any) -> None:
            self.closed += 1

        def claim_interface(self, dev_handle: Any, intf: int) -> None:
            error = int(control._values.get("usb_error", 0))
            if error:
                raise usb.core.USBError(os.strerror(error), errno=error)
            self.claimed.append(intf)

        def release_interface(self, dev_handle: Any, intf: int) -> None:
            self.claimed.remove(intf)

        def reset_device(self, dev_handle: Any) -> None:
            error = int(control._values.get("reset_error", 0))
            if error:
                raise usb.core.USBError(os.strerror(error), errno=error)
            self.resets += 1

    return Backend()
