"""SwissRangers on USB: which are connected, whether they can be used, what is missing; and their reset.

This uses pyusb, which is optional. It only reads descriptors, and claims and releases an interface: the
camera's own protocol is not public, and frames come through the vendor's library
(`rim_camera_ros.devices.mesa_library`).
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rim_camera_ros.errors import DeviceError

State = Literal["ready", "no permission", "busy", "failed"]


@dataclass(frozen=True, slots=True)
class Model:
    """A camera model: its name and the size of its images in pixels, None where it is not supported."""

    name: str
    columns: int | None = None
    rows: int | None = None


#: Models by vendor and product id.
MODELS: Mapping[tuple[int, int], Model] = {
    (0x0852, 0x0071): Model("SR-2", 160, 124),
    (0x0852, 0x0074): Model("SR-3000", 176, 144),
    (0x1AD2, 0x0074): Model("SR-3000", 176, 144),
    (0x1AD2, 0x0075): Model("SR-4000"),
}
#: File for the rules of `udev_rules`; its number is below 73, at which udev gives the user of the seat
#: access.
RULES_FILE = "/etc/udev/rules.d/70-swissranger.rules"
RELOAD = "sudo udevadm control --reload && sudo udevadm trigger"


@dataclass(frozen=True, slots=True, kw_only=True)
class UsbCamera:
    """A connected camera. ``state``: whether it can be used; ``detail``: the reason why not."""

    vendor: int
    product: int
    bus: int
    address: int
    state: State
    detail: str = ""

    @property
    def model(self) -> Model:
        return MODELS[self.vendor, self.product]

    @property
    def file(self) -> str:
        """The device file."""
        return f"/dev/bus/usb/{self.bus:03d}/{self.address:03d}"

    def error(self) -> DeviceError | None:
        """Return why it cannot be used, and the remedy; None where it can be used."""
        if self.model.columns is None:
            return DeviceError(
                f"the {self.model.name} is not supported", file=self.file, remedy="connect an SR-2 or SR-3000"
            )
        if self.state == "no permission":
            rule = udev_rule(self.vendor, self.product)
            remedy = f"write to {RULES_FILE}: {rule} then: {RELOAD}, and plug the camera in anew"
            return DeviceError(f"no permission to use the {self.model.name}", file=self.file, remedy=remedy)
        if self.state == "busy":
            by = f" ({self.detail})" if self.detail else ""
            return DeviceError(
                f"another process has the {self.model.name}{by}", file=self.file, remedy="end that process"
            )
        if self.state == "failed":
            return DeviceError(
                f"the {self.model.name} does not answer: {self.detail}",
                file=self.file,
                remedy="plug it in anew",
            )
        return None


class UsbUnavailable(DeviceError):
    """Pyusb or libusb is missing: it is unknown which cameras are connected."""


class UsbCameras:
    """The connected cameras. ``backend``: that of pyusb; None: libusb."""

    def __init__(self, backend: Any = None) -> None:
        self._backend = backend
        self._missing: UsbUnavailable | None = None

    def find(self) -> list[UsbCamera]:
        """Return the connected cameras with their states. Raises `UsbUnavailable`."""
        with self._devices() as devices:
            return [self._described(device) for device in devices]

    def check(self) -> None:
        """Raise `DeviceError`, with a remedy, where no camera can be used; no-op without pyusb.

        One usable camera is enough if there are several.
        """
        try:
            cameras = self.find()
        except UsbUnavailable:
            return
        if not cameras:
            known = ", ".join(f"{vendor:04x}:{product:04x}" for vendor, product in MODELS)
            raise DeviceError(
                f"no SwissRanger is connected to USB (ids {known})",
                remedy="plug it in and switch it on; it is taken by itself then",
            )
        errors = [camera.error() for camera in cameras]
        if all(errors):
            assert errors[0] is not None
            raise errors[0]

    def reset(self) -> int:
        """Reset the ports of all supported cameras that no other process uses, and return their number.

        Raises `UsbUnavailable`, and `DeviceError` where a reset failed.
        """
        count = 0
        with self._devices() as devices:
            import usb.core

            for device in devices:
                camera = self._described(device)
                if camera.error() is not None:
                    continue
                try:
                    device.reset()
                except usb.core.USBError as error:
                    problem = f"the {camera.model.name} cannot be reset: {error.strerror or error}"
                    raise DeviceError(problem, file=camera.file, remedy="plug it in anew") from None
                count += 1
        return count

    @contextmanager
    def _devices(self) -> Iterator[list[Any]]:
        if self._missing is not None:  # looking for libusb again takes a tenth of a second
            raise self._missing
        try:
            import usb.core
            import usb.util
        except ImportError:
            raise UsbUnavailable(
                "pyusb is not installed", remedy="sudo apt install python3-usb, or pip install pyusb"
            ) from None

        def known(device: Any) -> bool:
            return (device.idVendor, device.idProduct) in MODELS

        try:
            devices = list(usb.core.find(find_all=True, custom_match=known, backend=self._backend))
        except usb.core.NoBackendError:
            self._missing = UsbUnavailable(
                "libusb 1.0 is not installed", remedy="sudo apt install libusb-1.0-0"
            )
            raise self._missing from None
        except usb.core.USBError as error:
            raise UsbUnavailable(
                f"libusb cannot list devices: {error}", remedy="check /dev/bus/usb"
            ) from None
        try:
            yield sorted(devices, key=lambda device: (device.bus or 0, device.address or 0))
        finally:
            for device in devices:
                usb.util.dispose_resources(device)

    def _described(self, device: Any) -> UsbCamera:
        import usb.core
        import usb.util

        state: State = "ready"
        detail = ""
        bus, address = int(device.bus or 0), int(device.address or 0)
        try:
            number = device[0][(0, 0)].bInterfaceNumber
            usb.util.claim_interface(device, number)
            usb.util.release_interface(device, number)
        except usb.core.USBError as error:
            state = {errno.EACCES: "no permission", errno.EPERM: "no permission", errno.EBUSY: "busy"}.get(
                error.errno, "failed"
            )  # type: ignore[assignment]
            detail = str(error.strerror or error)
            if state == "busy":
                detail = ", ".join(users_of(f"/dev/bus/usb/{bus:03d}/{address:03d}"))
        finally:
            usb.util.dispose_resources(device)
        return UsbCamera(
            vendor=device.idVendor,
            product=device.idProduct,
            bus=bus,
            address=address,
            state=state,
            detail=detail,
        )


def users_of(file: str) -> list[str]:
    """Return the processes that have a file open, as far as this user may see them: ``name, process 12``."""
    found = []
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(link) != file:
                continue
            process = link.parts[2]
            name = Path("/proc", process, "comm").read_text().strip()
        except OSError:  # it has ended, or belongs to somebody else
            continue
        text = f"{name}, process {process}"
        if text not in found and int(process) != os.getpid():
            found.append(text)
    return found


def udev_rule(vendor: int, product: int) -> str:
    """Return the udev rule that gives the user of the seat and the group plugdev access to a model."""
    return (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}", '
        'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
    )


def udev_rules() -> str:
    """Return the file of udev rules for all supported models."""
    lines = ["# SwissRanger cameras: access for the user of the seat and the group plugdev."]
    lines += [f"# {model.name}\n{udev_rule(*ids)}" for ids, model in MODELS.items() if model.columns]
    return "\n".join(lines) + "\n"
