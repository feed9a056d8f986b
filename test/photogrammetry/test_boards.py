"""Boards to print: what is drawn, what the scene file says, and what is found in a texture."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from rim_camera_ros.cli import main
from rim_camera_ros.errors import InputError
from rim_camera_ros.photogrammetry.board_design import design_board, texture_of
from rim_camera_ros.photogrammetry.texture_targets import targets_of
from rim_camera_ros.scene import Surface, load_scene

aruco = getattr(cv2, "aruco", None)
needs_aruco = pytest.mark.skipif(aruco is None, reason="this OpenCV has no cv2.aruco")


def surface(kind: str, *, columns: int, rows: int, square: float, dictionary: str | None = None) -> Surface:
    design = design_board(kind, columns=columns, rows=rows, square=square, dictionary=dictionary)
    texture = texture_of(design, ink=0.05, paper=0.85)
    return Surface("board", "rectangle", "truth", size=design.size, texture=texture)


def test_the_texture_says_what_is_drawn() -> None:
    design = design_board("checkerboard", columns=7, rows=5, square=0.04)
    texture = texture_of(design, ink=0.05, paper=0.85)
    rng = np.random.default_rng(2)
    x, y = (rng.uniform(-0.5, 0.5, (2, 400)) * np.array(design.size)[:, None]).tolist()
    drawn = np.full(400, 0.85)
    for one in design.shapes:
        inside = (np.abs(np.array(x) - one.centre[0]) < one.size[0] / 2) & (
            np.abs(np.array(y) - one.centre[1]) < one.size[1] / 2
        )
        drawn[inside] = 0.05 + 0.8 * one.level
    np.testing.assert_allclose(texture.reflectivity(np.array(x), np.array(y)), drawn, atol=1e-4)
    # six greys, and the paper is one of them
    assert {round(one.level, 3) for one in design.shapes} == {0.0, 0.2, 0.4, 0.6, 0.8}


@needs_aruco
@pytest.mark.skipif(not hasattr(aruco, "CharucoBoard"), reason="OpenCV before 4.7")
def test_charuco_is_that_of_opencv() -> None:
    columns, rows, modules = 6, 5, 10
    design = design_board("charuco", columns=columns, rows=rows, square=0.04, greys=0)
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_4X4_100)
    board = aruco.CharucoBoard((columns, rows), 0.04, 0.024, dictionary)
    scale = 6
    image = board.generateImage((columns * modules * scale, rows * modules * scale))
    cells = image.reshape(rows * modules, scale, columns * modules, scale)[:, scale // 2, :, scale // 2] > 127
    inner = design.levels[5:-5, 5:-5] > 0.5
    np.testing.assert_array_equal(inner, cells)


def test_corners_of_a_checkerboard() -> None:
    found = targets_of(surface("checkerboard", columns=8, rows=5, square=0.03))
    assert found is not None
    assert found.shape == (4, 7)
    assert not found.markers
    points = np.array([found.crossings[name] for name in found.lattice]).reshape(4, 7, 2)
    np.testing.assert_allclose(np.diff(points, axis=1), np.broadcast_to([0.03, 0.0], (4, 6, 2)), atol=1e-12)
    np.testing.assert_allclose(np.diff(points, axis=0), np.broadcast_to([0.0, 0.03], (3, 7, 2)), atol=1e-12)
    assert set(map(tuple, np.round(list(found.arms.values()), 9))) == {(0.03, 0.03)}


@needs_aruco
@pytest.mark.parametrize(
    ("kind", "dictionary", "found_as", "markers", "crossings"),
    [
        ("charuco", None, "DICT_4X4_50", 12, 5 * 3 + 0),
        ("charuco", "DICT_5X5_1000", "DICT_5X5_50", 12, 15),
        ("apriltag", None, "DICT_APRILTAG_36h11", 24, 4 * 24),
        ("apriltag", "DICT_APRILTAG_16h5", "DICT_APRILTAG_16h5", 24, 96),
    ],
)
def test_markers_of_a_texture(
    kind: str, dictionary: str | None, found_as: str, markers: int, crossings: int
) -> None:
    board = surface(kind, columns=6, rows=4, square=0.04, dictionary=dictionary)
    found = targets_of(board)
    assert found is not None
    assert (found.dictionary, len(found.markers), len(found.crossings)) == (found_as, markers, crossings)
    side = 0.04 if kind == "apriltag" else 0.04 * (6 / 10 if found_as.startswith("DICT_4") else 7 / 11)
    for corners in found.markers.values():
        across, down = corners[1] - corners[0], corners[3] - corners[0]
        np.testing.assert_allclose((across, down), [(side, 0), (0, side)], atol=1e-9)


def test_circles_of_a_texture() -> None:
    found = targets_of(surface("circles", columns=6, rows=4, square=0.036))
    assert found is not None
    assert found.shape == (4, 6)
    assert not found.crossings
    x, y, radius = np.array([found.circles[name] for name in found.circles]).T
    np.testing.assert_allclose(radius, 0.009, rtol=3e-3)
    np.testing.assert_allclose(np.diff(x.reshape(4, 6), axis=1), 0.036, atol=1e-9)
    np.testing.assert_allclose(np.diff(y.reshape(4, 6), axis=0), 0.036, atol=1e-9)


def test_a_wall_of_greys_is_no_board() -> None:
    scene = load_scene(Path(__file__).parents[2] / "config" / "board.yaml")
    assert targets_of(scene.surfaces[0]) is None
    assert targets_of(scene.surfaces[1]) is None


def test_print_at_true_scale_and_its_scene(tmp_path: Path) -> None:
    for form in ("pdf", "svg"):
        words = [
            "board",
            "checkerboard",
            "--columns",
            "6",
            "--rows",
            "5",
            "--square",
            "0.025",
            "--greys",
            "0",
        ]
        assert (
            main([*words, "--paper", "a4", "--format", form, "--out", str(tmp_path / form), "--quiet"]) == 0
        )
    box = re.search(rb"/MediaBox\s*\[\s*0 0 ([\d.]+) ([\d.]+)", (tmp_path / "pdf.pdf").read_bytes())
    assert box is not None
    np.testing.assert_allclose([float(one) / 72 * 25.4 for one in box.groups()], [210, 297], atol=0.01)
    svg = (tmp_path / "svg.svg").read_text()
    size = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', svg)
    assert size is not None
    np.testing.assert_allclose([float(one) / 72 * 25.4 for one in size.groups()], [210, 297], atol=0.01)
    # squares of 25 mm, black: paths of four corners
    paths = re.findall(r'<path d="M ([\d.]+) ([\d.]+) \nL ([\d.]+) ([\d.]+) \nL ([\d.]+) ([\d.]+) ', svg)
    sides = [(abs(float(c) - float(a)), abs(float(f) - float(d))) for a, b, c, d, e, f in paths]
    black = [one for one in sides if np.allclose(one, 25 / 25.4 * 72, atol=0.01)]
    assert len(black) == 15
    (board,) = load_scene(tmp_path / "pdf.yaml").surfaces
    assert board.size == pytest.approx((0.2, 0.175))
    found = targets_of(board)
    assert found is not None
    assert found.shape == (4, 5)


#: Sizes of paper [mm] by ISO 216 and ANSI/ASME Y14.1, shorter side first.
MILLIMETRES = {"A4": (210, 297), "A3": (297, 420), "letter": (215.9, 279.4)}


def page_of(path: Path) -> list[float]:
    """Return the sides of a PDF's page in mm, the shorter first."""
    box = re.search(rb"/MediaBox\s*\[\s*0 0 ([\d.]+) ([\d.]+)", path.read_bytes())
    assert box is not None
    return sorted(float(side) / 72 * 25.4 for side in box.groups())


