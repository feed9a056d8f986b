"""YAML files <-> dataclasses: numbers, places, paths, and files that are written whole."""

from __future__ import annotations

# ruff: noqa: E501 -- one fault a line
import datetime
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rim_camera_ros.errors import InputError, RimError, nearest_name
from rim_camera_ros.parameters import (
    ArrayFile,
    NestedList,
    arrays_of,
    decode,
    encode,
    flatten,
    quantity,
    with_values,
)
from rim_camera_ros.yaml_files import Document, read_yaml, write_whole, write_yaml


@dataclass(frozen=True)
class Inner:
    size: float = quantity("m", "a size", above=0.0, below=9.0)
    pair: tuple[float, float] = quantity("rad", "two angles", default=(0.25, -0.5))


@dataclass(frozen=True)
class Outer:
    count: int = quantity("-", "how many", minimum=2, maximum=7)
    rows: Mapping[float, Inner] = quantity("-", "by setting", default=MappingProxyType({}))
    several: tuple[Inner, ...] = quantity("-", "some", default=())
    kind: Literal["round", "square"] = quantity("-", "shape", default="round")
    label: str | Inner = quantity("-", "name or group", default="none")
    limit: float | None = quantity("s", "limit", default=None)
    lit: bool = quantity("-", "switch", default=False)
    text: str = quantity("-", "words", default="x")
    map: ArrayFile | None = quantity("m", "file", default=None)
    table: NestedList | None = quantity("m", "nested", default=None, maximum=5.0)
    inner: Inner = field(default_factory=lambda: Inner(1.5))

    def __post_init__(self) -> None:
        if self.text == "forbidden":
            raise ValueError("text must not be forbidden")


def load(tmp_path: Path, text: str) -> Outer:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    document = read_yaml(path)
    return decode(Outer, document.data, document)


def test_everything_that_can_be_given(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.array([[1, 2], [3, 4]], np.int16))
    found = load(
        tmp_path,
        """
count: 3
rows: {16: {size: 1e-3}, 7.5: {size: 2, pair: [1, 2.5E2]}}
several: [{size: .5}, {size: 4.0e+0}]
kind: square
label: {size: 3}
limit: null
lit: true
text: 'no'
map: m.npy
table: [[1, 2, 3], [4, 5, -6e-1]]
""",
    )
    assert found.count == 3
    assert dict(found.rows) == {16.0: Inner(1e-3), 7.5: Inner(2.0, (1.0, 250.0))}
    assert found.several == (Inner(0.5), Inner(4.0))
    assert (found.kind, found.label, found.limit, found.lit, found.text) == (
        "square",
        Inner(3.0),
        None,
        True,
        "no",
    )
    assert found.map == ArrayFile("m.npy", np.array([[1.0, 2], [3, 4]]))
    assert found.table == NestedList(np.array([[1, 2, 3], [4, 5, -0.6]]))
    assert found.inner == Inner(1.5)
    # numbers of keys that are floats are floats, whatever was written
    assert isinstance(found.rows[7.5].size, float)
    assert all(isinstance(key, float) for key in found.rows)


