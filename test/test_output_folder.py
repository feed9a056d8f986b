"""A folder that is written whole: what is refused before the work, and what stays if the work fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from rim_camera_ros.commands.output_folder import OutputFolder
from rim_camera_ros.errors import InputError


def folder(path: Path) -> OutputFolder:
    return OutputFolder(path, own={"report.json", "camera.yaml"}, of="a diagnosis", mark="report.json")


def filled(path: Path, *names: str) -> Path:
    path.mkdir()
    for name in names:
        (path / name).write_text(f"old {name}")
    return path


def test_an_older_one_is_replaced_whole(tmp_path: Path) -> None:
    one = folder(filled(tmp_path / "out", "report.json", "camera.yaml", "camera.map.1234abcd.npy"))
    one.check(force=True)
    with pytest.raises(InputError, match=r"out: exists already"):
        one.check(force=False)
    with one.written() as new:
        (new / "report.json").write_text("new")
        assert (tmp_path / "out" / "camera.yaml").exists()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["report.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out").stat().st_mode & 0o777 == filled(tmp_path / "other").stat().st_mode & 0o777


def test_what_fails_leaves_it_as_it_is(tmp_path: Path) -> None:
    one = folder(filled(tmp_path / "out", "report.json"))

    def work() -> None:
        with one.written() as new:
            (new / "report.json").write_text("half")
            raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        work()
    assert (tmp_path / "out" / "report.json").read_text() == "old report.json"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_link_leads_to_the_folder_that_is_replaced(tmp_path: Path) -> None:
    target = filled(tmp_path / "target", "report.json")
    (tmp_path / "link").symlink_to(target)
    one = folder(tmp_path / "link")
    one.check(force=True)
    with one.written() as new:
        (new / "report.json").write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (target / "report.json").read_text() == "new"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("report.json", "my_notes.txt"), r"holds something else than a diagnosis \(my_notes.txt\)"),
        (("measurement.npy",), r"holds something else than a diagnosis \(measurement.npy\)"),
        (("camera.yaml",), r"holds something else than a diagnosis \(give another name"),
    ],
)
def test_what_is_no_older_one_stays(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    one = folder(filled(tmp_path / "out", *names))
    with pytest.raises(InputError, match=f"{message}.*"):
        one.check(force=True)


def test_the_folder_one_works_in_cannot_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(filled(tmp_path / "here", "report.json"))
    with pytest.raises(InputError, match="is the folder you work in"):
        folder(Path(".")).check(force=True)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file, not a folder"):
        folder(tmp_path / "file").check(force=True)
