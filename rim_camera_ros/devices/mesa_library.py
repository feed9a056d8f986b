"""The vendor's library libmesasr, by ctypes: the few functions that a SwissRanger needs.

The library is proprietary and not part of this package; the user installs it. Signatures are those of its
public header libMesaSR.h: the camera is a pointer to an opaque object, and `SR_GetImage` returns a pointer
(an int would truncate both). The packed structure ImgEntry is avoided. Only versions with known enumerations
are used. Nothing here imports numpy, so that the acquisition process starts fast.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Iterable, Mapping
from typing import Any

from rim_camera_ros.devices.swissranger_settings import CameraSettings, mode_bits
from rim_camera_ros.errors import DeviceError, InputError, RimError

#: Environment variable that names the library's file.
LIBRARY_VARIABLE = "RIM_LIBMESASR"
#: Default names under which the library is looked for; the second is that of the package.
LIBRARY_NAMES = ("libmesasr.so", "libmesasr.so.1.0.14")

#: Enumeration ModulationFrq in Hz, by the first three numbers of the library's version. Libraries of 2007 and
#: earlier number it differently (0 is 30 MHz): a wrong guess would give a wrong ambiguity range.
_FREQUENCIES: Mapping[tuple[int, int, int], tuple[float, ...]] = {
    (1, 0, 14): (40e6, 30e6, 21e6, 20e6, 19e6, 60e6, 15e6, 10e6, 29e6, 31e6, 14.5e6, 15.5e6),
}
#: SR_SetAutoExposure with this least integration time turns it off.
_AUTO_EXPOSURE_OFF = (255, 0, 0, 0)
#: Index of the images in SR_GetImage.
_DISTANCE, _AMPLITUDE = 0, 1
_BYTES_PER_VALUE = 2

_CAMERA = ctypes.c_void_p
_U8, _U16, _UINT, _INT = ctypes.c_ubyte, ctypes.c_ushort, ctypes.c_uint, ctypes.c_int
#: Result and arguments of each function that is used.
_SIGNATURES: Mapping[str, tuple[Any, tuple[Any, ...]]] = {
    "SR_GetVersion": (_INT, (ctypes.POINTER(_U16),)),
    "SR_OpenUSB": (_INT, (ctypes.POINTER(_CAMERA), _UINT)),
    "SR_Close": (_INT, (_CAMERA,)),
    "SR_GetDeviceString": (_INT, (_CAMERA, ctypes.c_char_p, _INT)),
    "SR_ReadSerial": (_UINT, (_CAMERA,)),
    "SR_SetTimeout": (None, (_CAMERA, _INT)),
    "SR_GetRows": (_UINT, (_CAMERA,)),
    "SR_GetCols": (_UINT, (_CAMERA,)),
    "SR_Acquire": (_INT, (_CAMERA,)),
    "SR_GetImage": (ctypes.c_void_p, (_CAMERA, _U8)),
    "SR_SetMode": (_INT, (_CAMERA, _INT)),
    "SR_GetMode": (_INT, (_CAMERA,)),
    "SR_SetIntegrationTime": (_INT, (_CAMERA, _U8)),
    "SR_GetIntegrationTime": (_U8, (_CAMERA,)),
    "SR_SetAmplitudeThreshold": (_INT, (_CAMERA, _U16)),
    "SR_GetAmplitudeThreshold": (_U16, (_CAMERA,)),
    "SR_SetModulationFrequency": (_INT, (_CAMERA, _INT)),
    "SR_GetModulationFrequency": (_INT, (_CAMERA,)),
    "SR_SetAutoExposure": (_INT, (_CAMERA, _U8, _U8, _U8, _U8)),
}


class ShortFrame(DeviceError):
    """The library transferred fewer bytes than two images."""


class MesaLibrary:
    """The loaded library. ``path``: its file; None: that of `LIBRARY_VARIABLE`, or the system's.

    Raises `InputError` where it cannot be loaded, lacks a function or is of an unknown version. ``version``
    is its version, for example ``1.0.14.747``.
    """

    def __init__(self, path: str | None = None) -> None:
        path = path or os.environ.get(LIBRARY_VARIABLE) or None
        self.file, self._library = _loaded([path] if path else LIBRARY_NAMES, given=path is not None)
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._library, name, None)
            if function is None:
                raise InputError(
                    f"has no function {name}", file=self.file, remedy="install libmesasr 1.0.14 of the vendor"
                )
            function.restype, function.argtypes = result, arguments
        numbers = (_U16 * 4)()
        self._library.SR_GetVersion(numbers)
        parts = tuple(reversed(numbers))
        self.version = ".".join(map(str, parts))
        frequencies = _FREQUENCIES.get((parts[0], parts[1], parts[2]))
        if frequencies is None:
            known = ", ".join(".".join(map(str, frequency)) for frequency in _FREQUENCIES)
            raise InputError(
                f"version {self.version} numbers its modulation frequencies in an unknown way",
                file=self.file,
                remedy=f"known: {known}",
            )
        self.frequencies = frequencies

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function; its signature is declared above."""
        return getattr(self._library, name)(*arguments)

    def open(self, *, serial: int = 0, timeout: float = 1.0) -> MesaCamera:
        """Open the camera of a serial number on USB; 0: the first. ``timeout`` [s] of every transfer.

        Raises `DeviceError` where there is none.
        """
        handle = _CAMERA()
        opened = self.call("SR_OpenUSB", ctypes.byref(handle), serial)
        if opened <= 0 or not handle.value:
            which = f"the camera with serial number 0x{serial:08x}" if serial else "a camera"
            raise DeviceError(
                f"libmesasr cannot open {which} (SR_OpenUSB returned {opened})",
                remedy="rim info usb shows what is connected and what is missing",
            )
        self.call("SR_SetTimeout", handle, round(timeout * 1000))
        return MesaCamera(self, handle)


