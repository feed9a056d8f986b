"""What readers of the topics get from the messages, with messages of rosbags and hand-made ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rim_camera_ros import messages
from rim_camera_ros.bags.messages import frame_info_message, points_message
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Settings


def array(name: str, level: Any = b"\x00", hardware: str = "", **values: str) -> Any:
    pairs = [SimpleNamespace(key=key, value=value) for key, value in values.items()]
    status = SimpleNamespace(name=name, level=level, message="words", hardware_id=hardware, values=pairs)
    return SimpleNamespace(status=[status])


def test_frame_info_of_a_recording() -> None:
    settings = Settings(
        integration_time=60.0, modulation_frequency=2.1e7, uptime=12.5, extra={"serial_number": "0x1f"}
    )
    read = messages.frame_info(frame_info_message(settings, 1_700_000_000_000_000_123, "SR-3000"))
    assert (read.stamp, read.device, read.settings) == (1_700_000_000_000_000_123, "SR-3000", settings)


def test_statuses_by_name_with_levels_of_both_kinds() -> None:
    for level in (b"\x01", 1):
        found = messages.statuses(array("/camera/driver: frames", level, rate_hz="24.98", latency="unknown"))
        status = found["/camera/driver: frames"]
        assert status.level == 1
        assert status.number("rate_hz") == 24.98
        assert status.number("latency") is None
        assert status.number("jitter") is None


def test_device_info_with_and_without_keys() -> None:
    full = messages.device_info(
        array(
            "device_info",
            hardware="SR-3000",
            source="SwissRanger on USB",
            serial_number="0x0000002a",
            modulation_frequency="20000000",
            file="/opt/lab/mine.yaml",
            file_sha256="ab" * 32,
        )
    )
    assert (full.device, full.serial_number, full.modulation_frequency) == ("SR-3000", "0x0000002a", 20e6)
    assert (full.file, full.file_sha256) == ("/opt/lab/mine.yaml", "ab" * 32)
    assert full.firmware is None
    empty = messages.device_info(array("device_info"))
    assert (empty.file, empty.modulation_frequency, empty.device) == (None, None, "")
    with pytest.raises(InputError, match="the message of device_info has no status"):
        messages.device_info(SimpleNamespace(status=[]))


def test_progress_and_results() -> None:
    half = messages.progress(
        array("progress", state="calibrating", stage="fit", done="3", total="12", seconds="7.5")
    )
    assert (half.state, half.stage, half.fraction, half.seconds) == ("calibrating", "fit", 0.25, 7.5)
    assert messages.progress(array("progress", state="recording", done="7")).fraction is None
    done = messages.result(
        array(
            "result",
            state="done",
            file="a.yaml",
            systematic_mm="4.250",
            chi_square="1.0312",
            effects="cyclic_error, amplitude_offset",
        )
    )
    assert done.systematic == pytest.approx(0.00425)
    assert (done.chi_square, done.effects) == (1.0312, ("cyclic_error", "amplitude_offset"))
    failed = messages.result(
        array("result", state="failed", reason="no frames", effects="none", chi_square="")
    )
    assert (failed.state, failed.reason, failed.effects, failed.chi_square) == (
        "failed",
        "no frames",
        (),
        None,
    )


def test_the_plain_cloud_of_a_recording() -> None:
    points = np.random.default_rng(5).normal(size=(4, 7, 4)).astype(np.float32)
    points[1, 2, :3] = np.nan
    read = messages.cloud(points_message(points, 10**18))
    assert list(read) == ["x", "y", "z", "intensity"]
    for i, name in enumerate(read):
        assert np.array_equal(read[name], points[..., i], equal_nan=True)


def test_a_cloud_with_further_fields() -> None:
    layout = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "sigma")] + [("flags", "<u4")])
    made = np.zeros((3, 5), layout)
    made["z"], made["sigma"] = 2.5, np.arange(15).reshape(3, 5) / 100
    made["flags"] = np.arange(15).reshape(3, 5)
    fields = [
        SimpleNamespace(name=name, offset=4 * i, datatype=2 if name == "flags" else 7)
        for i, name in enumerate(layout.names or ())
    ]
    message = SimpleNamespace(
        fields=fields,
        height=3,
        width=5,
        point_step=24,
        row_step=120,
        is_bigendian=False,
        data=made.tobytes(),
    )
    read = messages.cloud(message)
    assert np.array_equal(read["sigma"], made["sigma"])
    assert (read["flags"].dtype, read["flags"][2, 4]) == (np.uint8, 14)
    assert messages.flag_names(6) == ["SATURATED", "MIXED_PIXEL"]
    assert messages.flag_names(0) == []
    fields[5].datatype = 5
    with pytest.raises(InputError, match="the field flags is neither uint8 nor float32"):
        messages.cloud(message)
    fields[5].datatype, fields[5].offset = 7, 22
    with pytest.raises(InputError, match="the field flags"):
        messages.cloud(message)
