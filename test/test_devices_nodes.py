"""What the nodes do without ROS: pairing by stamp, and the acquisition thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from rim_camera_ros.bags.stamp_pairing import (
    CAPACITY,
    PATIENCE,
    RELIABLE_CAPACITY,
    RELIABLE_PATIENCE,
    StampPairing,
)
from rim_camera_ros.devices.acquisition import Acquisition
from rim_camera_ros.errors import DeviceError, RimError
from rim_camera_ros.frame import RawFrame, Settings

ALL = {"frame_info", "temperature", "ambient", "reference"}


def image(value: int) -> np.ndarray[Any, Any]:
    return np.full((2, 3), value, np.uint16)


def info(time: float = 100.0) -> tuple[Settings, str]:
    return Settings(integration_time=time, uptime=1.0), "SR-3000"


def pairing(published: Iterable[str] = ALL) -> StampPairing:
    names = set(published)
    return StampPairing(lambda role: role in names)


def fed(pairs: StampPairing, *parts: tuple[str, int, Any], now: float = 0.0) -> list[RawFrame]:
    return [frame for part in parts for frame in pairs.add(*part, now)]


def exposure(stamp: int) -> list[tuple[str, int, Any]]:
    """What a driver publishes with a frame, in its order."""
    return [
        ("temperature", stamp, 30.0),
        ("ambient", stamp, 20.0 + stamp),
        ("reference", stamp, 0.5),
        ("frame_info", stamp, info()),
        ("amplitude", stamp, image(9)),
        ("distance", stamp, image(stamp)),
    ]


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4, 5])
def test_a_frame_is_complete_in_any_order(order: int) -> None:
    pairs = pairing()
    parts = exposure(7)
    (frame,) = fed(pairs, *parts[order:], *parts[:order])
    assert frame.stamp == 7
    assert frame.device == "SR-3000"
    assert frame.distance[0, 0] == 7
    assert frame.settings.integration_time == 100.0
    assert (frame.settings.body_temperature, frame.settings.ambient_temperature) == (30.0, 27.0)
    assert frame.settings.reference_distance == 0.5
    assert not pairs.dropped


def test_nobody_waits_for_what_nobody_publishes() -> None:
    (frame,) = fed(pairing(()), ("distance", 1, image(1)), ("amplitude", 1, image(2)))
    assert frame.settings == Settings()


def test_readings_that_come_more_rarely_delay_the_first_frame_only() -> None:
    pairs = pairing()
    rare = [
        ("ambient", 3, 21.0),
        ("frame_info", 5, info()),
        ("amplitude", 5, image(9)),
        ("distance", 5, image(5)),
    ]
    assert fed(pairs, *rare, now=1.0) == []
    (frame,) = pairs.overdue(1.0 + PATIENCE)
    assert frame.settings.ambient_temperature == 21.0
    (frame,) = fed(pairs, *[(role, 6, value) for role, _, value in rare[1:]], now=2.0)
    assert frame.settings.ambient_temperature == 21.0  # the last one holds
    (frame,) = fed(pairs, ("ambient", 8, 22.0), *[(role, 7, value) for role, _, value in rare[1:]], now=2.0)
    assert frame.settings.ambient_temperature == 21.0  # not one from the future


def test_a_lost_frame_info_costs_its_frame() -> None:
    pairs = pairing()
    assert len(fed(pairs, *exposure(1))) == 1
    assert fed(pairs, *[part for part in exposure(2) if part[0] != "frame_info"]) == []
    frames = fed(pairs, *exposure(3))
    assert [one.stamp for one in frames] == [3]
    assert pairs.dropped == {"a pair without frame_info": 1}


def test_where_nothing_is_lost_a_late_frame_info_is_waited_for() -> None:
    """A topic whose publisher is discovered late delivers all that it kept, behind the images."""
    pairs = StampPairing(ALL.__contains__, patience=RELIABLE_PATIENCE)
    for stamp in range(1, 21):
        late = [part for part in exposure(stamp) if part[0] != "frame_info"]
        assert fed(pairs, *late, now=0.04 * stamp) == []
    frames = fed(pairs, *[("frame_info", stamp, info(stamp)) for stamp in range(1, 18)], now=4.0)
    assert [(one.stamp, one.settings.integration_time) for one in frames] == [(i, i) for i in range(1, 18)]
    assert [one.settings.ambient_temperature for one in frames] == [20.0 + i for i in range(1, 18)]
    # that of 20 is there: those of 18 and 19 were lost
    frames = fed(pairs, ("frame_info", 20, info(20)), now=4.1)
    assert [(one.stamp, one.settings.integration_time) for one in frames] == [(20, 20)]
    assert pairs.dropped == {"a pair without frame_info": 2}
    assert fed(pairs, *[part for part in exposure(21) if part[0] != "frame_info"], now=5.0) == []
    assert pairs.overdue(4.9 + RELIABLE_PATIENCE) == []
    assert pairs.dropped == {"a pair without frame_info": 2}
    assert pairs.overdue(5.1 + RELIABLE_PATIENCE) == []
    assert pairs.dropped == {"a pair without frame_info": 3}


def test_pairs_of_seconds_wait_where_nothing_is_lost() -> None:
    """A frame_info that is 4 s late, at 30 Hz."""
    pairs = StampPairing(ALL.__contains__, patience=RELIABLE_PATIENCE, capacity=RELIABLE_CAPACITY)
    for stamp in range(1, 121):
        assert (
            fed(pairs, *[part for part in exposure(stamp) if part[0] != "frame_info"], now=stamp / 30) == []
        )
    frames = [
        frame.stamp
        for stamp in range(1, 121)
        for frame in fed(pairs, ("frame_info", stamp, info(stamp)), now=4.0 + stamp / 30)
    ]
    assert frames == [*range(1, 121)]
    assert not pairs.dropped


def test_pairs_that_wait_are_bounded_and_counted() -> None:
    pairs = StampPairing(ALL.__contains__, patience=RELIABLE_PATIENCE)
    for stamp in range(1, CAPACITY + 4):
        assert fed(pairs, *[part for part in exposure(stamp) if part[0] != "frame_info"]) == []
    assert pairs.dropped == {"a pair without frame_info": 3}


def test_halves_are_counted_and_forgotten() -> None:
    pairs = pairing(())
    fed(pairs, ("distance", 1, image(1)), ("amplitude", 2, image(2)))  # before the first pair: somebody joins
    fed(pairs, ("distance", 3, image(1)), ("amplitude", 3, image(2)))
    assert not pairs.dropped
    fed(pairs, ("distance", 4, image(1)), ("amplitude", 5, image(2)))
    frames = fed(pairs, ("distance", 6, image(1)), ("amplitude", 6, image(2)))
    assert [one.stamp for one in frames] == [6]
    assert pairs.dropped == {"distance without amplitude": 1, "amplitude without distance": 1}
    for stamp in range(100, 100 + 3 * CAPACITY):
        fed(pairs, ("distance", stamp, image(1)))
    assert pairs.dropped["distance without amplitude"] == 1 + 2 * CAPACITY
    assert fed(pairs, ("distance", 99 + 3 * CAPACITY, image(1))) == []
    assert pairs.dropped["distance twice with one stamp"] == 1


def test_a_refused_message_costs_its_exposure_only() -> None:
    pairs = pairing(())
    fed(pairs, ("amplitude", 1, image(1)))
    pairs.refuse(1, "distance refused")
    pairs.refuse(1, "distance refused")
    assert fed(pairs, ("distance", 1, image(1)), ("amplitude", 1, image(1))) == []
    assert len(fed(pairs, ("distance", 2, image(1)), ("amplitude", 2, image(1)))) == 1
    assert pairs.dropped == {"distance refused": 1}


def test_a_recording_that_begins_anew() -> None:
    pairs = pairing()
    stamps = [one.stamp for stamp in (10, 11, 12, 1, 2, 3) for one in fed(pairs, *exposure(stamp))]
    assert stamps == [10, 11, 12, 1, 2, 3]


# --- acquisition --------------------------------------------------------------------------------


class Camera:
    """A device that delivers what the test gives it: frames, None or errors."""

    frame_rate = 1.0

    def __init__(
        self, *script: RawFrame | Exception | None, opening: Iterable[Exception | None] = ()
    ) -> None:
        self.script = list(script)
        self.opening = list(opening)
        self.opened = self.closed = 0
        self._closed = threading.Event()

    def open(self) -> None:
        self.opened += 1
        fault = self.opening.pop(0) if self.opening else None
        if fault is not None:
            raise fault
        self._closed.clear()

    def next_frame(self) -> RawFrame | None:
        if not self.script:
            self._closed.wait(10.0)
            return None
        item = self.script.pop(0)
        if isinstance(item, Exception):
            raise item
        return item

    def set_integration_time(self, value: float | None) -> None: ...

    def set_frame_rate(self, value: float | None) -> None: ...

    def close(self) -> None:
        self.closed += 1
        self._closed.set()


class Log:
    """A listener that writes down what it receives."""

    def __init__(self, enough: int = 100) -> None:
        self.said: list[Any] = []
        self._enough = enough
        self._changed = threading.Condition()

    def _say(self, what: Any) -> None:
        with self._changed:
            self.said.append(what)
            self._changed.notify_all()

    def until(self, condition: Callable[[list[Any]], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.said), 10.0), self.said

    def on_frame(self, frame: RawFrame) -> bool:
        self._say(frame.stamp)
        return len(self.said) < self._enough

    def on_end(self) -> None:
        self._say("end")

    def on_fault(self, error: RimError, retry_in: float | None) -> None:
        self._say((str(error), retry_in))

    def on_recovery(self) -> None:
        self._say("recovered")


def frame(stamp: int) -> RawFrame:
    return RawFrame(stamp=stamp, distance=image(1), amplitude=image(1))


@pytest.fixture(autouse=True)
def _no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rim_camera_ros.devices.acquisition._RETRY", 0.01)


def test_a_device_that_fails_is_opened_again() -> None:
    log = Log()
    camera = Camera(
        frame(1),
        DeviceError("unplugged"),
        frame(2),
        ValueError("odd"),
        frame(3),
        opening=[DeviceError("still"), None],
    )
    acquisition = Acquisition(camera, log)
    acquisition.start()
    log.until(lambda said: 3 in said)
    acquisition.stop()
    unexpected = ("unexpected ValueError: odd (please report this)", 0.01)
    assert log.said[:7] == [1, ("unplugged", 0.01), ("still", 0.02), "recovered", 2, unexpected, "recovered"]
    assert camera.opened == 3
    assert camera.closed >= 3


def test_without_another_try_a_fault_is_the_end() -> None:
    log = Log()
    acquisition = Acquisition(Camera(frame(1), DeviceError("damaged"), frame(2)), log, retry=False)
    acquisition.start()
    log.until(lambda said: len(said) == 2)
    acquisition.exchange(Camera(frame(7), None))  # but another device is taken
    log.until(lambda said: "end" in said)
    acquisition.stop()
    assert log.said == [1, ("damaged", None), 7, "end"]


def test_devices_are_exchanged_between_frames() -> None:
    log = Log()
    first, second, third = Camera(frame(1)), Camera(frame(2)), Camera(frame(3))
    acquisition = Acquisition(first, log)
    acquisition.start()
    log.until(lambda said: said == [1])
    acquisition.exchange(second)
    assert acquisition.device is second
    acquisition.exchange(third)
    log.until(lambda said: 3 in said)
    assert acquisition.device is third
    acquisition.stop()
    assert log.said in ([1, 3], [1, 2, 3])
    assert first.closed
    assert second.closed
    assert third.closed


def test_the_listener_ends_it() -> None:
    log = Log(enough=2)
    acquisition = Acquisition(Camera(frame(1), frame(2), frame(3)), log)
    acquisition.start()
    log.until(lambda said: len(said) == 2)
    acquisition.stop()
    assert log.said == [1, 2]
