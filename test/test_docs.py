"""Generated pages are those of the program, links lead somewhere, the README stays short."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
import yaml

from rim_camera_ros.camera_file import _File
from rim_camera_ros.effects import ORDER, PARTICULAR
from rim_camera_ros.scene import Scene
from rim_camera_ros.yaml_files import _Loader

ROOT = Path(__file__).resolve().parents[1]
_SKIPPED = {"build", "install", "log", "demo_output"}
PAGES = sorted(
    path
    for path in ROOT.rglob("*.md")
    if not any(part.startswith(".") or part in _SKIPPED for part in path.relative_to(ROOT).parts)
    # a part of docs/proof.md, with links as seen from there
    and path != ROOT / "docs" / "proof" / "history.md"
)
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_PATH = re.compile(r"`((?:docs|config|launch|requirements|test|rim_camera_ros)/[\w./-]+)`")


@pytest.mark.parametrize("tool", ["effect_pages", "file_reference", "node_parameters"])
def test_pages_are_up_to_date(tool: str) -> None:
    if tool == "node_parameters":
        pytest.importorskip("rclpy")
        pytest.importorskip("sklearn", reason="scikit-learn is an optional extra, for the people node")
    path = ROOT / "docs" / "tools" / f"{tool}.py"
    done = subprocess.run(
        [sys.executable, str(path), "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr}\nrun make docs"


def documented(part: str) -> dict[str, list[str]]:
    """Return the rows of docs/file_reference.md below a heading, by key."""
    text = (ROOT / "docs" / "file_reference.md").read_text()
    section = re.split(r"^#{2,3} ", text[re.search(f"^#+ .*{part}", text, re.MULTILINE).end() :], flags=re.M)[
        0
    ]
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in section.splitlines()]
    return {row[0].strip("` "): row[1:] for row in rows if row[0].startswith("`")}


def used(data: Any, prefix: str = "") -> Iterator[str]:
    """Yield the path of every key in a file, entries of lists as `[]`, settings and names as `*`."""
    if isinstance(data, dict):
        for key, value in data.items():
            free = isinstance(key, int | float) or prefix.endswith("poses.")
            name = "*" if free else str(key)
            yield f"{prefix}{name}"
            if name not in ("provenance", "effects"):
                yield from used(value, f"{prefix}{name}.")
    elif isinstance(data, list):
        for one in data:
            yield from used(one, f"{prefix[:-1]}[].")


def fields_of(kind: type) -> Iterator[str]:
    """Yield the names of all fields of a dataclass and of those within it."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        if field.init:
            yield field.name
            text = [hints[field.name]]
            while text:
                hint = text.pop()
                text += typing.get_args(hint)
                if isinstance(hint, type) and dataclasses.is_dataclass(hint) and field.name not in _ARRAYS:
                    yield from fields_of(hint)


_ARRAYS = ("map", "matrix", "values")


