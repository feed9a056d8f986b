"""The interface of a camera."""

from __future__ import annotations

from typing import Protocol

from rim_camera_ros.frame import RawFrame


class Device(Protocol):
    """A source of raw frames: open, change settings, next frame, close.

    ``next_frame`` blocks until the next frame is due (for a device in real time). It returns None when there
    are no more frames, and once the device is closed. All methods raise `RimError` in one line. A device that
    failed can be closed and opened again.
    """

    @property
    def frame_rate(self) -> float:
        """Frames per second at present."""

    @property
    def image_roles(self) -> tuple[str, ...]:
        """Roles of the images of its frames (`rim_camera_ros.bags.topics`), once it is open."""

    def open(self) -> None:
        """Make the device ready; a no-op when it is."""

    def next_frame(self) -> RawFrame | None:
        """Return the next frame, or None at the end."""

    def set_integration_time(self, value: float | None) -> None:
        """Change the integration time (device's own unit) from the next frame on; None: the device's default.

        Raises `InputError` where the device cannot do that.
        """

    def set_frame_rate(self, value: float | None) -> None:
        """Change the frame rate in Hz from the next frame on; None: the device's default."""

    def close(self) -> None:
        """Release the device, from any thread; a pending `next_frame` returns None. No-op when closed."""
