"""No module outside effects/ knows a single effect: not by its name, nor by its class."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import rim_camera_ros
from rim_camera_ros.effects import OPTICS, ORDER

ROOT = Path(rim_camera_ros.__file__).parent
#: The laboratory of the thesis and the demonstration are about particular effects.
ABOUT_EFFECTS = {"effects", "reproduce", "demo"}
NAMES = {one.name for one in ORDER} | set(OPTICS)
CLASSES = {one.__name__ for one in ORDER}
MODULES = {one.__module__ for one in ORDER}
#: The name of an effect is that of a covariate, a setting and a topic as well.
OF_SETTINGS = {"ambient_temperature"}
SOURCES = [
    path for path in sorted(ROOT.rglob("*.py")) if path.relative_to(ROOT).parts[0] not in ABOUT_EFFECTS
]
#: A name alone, or at the beginning of a path or of a word of --effects.
_NAMED = re.compile(rf"(?:effects\.)?({'|'.join(sorted(NAMES))})(?:[.:].*)?")


def known(source: str) -> Iterator[str]:
    """Yield what a module's code, its docstrings apart, says of single effects."""
    tree = ast.parse(source)
    texts = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in texts:
            found = _NAMED.fullmatch(node.value)
            if found and node.value not in OF_SETTINGS:
                yield f"line {node.lineno}: '{node.value}'"
            inside = re.search(rf"\beffects\.({'|'.join(sorted(NAMES))})\b", node.value)
            if inside and not found:
                yield f"line {node.lineno}: '{inside[0]}'"
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            yield f"line {node.lineno}: from {node.module}"
        elif isinstance(node, ast.Name | ast.Attribute | ast.alias):
            name = (
                node.id
                if isinstance(node, ast.Name)
                else node.name
                if isinstance(node, ast.alias)
                else node.attr
            )
            if name in CLASSES:
                yield f"line {node.lineno}: {name}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda one: str(one.relative_to(ROOT)))
def test_no_effect_is_known_outside_effects(path: Path) -> None:
    assert list(known(path.read_text())) == []


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ('x = "scattering"', 1),
        ('x = "effects.cyclic_error.gradient.0"', 1),
        ('x = f"effects.mixed_pixels.blur@{1}"', 1),
        ('x = "empirical:amplitude"', 1),
        ("from rim_camera_ros.effects.motion import Motion", 2),
        ("isinstance(x, Scattering)", 1),
        ('"""The scattering of light."""', 0),
        ('x = "ambient_temperature"', 0),
        ('x = "effects.ambient_temperature.coefficient"', 1),
    ],
)
def test_what_counts_as_knowledge(source: str, count: int) -> None:
    assert len(list(known(source))) == count