def test_no_key_of_a_file_is_missing_in_the_reference() -> None:
    """Neither one that a dataclass has nor one that a shipped file uses; each says what it is."""
    sections = {"Camera file": _File, "Scene file": Scene} | {
        f"\\[{one.name}\\]": one for one in (*ORDER, *PARTICULAR)
    }
    rows = {part: documented(part) for part in sections}
    for part, kind in sections.items():
        names = {re.sub(r"\[\]|\.SETTING|\.NAME", "", key).split(".")[-1] for key in rows[part]}
        assert names == set(fields_of(kind)), part
        for key, (words, _, default, allowed, example) in rows[part].items():
            assert len(words) > 1, key
            assert default, key
            assert not allowed or example or part.startswith("\\["), f"{key} has no example"
    plain = {
        part: {re.sub(r"SETTING|NAME", "*", key) for key in found} | {key.rstrip("[]") for key in found}
        for part, found in rows.items()
    }
    shipped = [*(ROOT / "calibration").rglob("*.yaml"), *(ROOT / "config").glob("*.yaml")]
    seen = 0
    for path in shipped:
        data = yaml.load(path.read_text(), Loader=_Loader)
        kind = str(data.get("format", "")) if isinstance(data, dict) else ""
        part = {"rim_camera/1": "Camera file", "rim_scene/1": "Scene file"}.get(kind)
        if part is None:
            continue
        seen += 1
        measurement = data.pop("measurement", None)
        if measurement is not None:
            keys = {key.split(".")[-1].removesuffix("[]") for key in documented(measurement.pop("type"))}
            assert set(measurement) <= keys, path.name
        missing = {key for key in used(data) if key not in plain[part]} - {"schedule[].poses.*"}
        assert not missing, f"{path.name}: {sorted(missing)}"
        for name, effect in (data.get("effects") or {}).items():
            groups = effect if isinstance(effect, list) else [effect]
            found = {re.sub(r"\.\*(?=\.|$)", "", key) for one in groups for key in used(one)} - {""}
            known = {re.sub(r"\.\*(?=\.|$)", "", key) for key in plain[f"\\[{name}\\]"]}
            assert found <= known, f"{path.name}: {name}: {sorted(found - known)}"
    assert seen > 20


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) < 1500


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings as GitHub makes them."""
    text = re.sub(r"^(```|~~~).*?^\1", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    found: dict[str, int] = {}
    result = set()
    for heading in re.findall(r"^#{1,6} +(.+?) *#*$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        anchor = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        count = found[anchor] = found.get(anchor, -1) + 1
        result.add(f"{anchor}-{count}" if count else anchor)
    return result


def dead_links(page: Path) -> list[str]:
    """Return the links of a page within the repository that lead nowhere; addresses are not looked up."""
    dead = []
    for link in _LINK.findall(page.read_text()):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = unquote(link).partition("#")
        target = (page.parent / name).resolve() if name else page
        inside = target == ROOT or ROOT in target.parents
        exists = inside and target.exists()
        if not exists or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            dead.append(link)
    return dead


@pytest.mark.parametrize("page", PAGES, ids=lambda one: str(one.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert dead_links(page) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda one: str(one.relative_to(ROOT)))
def test_files_that_are_named_exist(page: Path) -> None:
    named = {one.rstrip("./") for one in _PATH.findall(page.read_text())}
    assert sorted(one for one in named if not (ROOT / one).exists()) == []


def test_dead_links_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    (tmp_path / "other.md").write_text("# Two `words`, here\n\n# Two words here\n")
    page = tmp_path / "page.md"
    good = "[a](other.md) [b](other.md#two-words-here) [c](other.md#two-words-here-1) [d](https://x.org/y)"
    bad = "[e](gone.md) [f](other.md#gone) ![g](gone.png) [h](../outside.md) [i](#gone)"
    page.write_text(f"{good}\n{bad}\n")
    (tmp_path.parent / "outside.md").write_text("")
    assert dead_links(page) == ["gone.md", "other.md#gone", "gone.png", "../outside.md", "#gone"]


def test_every_page_is_reached_from_the_readme() -> None:
    reached, left = set(), [ROOT / "README.md"]
    while left:
        page = left.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        for link in _LINK.findall(page.read_text()):
            name = unquote(link).partition("#")[0]
            target = (page.parent / name).resolve()
            if name and not re.match(r"[a-z]+:", link) and target.is_file():
                left.append(target)
    assert sorted(str(one.relative_to(ROOT)) for one in set(PAGES) - reached if "docs" in one.parts) == []


def test_what_only_pip_has_is_skipped_by_rosdep_and_installed_by_pip() -> None:
    keys = re.findall(r"<exec_depend>(python3-(\w+)-pip)</exec_depend>", (ROOT / "package.xml").read_text())
    assert keys
    for page in ("README.md", "docs/nodes.md"):
        text = (ROOT / page).read_text()
        for key, name in keys:
            assert f"--skip-keys {key}\n" in text, page
            assert re.search(rf"pip3 install --user --break-system-packages {name}\b", text), page


@pytest.mark.parametrize("page", ["README.md", "docs/nodes.md"])
def test_lists_of_packages_come_before_what_is_installed_from_them(page: str) -> None:
    text = (ROOT / page).read_text()
    before = text[: text.index("    rosdep install")].rpartition("\n\n")[2]
    for needed in (". /opt/ros/jazzy/setup.bash", "sudo apt update", "rosdep update"):
        assert needed in before, needed


def test_what_a_headless_robot_leaves_out_is_a_dependency() -> None:
    text = (ROOT / "docs" / "nodes.md").read_text()
    (keys,) = re.findall(r'`--skip-keys "([^"]+)"`', text)
    assert keys.split() == ["python3-rosbags-pip", "rviz2"]
    package = (ROOT / "package.xml").read_text()
    assert all(f"<exec_depend>{key}</exec_depend>" in package for key in keys.split())
