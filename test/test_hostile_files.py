"""Files made to do harm: a line that says what is wrong, little time, little memory."""

from __future__ import annotations

# ruff: noqa: E501 -- one fault a line
import bz2
import os
import resource
import shutil
import struct
import time
import zipfile
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Reader as Bag1Reader
from rosbags.rosbag2 import CompressionMode

from rim_camera_ros.bags import Recording, compress
from rim_camera_ros.bags.compress import CompressionError, decompress, decompress_file
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.npy_files import read_npy

from .helpers_bags import pair, write_bag1
from .helpers_bags import write_bag as write_lines
from .helpers_cli import CAMERA, SCENE, nothing_left, run, write_text

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def simulate(capsys: Capture, tmp_path: Path) -> Callable[..., str]:
    """Return the error of ``rim simulate`` with a camera and a scene, which takes seconds at most."""

    def check(camera: str, scene: str = SCENE) -> str:
        write_text(tmp_path / "camera.yaml", camera)
        write_text(tmp_path / "scene.yaml", scene)
        arguments = ("simulate", tmp_path / "scene.yaml", "--camera", tmp_path / "camera.yaml")
        began = time.process_time()
        with nothing_left(tmp_path):
            status, out, error = run(capsys, *arguments, "--out", tmp_path / "bag", "--quiet")
        assert time.process_time() - began < 10
        assert (status, out, len(error.splitlines())) == (2, "", 1), error
        assert "fault of the program" not in error
        return error

    return check


def npy(header: bytes, content: bytes = b"", *, version: bytes = b"\x01\x00") -> bytes:
    header += b" " * (63 - (10 + len(header)) % 64) + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + content


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("map.npy", b"0" * 100)


HEADER = b"{'descr': '<f4', 'fortran_order': False, 'shape': (9, 12), }"
ARRAYS: dict[str, tuple[bytes | Callable[[Path], None], str]] = {
    "zip": (zipped, "header is damaged or of another kind"),
    "zip cut off": (b"PK\x03\x04" + b"\0" * 40, "header is damaged or of another kind"),
    "nested": (npy(b"(" * 500 + b")" * 500), "header is damaged"),
    "nested deeper": (npy(b"(" * 9000 + b")" * 9000), "header is damaged"),
    "minus signs": (npy(b"-" * 9000 + b"1"), "header is damaged"),
    "large header": (npy(HEADER + b" " * 30000), "header is damaged"),
    "code": (npy(b"__import__('os').system('true')"), "header is damaged"),
    "no bytes": (b"", "header is damaged"),
    "version": (npy(HEADER, b"\0" * 432, version=b"\x09\x00"), "header is damaged"),
    "pickles": (npy(HEADER.replace(b"<f4", b"|O"), b"cos\nsystem\n(S'true'\ntR."), "holds no real numbers"),
    "huge": (npy(HEADER.replace(b"(9, 12)", b"(1000000, 1000000)")), "4000000000000 bytes are stated, 0 are there"),
    "overflowing": (npy(HEADER.replace(b"(9, 12)", b"(" + b"9" * 300 + b", 12)")), "bytes are stated, 0 are there"),
    "negative": (npy(HEADER.replace(b"(9, 12)", b"(-9, 12)"), b"\0" * 432), "states a negative size"),
    "texts": (npy(HEADER.replace(b"<f4", b"<U4"), b"\0" * 4320), "holds no real numbers"),
    "cut off": (npy(HEADER, b"\0" * 431), "432 bytes are stated, 431 are there"),
}  # fmt: skip


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays(simulate: Callable[..., str], tmp_path: Path, kind: str) -> None:
    content, match = ARRAYS[kind]
    path = tmp_path / "bad.npy"
    content(path) if callable(content) else path.write_bytes(content)
    error = simulate(CAMERA + "effects: {fixed_pattern_offset: {map: bad.npy}}\n")
    assert "effects.fixed_pattern_offset.map (line 7): 'bad.npy' " in error
    assert any(one in error for one in match.split("|")), error


@pytest.mark.parametrize("kind", [(np.float32, "C"), (np.float64, "F"), (">f4", "C"), (np.uint16, "F")])
def test_good_arrays_are_read(tmp_path: Path, kind: tuple[Any, str]) -> None:
    values = np.asarray(np.arange(24).reshape(2, 3, 4), dtype=kind[0], order=kind[1])  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", values)
    assert np.array_equal(read_npy(tmp_path / "a.npy"), values)
    np.save(tmp_path / "b.npy", np.float64(2.5))
    assert read_npy(tmp_path / "b.npy") == 2.5