@needs_aruco
@pytest.mark.parametrize(
    ("words", "paper", "said"),
    [
        (["checkerboard"], "A4", r"8 x 5 squares of 20 mm.*for A4\n.*focal length of 200 px \(SR-3000\)\n"),
        (["circles"], "A4", r"7 x 4 circles of 15 mm, 30 mm apart"),
        # modules of 4 mm: 1.4 px of a focal length of 200 px at 0.57 m
        (
            ["charuco"],
            "A3",
            r"4 x 4 squares of 50 mm.*\n.*; A4 would take --square 0.04, up to about 0.57 m\n",
        ),
        (["apriltag"], "A3", r"of 50 mm.*\n.*; A4 would take --square 0.037, up to about 0.66 m\n"),
        (["apriltag", "--paper", "a4"], "A4", r"3 x 4 tags DICT_APRILTAG_36h11 of 37 mm"),
        (["checkerboard", "--paper", "letter"], "letter", r"8 x 5 squares of 21 mm.*for letter\n"),
        (["checkerboard", "--square", "0.03"], "A3", r"; A4 would take --square 0.02, up to about 1 m\n"),
    ],
)
def test_a_board_is_for_a_usual_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], paper: str, said: str
) -> None:
    """The smallest that it fits, or the one requested, with the largest squares that fit."""
    assert main(["board", *words, "--out", str(tmp_path / "board")]) == 0
    output = capsys.readouterr().out
    assert re.search(said, output)
    assert f"print on {paper} at 100 %" in output
    np.testing.assert_allclose(page_of(tmp_path / "board.pdf"), MILLIMETRES[paper], atol=0.01)
    size = load_scene(tmp_path / "board.yaml").surfaces[0].size
    assert size is not None
    # printers leave 5 mm
    assert all(1000 * side <= room - 10 for side, room in zip(sorted(size), MILLIMETRES[paper], strict=True))


