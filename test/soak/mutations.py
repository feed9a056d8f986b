"""Files with damage: camera files, scene files, recordings, parameter files must be read or refused."""

from __future__ import annotations

import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import Recording
from rim_camera_ros.camera_file import load_camera, save_camera
from rim_camera_ros.errors import RimError
from rim_camera_ros.files import find_camera, find_scene, share_folder
from rim_camera_ros.scene import load_scene
from test.helpers_bags import exposure, flat, write_bag
from test.ros.harness import World

KINDS = ("camera", "scene", "bag")
_WORDS = [
    "1e999", "-1", "nan", ".inf", "null", "[]", "{}", "0", "'", "&a", "*a", "!!python/object:os.system",
    "9" * 20, "../../../../etc/passwd", "/etc/passwd", "\t", "\u0000", "\ud7ff", "- ", ": ", "#",
]  # fmt: skip


def mutated_text(text: str, rng: random.Random) -> bytes:
    """Return a text with one to four damages: words, lines and characters replaced, doubled or omitted."""
    lines = text.splitlines()
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(lines)) if lines else 0
        if not lines:
            break
        line, what = lines[place], rng.randrange(8)
        words = line.split(" ")
        if what == 0:
            words[rng.randrange(len(words))] = rng.choice(_WORDS)
            lines[place] = " ".join(words)
        elif what == 1:
            del lines[place]
        elif what == 2:
            lines.insert(place, lines[rng.randrange(len(lines))])
        elif what == 3:
            lines[place] = "  " * rng.randint(0, 3) + line.strip()
        elif what == 4 and line:
            at = rng.randrange(len(line))
            lines[place] = line[:at] + chr(rng.choice([0, 9, 34, 58, 91, 123, 233, 0x2028])) + line[at + 1 :]
        elif what == 5:
            lines[place] = line.replace("0", rng.choice(["9" * 30, "-0", "1e308", "."]))
        elif what == 6:
            lines = lines[:place]
        else:
            key, colon, _ = line.partition(":")
            lines[place] = key + colon + " " + rng.choice(_WORDS) if colon else line + rng.choice(_WORDS)
    data = "\n".join(lines).encode("utf-8", "surrogatepass")
    return data if rng.random() < 0.9 else damaged(data, rng)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with one to five damages: flipped, cut, doubled, overwritten."""
    result = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        if not result:
            break
        at = rng.randrange(len(result))
        length = rng.choice([1, 1, 2, 8, 64, 1000])
        what = rng.randrange(5)
        if what == 0:
            result[at] ^= 1 << rng.randrange(8)
        elif what == 1:
            del result[at : at + length]
        elif what == 2:
            result[at:at] = result[at : at + length]
        elif what == 3:
            result[at : at + length] = rng.choice([b"\xff", b"\x00"]) * length
        else:
            result = result[:at]
    return bytes(result)


def run(folder: Path, *, count: int, seed: int = 5) -> dict[str, Any]:
    """Read ``count`` damaged files, a third of each kind.

    ``accepted`` were read in spite of the damage, ``refused`` with an error of one line; ``crashes`` are all
    other exceptions, ``slowest_s`` the longest reading, ``outside`` files that appeared elsewhere.
    """
    rng = random.Random(seed)
    work, around = folder / "work", folder / "around"
    work.mkdir()
    around.mkdir()
    readers = _readers(work, around)
    figures: dict[str, Any] = {"accepted": 0, "refused": 0, "crashes": [], "slowest_s": 0.0}
    for i in range(count):
        kind = KINDS[i % len(KINDS)]
        write, read = readers[kind]
        write(rng)
        begun = time.monotonic()
        try:
            read()
        except RimError as error:
            figures["refused"] += 1
            if len(str(error).splitlines()) > 1:
                figures["crashes"].append((i, kind, "an error of several lines"))
        except Exception as error:
            figures["crashes"].append((i, kind, f"{type(error).__name__}: {error}"[:200]))
        else:
            figures["accepted"] += 1
        figures["slowest_s"] = max(figures["slowest_s"], time.monotonic() - begun)
    figures["outside"] = sorted(
        str(one.relative_to(folder)) for one in folder.iterdir() if one not in (work, around)
    )
    return figures


def parameter_files(folder: Path, *, count: int, seed: int = 6) -> dict[str, Any]:
    """Start nodes with damaged parameter files; each must end by itself, or run and end on SIGTERM.

    ``bad``: tracebacks, other exit statuses than 0, 1, 2, and nodes that took more than 5 s to say what is
    wrong or to come up.
    """
    rng = random.Random(seed)
    texts = {
        node: (share_folder() / "config" / f"{file}.yaml").read_text()
        for node, file in (("driver_node", "driver_simulator"), ("correction_node", "correction"))
    }
    figures: dict[str, Any] = {"started": 0, "refused": 0, "bad": []}
    with World(folder) as world:
        for i in range(count):
            node = rng.choice(sorted(texts))
            file = folder / "parameters.yaml"
            file.write_bytes(mutated_text(texts[node], rng))
            process = world.start(node, "--params-file", str(file))
            begun = time.monotonic()
            up = f"{'publishing' if node == 'driver_node' else 'correcting'} "
            world.until(lambda p=process, up=up: not p.running or up in p.text, 20)
            took = time.monotonic() - begun
            came_up = process.running
            process.send(signal.SIGTERM) if came_up else None
            status = process.wait(20)
            figures["started" if came_up else "refused"] += 1
            if "Traceback" in process.text or status not in (0, 1, 2) or took > 10.0:
                figures["bad"].append((i, node, status, round(took, 1), process.text[-300:]))
    return figures


def _readers(work: Path, around: Path) -> dict[str, tuple[Callable[[random.Random], Any], Callable[[], Any]]]:
    """Return, for each kind of file, what writes a damaged one and what reads it."""
    for file in find_camera("sr3000_every_effect").parent.glob("sr3000*.npy"):
        shutil.copy(file, work)
    cameras = [find_camera(name).read_text() for name in ("sr3000", "sr3000_every_effect", "pmd3ks")]
    for file in find_camera("pmd3ks").parent.glob("pmd3ks*.npy"):
        shutil.copy(file, work)
    scenes = [find_scene(name).read_text() for name in ("room", "board", "track_line")]
    bag = write_bag(around / "bag", flat(exposure(i) for i in range(5)))
    parts = [one for one in Path(bag).iterdir() if one.is_file()]
    camera, scene = work / "camera.yaml", work / "scene.yaml"

    def write_damaged_bag(rng: random.Random) -> None:
        target = work / "bag"
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(bag, target)
        victim = target / rng.choice(parts).name
        victim.write_bytes(damaged(victim.read_bytes(), rng))

    def read_bag() -> None:
        with Recording(work / "bag") as recording:
            for _ in recording.frames(on_backwards="count"):
                pass

    def read_camera() -> None:
        read = load_camera(camera)
        out = work / "out"
        out.mkdir(exist_ok=True)
        save_camera(read, out / "camera.yaml")

    return {
        "camera": (lambda rng: camera.write_bytes(mutated_text(rng.choice(cameras), rng)), read_camera),
        "scene": (
            lambda rng: scene.write_bytes(mutated_text(rng.choice(scenes), rng)),
            lambda: load_scene(scene),
        ),
        "bag": (write_damaged_bag, read_bag),
    }