NAMES = {
    r'"a\0b.npy"': r"'a\x00b.npy' is not a .npy file in the folder",
    '"' + "a" * 5000 + '.npy"': "cannot be read: File name too long",
    '"loop.npy"': "is not a .npy file in the folder|no such file|cannot be read",
    '"pipe.npy"': "'pipe.npy' is not a file",
    '"folder.npy"': "'folder.npy' is not a file",
    r'"\e[2J.npy"': r"no such file '\x1b[2J.npy'",
}


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_names_of_arrays(simulate: Callable[..., str], tmp_path: Path, name: str) -> None:
    (tmp_path / "loop.npy").symlink_to("loop.npy")
    (tmp_path / "folder.npy").mkdir()
    os.mkfifo(tmp_path / "pipe.npy")
    error = simulate(CAMERA + f"effects: {{fixed_pattern_offset: {{map: {name}}}}}\n")
    assert any(one in error for one in NAMES[name].split("|")), error
    assert error.strip().isprintable()
    assert len(error) < 500 + len(str(tmp_path))


NUMBERS = {
    "noise.floor (line 6): must be at most 1e+06 m, found 1e+300": CAMERA.replace("floor: 0.004", "floor: 1e300"),
    "noise.amplitude (line 6): must be at most 1e+12 m*counts": CAMERA.replace("amplitude: 20.0", "amplitude: 1e300"),
    "sensor.modulation_frequency (line 4): must be at most 1e+12 Hz": CAMERA.replace("20.0e6", "1e300"),
    "sensor.modulation_frequency (line 4): must be at least 1000 Hz, found 1e-300": CAMERA.replace("20.0e6", "1e-300"),
    "effects.scattering.kernels.0.sigma.0 (line 7): must be at most 100000 px": CAMERA + "effects: {scattering: {kernels: [{weight: 0.1, sigma: [1e9, 3]}]}}\n",
    "effects.cyclic_error.harmonics.0.amplitude (line 7): must be at least -1e+06 m": CAMERA + "effects: {cyclic_error: {harmonics: [{order: 4, amplitude: -1e200, phase: 0}]}}\n",
    "optics.fx (line 5): must be at least 1e-09 px, found 1e-300": CAMERA.replace("fx: 14.0", "fx: 1e-300"),
    "sensor.modulation_frequency (line 4): must be finite, found inf": CAMERA.replace("20.0e6", "1e999"),
}  # fmt: skip


@pytest.mark.parametrize("words", NUMBERS, ids=range(len(NUMBERS)))
def test_absurd_numbers(simulate: Callable[..., str], words: str) -> None:
    assert words in simulate(NUMBERS[words])


def listed(text: str, count: int) -> str:
    return ", ".join(text.replace("%", str(i + 1)) for i in range(count))


KERNEL, STATION = "{weight: 1.0e-5, sigma: [%, 3]}", "- {frames: 1}\n"
MANY = {
    "effects.scattering.kernels (line 7): has 5000 entries, 16 at most": (CAMERA + f"effects: {{scattering: {{kernels: [{listed(KERNEL, 5000)}]}}}}\n", SCENE),
    "effects.integration_time_offset.offset (line 7): has 20000 entries, 1000 at most": (CAMERA + f"effects: {{integration_time_offset: {{offset: {{{listed('%: 0.1', 20000)}}}}}}}\n", SCENE),
    "camera.yaml: holds more than 200000 values": (CAMERA + f"provenance: {{{listed('k%: 1', 400000)}}}\n", SCENE),
    "schedule (line 6): has 20000 entries, 10000 at most": (CAMERA, SCENE + "schedule:\n" + STATION * 20000),
    "surfaces (line 4): has 20000 entries, 200 at most": (CAMERA, "\nformat: rim_scene/1\nsurfaces:\n" + "- {name: w, type: plane, pose: truth}\n" * 20000),
    "camera.yaml: nested too deeply": (CAMERA + "provenance: " + "[" * 100_000 + "\n", SCENE),
}  # fmt: skip


@pytest.mark.parametrize("words", MANY, ids=range(len(MANY)))
def test_too_much_of_everything(simulate: Callable[..., str], words: str) -> None:
    assert words in simulate(*MANY[words])