def test_default_checkerboards_and_circles_fit_letter_as_well(tmp_path: Path) -> None:
    for kind, square in (("checkerboard", "0.02"), ("circles", "0.03")):
        words = ["board", kind, "--square", square, "--paper", "letter", "--quiet"]
        assert main([*words, "--out", str(tmp_path / kind)]) == 0
        np.testing.assert_allclose(page_of(tmp_path / f"{kind}.pdf"), MILLIMETRES["letter"], atol=0.01)


def test_a_board_larger_than_any_paper_has_its_own_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten squares across with the margin are 2 m, beyond A0; 5 mm around and the ruler below are added."""
    assert main(["board", "checkerboard", "--square", "0.2", "--out", str(tmp_path / "board")]) == 0
    output = capsys.readouterr().out
    assert "it fits no usual paper; A4 would take --square 0.02, up to about 1 m\n" in output
    assert "print on a page of 2010 x 1826 mm at 100 %" in output
    np.testing.assert_allclose(page_of(tmp_path / "board.pdf"), [1826, 2010], atol=0.01)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["checkerbord"], r"KIND: no kind of board 'checkerbord' \(did you mean 'checkerboard'\?\)"),
        (["checkerboard", "--square", "1e9"], r"a side of 1e\+09 m \(from 0.001 to 1 m\)"),
        (["checkerboard", "--columns", "2"], r"2 x 5 is no board \(from 4 to 200 each\)"),
        (
            ["checkerboard", "--square", "0.03", "--paper", "a4"],
            r"--paper: the board with its ruler takes 310 x 296 mm, more than A4 \(--square 0.02 fits it, or "
            r"--paper a3\)",
        ),
        (["circles", "--columns", "60", "--rows", "60"], r"cells, at most 40000 make a scene file"),
        (["checkerboard", "--dictionary", "DICT_4X4_50"], r"a checkerboard has no markers"),
        (["checkerboard", "--greys", "1"], r"1 grey fields \(0 or 2 to 16\)"),
        (["checkerboard", "--ink", "0.9"], r"reflectivities of ink 0.9 and paper 0.85"),
        (["checkerboard", "--name", "a/b"], r"'a/b' is no name"),
    ],
)
def test_bad_boards(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], match: str) -> None:
    assert main(["board", *words, "--out", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert re.search(match, said)
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


@needs_aruco
def test_too_few_markers() -> None:
    with pytest.raises(InputError, match=r"DICT_APRILTAG_16h5 has 30 markers, 42 are needed"):
        design_board("apriltag", columns=7, rows=6, square=0.02, dictionary="DICT_APRILTAG_16h5")
    with pytest.raises(InputError, match=r"no dictionary 'DICT_4X4_60'"):
        design_board("charuco", columns=7, rows=6, square=0.02, dictionary="DICT_4X4_60")
