"""Data flows one way: no module imports one of a layer above its own, and none imports in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import rim_camera_ros
from rim_camera_ros.measurement import TYPES

ROOT = Path(rim_camera_ros.__file__).parent
#: From the lowest layer on; a name is a folder or a module of the package.
LAYERS = (
    {"errors", "limits", "interruption", "temporary", "threads", "files", "npy_files"},
    {"yaml_files", "parameters"},
    {"frame", "phasor", "coordinates", "noise", "optics", "camera", "convolution", "subspace"},
    {"scene", "footprint"},
    {"effects"},
    {"camera_file", "chain"},
    {"bags", "devices", "pipeline", "info"},
    {"fit"},
    {"select"},
    {"calibrate", "photogrammetry"},
    {"diagnose"},
    {"reports"},
    {"commands", "nodes"},
)
PLACE = {name: number for number, layer in enumerate(LAYERS) for name in layer}


def imports(path: Path, *, at_once: bool = False) -> Iterator[str]:
    """Yield the modules of the package that a module imports, or imports ``at_once``, by dotted names."""
    tree = ast.parse(path.read_text())
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rim_camera_ros."):
            whole = str(node.module).removeprefix("rim_camera_ros.")
            for one in node.names:
                inner = ROOT / whole.replace(".", "/") / f"{one.name}.py"
                yield f"{whole}.{one.name}" if inner.exists() else whole


def modules() -> dict[str, Path]:
    return {
        str(path.relative_to(ROOT).with_suffix("")).replace("/", ".").removesuffix(".__init__"): path
        for path in sorted(ROOT.rglob("*.py"))
    }


@pytest.mark.parametrize("name", [one for one in modules() if one.partition(".")[0] in PLACE])
def test_no_module_imports_a_layer_above_its_own(name: str) -> None:
    own = PLACE[name.partition(".")[0]]
    above = [one for one in imports(modules()[name]) if PLACE.get(one.partition(".")[0], own) > own]
    assert above == []


def test_nothing_is_imported_in_a_circle() -> None:
    graph = {name: set(imports(path, at_once=True)) for name, path in modules().items()}
    assert len(list(TopologicalSorter(graph).static_order())) >= len(graph)


#: Where the ways of measuring are defined, and where their devices are.
DEFINE = ("measurement", "single_photon", "gated", "devices")
#: The reader of camera files, in which a list of frequencies is a way of measuring; the chain of that way.
READ = {"camera_file", "pipeline.several_frequencies"}


def kinds(path: Path) -> Iterator[str]:
    """Yield what a module says of the kind of a sensor: classes of ways of measuring, and their names."""
    names = {one.__name__ for one in TYPES.values()}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Name | ast.Attribute):
            name = node.id if isinstance(node, ast.Name) else node.attr
            if name in names:
                yield name
        elif isinstance(node, ast.Compare | ast.MatchValue):
            for one in ast.walk(node):
                if isinstance(one, ast.Constant) and one.value in TYPES:
                    yield str(one.value)


def test_no_module_asks_which_kind_of_sensor_a_camera_has() -> None:
    """They ask the `Measurement` for what they need; the files that define one are the exception."""
    found = {
        name: sorted(set(kinds(path)))
        for name, path in modules().items()
        if name.partition(".")[0] not in DEFINE and name not in READ
    }
    assert {name: one for name, one in found.items() if one} == {}
    # the search finds them where they are
    assert list(kinds(modules()["camera_file"]))
    assert list(kinds(modules()["measurement"]))