class MesaCamera:
    """An open camera. Where a function of the library fails, `DeviceError` states its name and result."""

    def __init__(self, library: MesaLibrary, handle: ctypes.c_void_p) -> None:
        self._library = library
        self._handle = handle
        buffer = ctypes.create_string_buffer(512)
        self._call("SR_GetDeviceString", buffer, len(buffer) - 1)
        self.device_string = buffer.value.decode("latin-1")
        self.serial = int(self._call("SR_ReadSerial"))
        self.rows, self.columns = int(self._call("SR_GetRows")), int(self._call("SR_GetCols"))
        self.defaults = self._read()

    @property
    def usb_ids(self) -> tuple[int, int] | None:
        """Vendor and product id by the device string, None where it does not contain them."""
        found = re.search(r"VendorID:0x([0-9a-fA-F]{4}).*ProductID:0x([0-9a-fA-F]{4})", self.device_string)
        return None if found is None else (int(found[1], 16), int(found[2], 16))

    @property
    def image_size(self) -> int:
        """Bytes of one image."""
        return self.rows * self.columns * _BYTES_PER_VALUE

    def apply(self, settings: CameraSettings) -> None:
        """Set all settings; those that are None get the value found when the camera was opened.

        Raises `DeviceError` for the first setting that the camera refuses; those before it remain set.
        """
        defaults, library = self.defaults, self._library
        self._set("SR_SetMode", mode_bits(settings.mode))
        auto = settings.auto_exposure
        limits = (auto.least, auto.greatest, auto.percent_over, auto.position) if auto else _AUTO_EXPOSURE_OFF
        self._set("SR_SetAutoExposure", *limits)
        if auto is None:
            given = settings.integration_time
            time = defaults["integration_time"] if given is None else int(given)
            self._set("SR_SetIntegrationTime", time)
        wanted = settings.modulation_frequency
        number = defaults["modulation_frequency"] if wanted is None else library.frequencies.index(wanted)
        if number != self._call("SR_GetModulationFrequency"):
            self._set("SR_SetModulationFrequency", number)
        self._set("SR_SetAmplitudeThreshold", int(settings.amplitude_threshold))

    def state(self) -> dict[str, Any]:
        """Return the settings that are in force, by the library.

        ``integration_time`` (register), ``modulation_frequency`` [Hz, None where its number is unknown],
        ``amplitude_threshold`` [counts], ``mode`` (bits).
        """
        now = self._read()
        number, known = now["modulation_frequency"], self._library.frequencies
        return {**now, "modulation_frequency": known[number] if 0 <= number < len(known) else None}

    def acquire(self) -> None:
        """Expose and transfer a frame. Raises `ShortFrame`, or `DeviceError` where the library failed."""
        transferred = self._call("SR_Acquire")
        if transferred < 0:
            raise DeviceError(
                f"the transfer of a frame failed (SR_Acquire returned {transferred})",
                remedy="check the cable and the camera's power",
            )
        if transferred < 2 * self.image_size:
            raise ShortFrame(f"a frame has {transferred} bytes instead of {2 * self.image_size}")

    def copy_images(self, address: int) -> None:
        """Copy distance and amplitude, uint16 (rows, columns) each, one after the other to an address."""
        for offset, index in ((0, _DISTANCE), (self.image_size, _AMPLITUDE)):
            image = self._call("SR_GetImage", index)
            if not image:
                raise DeviceError(f"libmesasr has no image {index} (SR_GetImage returned NULL)")
            ctypes.memmove(address + offset, image, self.image_size)

    def close(self) -> None:
        """Release the camera."""
        self._library.call("SR_Close", self._handle)

    def _read(self) -> dict[str, int]:
        return {
            "integration_time": int(self._call("SR_GetIntegrationTime")),
            "modulation_frequency": int(self._call("SR_GetModulationFrequency")),
            "amplitude_threshold": int(self._call("SR_GetAmplitudeThreshold")),
            "mode": int(self._call("SR_GetMode")),
        }

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._library.call(name, self._handle, *arguments)

    def _set(self, name: str, *arguments: int) -> None:
        result = self._call(name, *arguments)
        if result < 0:
            values = ", ".join(map(str, arguments))
            raise DeviceError(f"the camera refused {name}({values}), result {result}")


def _loaded(names: Iterable[str], *, given: bool) -> tuple[str, ctypes.CDLL]:
    reason = ""
    for name in names:
        try:
            return name, ctypes.CDLL(name)
        except OSError as error:
            # of several names, the error of one that was found is more useful than that of one not found
            absent = str(error).startswith(f"{name}: cannot open")
            reason = reason if absent and reason else str(error)
    raise _unloadable(next(iter(names)), reason, given=given)


def _unloadable(name: str, reason: str, *, given: bool) -> RimError:
    missing = reason.partition(":")[0]
    if "cannot open shared object file" in reason and os.path.basename(missing) != os.path.basename(name):
        return InputError(
            f"needs {missing}, which is missing", file=name, remedy=f"install the package that has {missing}"
        )
    if "cannot open shared object file" not in reason:
        remedy = "install libmesasr 1.0.14 of the vendor for this processor"
        return InputError(f"cannot be loaded: {reason}", file=name, remedy=remedy)
    remedy = "give the path of the library" if given else f"install it, or set {LIBRARY_VARIABLE} to its path"
    return InputError("the vendor's library is not installed", file=name, remedy=f"{remedy}; docs/sr3000.md")