FAULTS = {
    "unknown key": ("count: 3\ncuont: 4\n", r"file\.yaml: cuont \(line 2\): unknown key \(did you mean 'count'\?\)"),
    "nothing like it": ("count: 3\nzzzzzz: 4\n", r"zzzzzz \(line 2\): unknown key \(known: count, inner, kind"),
    "key that is a number": ("count: 3\n17: 4\n", r"17 \(line 2\): unknown key"),
    "missing": ("text: a\n", r"file\.yaml: line 1: key 'count' is missing \(how many\)"),
    "missing with unit": ("count: 3\nseveral:\n- {pair: [1, 2]}\n", r"several\.0 \(line 3\): key 'size' is missing \[m\] \(a size\)"),
    "empty file": ("", r"key 'count' is missing"),
    "a list": ("- 1\n- 2\n", r"line 1: expected a group of keys, found a list"),
    "a word": ("hello\n", r"expected a group of keys, found the text 'hello'"),
    "too small": ("count: 1\n", r"count \(line 1\): must be at least 2, found 1"),
    "too great": ("count: 8\n", r"count \(line 1\): must be at most 7, found 8"),
    "not above": ("count: 3\ninner: {size: 0}\n", r"inner\.size \(line 2\): must be greater than 0 m, found 0"),
    "not below": ("count: 3\ninner:\n  size: 9\n", r"inner\.size \(line 3\): must be less than 9 m, found 9"),
    "fraction": ("count: 3.5\n", r"count \(line 1\): expected a whole number, found the number 3\.5"),
    "infinite": ("count: 3\nlimit: .inf\n", r"limit \(line 2\): must be finite, found inf"),
    "overflow": ("count: 3\nlimit: 1e999\n", r"limit \(line 2\): must be finite, found inf"),
    "huge whole": ("count: 3\nlimit: " + "9" * 400 + "\n", r"limit \(line 2\): must be finite"),
    "NaN in a list": ("count: 3\ninner: {size: 1, pair: [0, .nan]}\n", r"inner\.pair\.1 \(line 2\): must be finite, found nan"),
    "text for a number": ("count: 3\nlimit: 20 ms\n", r"limit \(line 2\): expected a number in s, found the text '20 ms' \(give a number in s, without unit or quotes\)"),
    "truth for a number": ("count: yes\n", r"count \(line 1\): expected a number, found the truth value true"),
    "nothing for a number": ("count:\n", r"count \(line 1\): expected a number, found nothing"),
    "group for a number": ("count: {a: 1}\n", r"expected a number, found a group of keys"),
    "number for a truth": ("count: 3\nlit: 1\n", r"lit \(line 2\): expected true or false, found the number 1"),
    "number for a text": ("count: 3\ntext: 5\n", r"text \(line 2\): expected a text, found the number 5"),
    "date for a text": ("count: 3\ntext: 2007-01-02\n", r"text \(line 2\): expected a text, found a date"),
    "unknown word": ("count: 3\nkind: sqare\n", r"kind \(line 2\): unknown value 'sqare' \(did you mean 'square'\?\)"),
    "wrong number of values": ("count: 3\ninner: {size: 1, pair: [1]}\n", r"inner\.pair \(line 2\): expected 2 values, found 1"),
    "number for a list": ("count: 3\nseveral: 1\n", r"several \(line 2\): expected a list, found the number 1"),
    "list for rows": ("count: 3\nrows: [1]\n", r"rows \(line 2\): expected a group of keys, found a list"),
    "word for a row": ("count: 3\nrows: {all: {size: 1}}\n", r"rows\.all \(line 2\): expected a number, found the text 'all'"),
    "row 0": ("count: 3\nrows: {0: {size: 1}}\n", r"rows\.0 \(line 2\): must be greater than 0, found 0"),
    "row twice": ("count: 3\nrows: {16: {size: 1}, 16.0: {size: 2}}\n", r"rows\.16\.0 \(line 2\): key given twice \(keep one\)"),
    "ragged": ("count: 3\ntable: [[1, 2], [3]]\n", r"table \(line 2\): rows of different lengths \(give every row the same length\)"),
    "word in a table": ("count: 3\ntable: [[1, 2], [3, x]]\n", r"table\.1\.1 \(line 2\): expected a number in m, found the text 'x'"),
    "table out of bounds": ("count: 3\ntable:\n- [1, 2]\n- [3, 6]\n", r"table\.1\.1 \(line 4\): must be at most 5 m, found 6"),
    "number for a table": ("count: 3\ntable: 4\n", r"table \(line 2\): expected a list, found the number 4"),
    "number for a file": ("count: 3\nmap: 4\n", r"map \(line 2\): expected the name of a \.npy file, found the number 4"),
    "absolute file": ("count: 3\nmap: /etc/m.npy\n", r"'/etc/m\.npy' is not a \.npy file in the folder of this file"),
    "other suffix": ("count: 3\nmap: m.txt\n", r"'m\.txt' is not a \.npy file in the folder of this file \(move it there and name it so\)"),
    "not an array": ("count: 3\nmap: bad.npy\n", r"map \(line 2\): 'bad\.npy' cannot be read as \.npy"),
    "empty array file": ("count: 3\nmap: empty.npy\n", r"'empty\.npy' cannot be read as \.npy"),
    "complex array": ("count: 3\nmap: complex.npy\n", r"'complex\.npy' holds no real numbers \(save floats with numpy\.save\)"),
    "refused": ("count: 3\ntext: forbidden\n", r"file\.yaml: line 1: text must not be forbidden"),
    "key twice": ("count: 3\ninner:\n  size: 1\n  size: 2\n", r"inner\.size \(line 4\): key given twice \(keep one\)"),
    "key that is a list": ("count: 3\n? [1, 2]\n: 4\n", r"line 2: not valid YAML: a key must be a plain word or number"),
    "alias of itself": ("count: 3\nseveral: &s [*s]\n", r"nested too deeply"),
    "aliases of aliases": ("a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(f"{c}: &{c} [{', '.join(10 * [f'*{b}'])}]\n" for b, c in zip("abcdef", "bcdefg", strict=True)), r"holds more than 200000 values \(aliases repeat theirs\) \(is this the right file\?"),
    "row twice by a text": ("count: 3\nrows: {16: {size: 1}, '16': {size: 2}}\n", r"rows\.16 \(line 2\): key given twice \(keep one\)"),
    "two documents": ("count: 3\n---\ncount: 4\n", r"line 2: not valid YAML: but found another document"),
    "tabulator": ("count:\t3\n\tlimit: 4\n", r"line [12]: not valid YAML"),
    "control characters": ("count: \x00\n", r"not valid YAML: .*(special|control) characters"),
    "merge key": ("count: 3\n<<: {limit: 3}\n", r"file\.yaml: line 2: not valid YAML|<< \(line 2\): unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_with_their_place(tmp_path: Path, fault: str) -> None:
    text, match = FAULTS[fault]
    (tmp_path / "bad.npy").write_bytes(b"not an array")
    (tmp_path / "empty.npy").write_bytes(b"")
    np.save(tmp_path / "complex.npy", np.array([1j]))
    with pytest.raises(InputError, match=match) as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


def test_what_other_programs_write_is_read(tmp_path: Path) -> None:
    """Libraries write what occurs twice by alias, and keys of rows as texts where they were in JSON."""
    shared = [1.0, 2.0]
    rows = {"16": {"size": 0.5, "pair": shared}, "7.5": {"size": 2.0, "pair": shared}}
    text = yaml.safe_dump({"count": 3, "rows": rows})
    assert "*id" in text
    found = load(tmp_path, text)
    assert dict(found.rows) == {16.0: Inner(0.5, (1.0, 2.0)), 7.5: Inner(2.0, (1.0, 2.0))}


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: no such file \(check the path and permissions\)"):
        read_yaml(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder, not a file"):
        read_yaml(tmp_path)
    (tmp_path / "bytes.yaml").write_bytes(b"a: \xff\xfe\n")
    with pytest.raises(InputError, match=r"bytes\.yaml: is not a text file \(give a YAML file\)"):
        read_yaml(tmp_path / "bytes.yaml")
    (tmp_path / "below.yaml" / "x").mkdir(parents=True)
    with pytest.raises(InputError, match="no such file"):
        read_yaml(tmp_path / "bytes.yaml" / "x")


def test_an_endless_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.yaml"
    with path.open("wb") as stream:
        stream.truncate(65 * 2**20)
    with pytest.raises(InputError, match=r"is larger than 64 MiB \(is this the right file\?\)"):
        read_yaml(path)


@settings(derandomize=True, max_examples=200, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_survive_writing_and_reading(tmp_path_factory: pytest.TempPathFactory, value: float) -> None:
    """Also with a plain YAML 1.1 reader, which takes 1e-05 for a word."""
    path = tmp_path_factory.getbasetemp() / "number.yaml"
    write_yaml(path, {"a": value, "b": [value, -value]})
    for found in (read_yaml(path).data, yaml.safe_load(path.read_text())):
        assert found == {"a": value, "b": [value, -value]}
        assert isinstance(found["a"], float)


@pytest.mark.parametrize(
    ("text", "value"),
    [("1e-3", 1e-3), ("2.5E+6", 2.5e6), (".5e1", 5.0), ("-3e2", -300.0), ("40.0e-6", 40e-6), ("7.e1", 70.0)],
)
def test_numbers_with_exponents_as_in_yaml_1_2(tmp_path: Path, text: str, value: float) -> None:
    (tmp_path / "a.yaml").write_text(f"a: {text}\n")
    assert read_yaml(tmp_path / "a.yaml").data == {"a": value}


def test_lines_of_values(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("# comment\na:\n  - 1\n  - b: 2\n    c: 3\n")
    document = read_yaml(tmp_path / "a.yaml")
    assert document.lines[("a", 0)] == 3
    assert document.lines[("a", 1, "c")] == 5
    # a place that is not in the file is shown at the nearest line that is
    error = document.error(("a", 1, "d"), "is odd", "mend it")
    assert str(error) == f"{tmp_path / 'a.yaml'}: a.1.d (line 4): is odd (mend it)"


# --- paths --------------------------------------------------------------------------------------

SOME = Outer(
    count=3,
    rows=MappingProxyType({16.0: Inner(1.0), 7.5: Inner(2.0, (3.0, 4.0))}),
    several=(Inner(5.0), Inner(6.0, (7.0, 8.0))),
    limit=2.5,
    table=NestedList(np.array([1.0])),
)


def test_flatten_lists_every_float_by_dotted_path() -> None:
    assert flatten(SOME, "x.") == {
        "x.rows.16.size": 1.0,
        "x.rows.16.pair.0": 0.25,
        "x.rows.16.pair.1": -0.5,
        "x.rows.7.5.size": 2.0,
        "x.rows.7.5.pair.0": 3.0,
        "x.rows.7.5.pair.1": 4.0,
        "x.several.0.size": 5.0,
        "x.several.0.pair.0": 0.25,
        "x.several.0.pair.1": -0.5,
        "x.several.1.size": 6.0,
        "x.several.1.pair.0": 7.0,
        "x.several.1.pair.1": 8.0,
        "x.limit": 2.5,
        "x.inner.size": 1.5,
        "x.inner.pair.0": 0.25,
        "x.inner.pair.1": -0.5,
    }


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.dictionaries(st.sampled_from(sorted(flatten(SOME))), st.floats(-5, 5), max_size=6))
def test_replaced_numbers_and_no_others(values: dict[str, float]) -> None:
    changed = with_values(SOME, values)
    assert flatten(changed) == {**flatten(SOME), **values}
    assert (changed.count, changed.kind, changed.table) == (3, "round", SOME.table)
    assert list(changed.rows) == list(SOME.rows)


@pytest.mark.parametrize(
    "path", ["inner", "inner.siz", "several.2.size", "count", "table.0", "rows.16.0.size"]
)
def test_paths_that_are_no_number(path: str) -> None:
    with pytest.raises(KeyError, match=path.replace(".", r"\.")):
        with_values(SOME, {path: 1.0})


def test_encode_is_the_inverse_of_decode(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.array([1.5, 2.5]))
    value = Outer(
        count=5,
        rows=SOME.rows,
        several=SOME.several,
        kind="square",
        label=Inner(0.125),
        map=ArrayFile("m.npy", np.array([1.5, 2.5])),
        table=NestedList(np.array([[1.0, 2.0], [0.1, 4.0]])),
    )
    plain = encode(value)
    assert list(plain["rows"]) == [16, 7.5]
    write_yaml(tmp_path / "file.yaml", plain, comment="a file: of two\nlines")
    text = (tmp_path / "file.yaml").read_text()
    assert text.startswith("# a file: of two\n# lines\n")
    assert load(tmp_path, text) == value
    assert [one.file for one in arrays_of(value)] == ["m.npy"]


def test_provenance_may_hold_what_yaml_knows(tmp_path: Path) -> None:
    data = {"when": datetime.date(2007, 3, 15), "who": "ž", "n": np.float64(0.5), "deep": {"a": [None, True]}}
    write_yaml(tmp_path / "a.yaml", encode(data))
    assert read_yaml(tmp_path / "a.yaml").data == {**data, "n": 0.5}


def test_arrays_compare_by_value() -> None:
    a = np.array([1.0, np.nan])
    assert ArrayFile("a.npy", a) == ArrayFile("a.npy", a.copy())
    assert ArrayFile("a.npy", a) != ArrayFile("b.npy", a)
    assert ArrayFile("a.npy", a) != ArrayFile("a.npy", a[:1])
    assert NestedList(np.array([1.0])) != 1.0
    with pytest.raises(TypeError, match="unhashable"):
        hash(ArrayFile("a.npy", a))


# --- writing ------------------------------------------------------------------------------------


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"before")

    def fails(stream: Any) -> None:
        stream.write(b"half")
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_whole(path, fails)
    assert path.read_bytes() == b"before"
    assert [one.name for one in tmp_path.iterdir()] == ["a.bin"]
    write_whole(path, lambda stream: stream.write(b"after"))
    assert path.read_bytes() == b"after"
    assert [one.name for one in tmp_path.iterdir()] == ["a.bin"]


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "a", lambda stream: stream.write(b""))
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(RimError, match=r"b\.yaml: cannot be written: .*nothing was left behind") as caught:
        write_yaml(tmp_path / "none" / "b.yaml", {})
    assert caught.value.exit_status == 1
    (tmp_path / "folder").mkdir()
    with pytest.raises(RimError, match="folder: cannot be written"):
        write_yaml(tmp_path / "folder", {})
    assert [one.name for one in tmp_path.iterdir()] == ["folder"]


# --- errors -------------------------------------------------------------------------------------


def test_errors_are_one_line() -> None:
    error = InputError("is\nodd", file="f.yaml", place="a.b", remedy="mend\n it")
    assert str(error) == "f.yaml: a.b: is odd (mend it)"
    assert str(error.located("g.yaml")) == str(error)
    located = InputError("is odd", remedy="mend it").located("g.yaml")
    assert str(located) == "g.yaml: is odd (mend it)"
    assert isinstance(located, InputError)


def test_nearest_names() -> None:
    assert nearest_name("ampliude", ["amplitude", "attitude"]) == "did you mean 'amplitude'?"
    assert nearest_name("xyz", ["b", "a"]) == "known: a, b"
    assert nearest_name("xyz", []) == "no key is allowed here"
    assert nearest_name(None, ["b"]) == "known: b"


def test_no_place_in_an_empty_document() -> None:
    document = Document(Path("x.yaml"), None, {})
    assert str(document.error((), "is empty")) == "x.yaml: is empty"
    assert math.isfinite(decode(Inner, {"size": 1}, document).size)