@pytest.mark.parametrize("name", ["a/b", "", "a\\0b", "a" * 300, " "])
def test_names_of_surfaces_make_topics(simulate: Callable[..., str], name: str) -> None:
    error = simulate(CAMERA, SCENE.replace("name: wall", f'name: "{name}"'))
    assert "surfaces.0" in error
    assert "is no name" in error


# --- compressed recordings ------------------------------------------------------------------------


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Half a gigabyte more than there is now, for this test."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (512 << 20), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@lru_cache
def zeros(kind: str, size: int) -> bytes:
    """Return so many zeros, compressed piece by piece."""
    module, standard = compress._zstd()
    if kind == "bz2":
        packer: Any = bz2.BZ2Compressor()
    else:
        packer = module.ZstdCompressor() if standard else module.ZstdCompressor().compressobj()
    parts = [packer.compress(bytes(1 << 20)) for _ in range(size >> 20)]
    return b"".join([*parts, packer.flush()])


@pytest.mark.parametrize("kind", ["zstd", "bz2"])
def test_blocks_that_unpack_to_far_more(kind: str, little_memory: None) -> None:
    packed = zeros(kind, 256 << 20)
    assert len(packed) < 10_000
    with pytest.raises(CompressionError, match=r"\d+ bytes unpack to more than 1000 times as many"):
        decompress(packed, kind)
    # black images do so too
    assert len(decompress(zeros(kind, 40 << 20), kind)) == 40 << 20
    assert bytes(decompress(lz4.frame.compress(b"abc" * 1000), "lz4")) == b"abc" * 1000


def test_a_chunk_that_unpacks_to_far_more(tmp_path: Path, little_memory: None) -> None:
    packed = zeros("zstd", 256 << 20)
    chunk = struct.pack("<QQQII", 0, 0, 256 << 20, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    header = struct.pack("<BQII", 1, 8, 0, 0)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + header + struct.pack("<BQ", 6, len(chunk)) + chunk)
    with Recording(path) as recording, pytest.raises(RimError, match=r"bomb\.mcap.*1000 times as many"):
        list(recording.frames())


def test_a_bag_of_ros1_that_unpacks_to_far_more(tmp_path: Path, little_memory: None) -> None:
    path = write_bag1(tmp_path / "a.bag", [line for i in range(2) for line in pair(i)], compression="BZ2")
    with Bag1Reader(path) as reader:
        (chunk,) = reader.chunks.values()
    data = path.read_bytes()
    bomb = zeros("bz2", 256 << 20)
    assert len(bomb) < chunk.datasize
    path.write_bytes(
        data[: chunk.datapos] + bomb.ljust(chunk.datasize, b"\0") + data[chunk.datapos + chunk.datasize :]
    )
    with Recording(path) as recording, pytest.raises(RimError, match=r"a\.bag.*1000 times as many"):
        list(recording.frames())


@pytest.fixture
def packed_bag(tmp_path: Path) -> Path:
    lines = [line for i in range(3) for line in pair(i)]
    folder = write_lines(tmp_path / "bag", lines, compression=CompressionMode.FILE)
    return next(folder.glob("*.zstd"))


def test_files_that_unpack_to_far_more(
    tmp_path: Path, packed_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compress, "_ANY_RATIO_OF_FILES", 1 << 20)
    (tmp_path / "a.zstd").write_bytes(zeros("zstd", 64 << 20))
    with pytest.raises(CompressionError, match="unpacks to more than 1000 times its size"):
        decompress_file(tmp_path / "a.zstd", tmp_path / "a")
    assert (tmp_path / "a").stat().st_size <= 1000 * (tmp_path / "a.zstd").stat().st_size + (1 << 20)
    with pytest.raises(InputError, match=r"a\.zstd: it unpacks to more than 1000 times its size"):
        Recording(tmp_path / "a.zstd").__enter__()
    with Recording(packed_bag) as recording:
        assert len(list(recording.frames())) == 3


def test_files_are_not_unpacked_to_the_last_byte_of_a_disk(
    packed_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")._replace(free=100 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    match = r"\.mcap\.zstd: cannot be read while it was unpacked .*No space left on device \(TMPDIR names"
    with pytest.raises(RimError, match=match) as caught:
        Recording(packed_bag).__enter__()
    assert caught.value.exit_status == 1


def test_an_endless_file_is_no_camera() -> None:
    from rim_camera_ros.camera_file import load_camera

    with pytest.raises(InputError, match="/dev/zero: is no file, or an endless one"):
        load_camera("/dev/zero")
