"""What pages are made of: text is no markup, tables align, and the check of pages finds what is wrong."""

from __future__ import annotations

import re

import pytest

from rim_camera_ros.reports.page import Bullets, Card, Figure, Folded, Part, Table, Tagged, Text, render
from rim_camera_ros.reports.words import joined, noise_words, percent

from .pages import faults_of, text_of


def page_of(*parts: Part) -> str:
    experiments = [("heading <i>", list(parts))]
    return render(
        "reproduction",
        title="a < b & c",
        under="under",
        first="first",
        mood="",
        introduction="<script>alert(1)</script>",
        experiments=experiments,
    )


def test_text_is_no_markup() -> None:
    page = page_of(Text("<b>"), Bullets(["x > 1"]), Figure("a.png", 'a picture of "x" < y', "<caption>"))
    assert "<title>a &lt; b &amp; c</title>" in page
    assert "<p>&lt;b&gt;</p>" in page
    assert "<li>x &gt; 1</li>" in page
    assert 'alt="a picture of &#34;x&#34; &lt; y"' in page
    assert "<script" not in page
    assert "<i>" not in page
    assert faults_of(page) == []


def test_tables_align_numbers_head_groups_and_colour_rows() -> None:
    rows = [["group"], ["x", "1"], ["y", "2"]]
    page = page_of(Table(["name", "value"], rows, numbers=(1,), moods={2: "warn"}))
    assert '<td colspan="2">group</td>' in page
    assert '<tr><td>x</td><td class="n">1</td></tr>' in page
    assert '<tr class="warn"><td>y</td><td class="n">2</td></tr>' in page
    assert '<th scope="col" class="n">value</th>' in page


def test_empty_parts_leave_nothing() -> None:
    page = page_of(Table(["name"], []), Tagged([]), Bullets([]))
    assert not re.search("<table|<ul", page)
    assert "<section>" not in page_of()


def test_folded_parts_are_there() -> None:
    page = page_of(Folded("more", [Text("inner"), Table(["a"], [["1"], ["2", "3"]])]))
    assert re.search(r"<details><summary>more</summary>\s*<p>inner</p>", page)
    assert faults_of(page) == []


def test_pictures_are_in_the_page_or_beside_it() -> None:
    page = page_of(Figure(b"<svg/>", "a picture in the page"), Figure("b.png", "a picture beside it"))
    assert 'src="data:image/svg+xml;base64,PHN2Zy8+"' in page
    assert 'src="b.png"' in page


@pytest.mark.parametrize(
    ("broken", "fault"),
    [
        (lambda page: page.replace('alt="a picture of x"', ""), "picture 0 has no alt text"),
        (lambda page: page.replace("</section>", ""), r"</\w+> closes nothing"),
        (lambda page: page.replace("<h2>", "<h4>").replace("</h2>", "</h4>"), "h4 follows h1"),
        (lambda page: page.replace("a.png", "https://example.org/a.png"), "needs the network"),
        (lambda page: page.replace("first", "nan mm"), "'nan' is read"),
        (lambda page: page.replace("<main>", "<main><script></script>"), "a script"),
    ],
)
def test_the_check_finds_faults(broken: object, fault: str) -> None:
    page = page_of(Figure("a.png", "a picture of x"))
    assert faults_of(page) == []
    found = faults_of(broken(page))  # type: ignore[operator]
    assert any(re.search(fault, one) for one in found), found


def test_the_text_of_a_page_is_what_is_read() -> None:
    assert "first <script>alert(1)</script> heading <i> x" in text_of(page_of(Text("x")))


def test_cards_stand_with_their_mood() -> None:
    from rim_camera_ros.reports.page import _environment

    cards = _environment().get_template("parts.html").module.cards  # type: ignore[attr-defined]
    made = cards([Card("1 mm", "size", "warn"), Card("<2>", "x")])
    assert '<div class="card warn"><b>1 mm</b><span>size</span></div>' in made
    assert "<b>&lt;2&gt;</b>" in made


@pytest.mark.parametrize(
    ("chi_square", "words", "mood"),
    [
        (0.97, "noise as expected", "good"),
        (1.10, "noise as expected", "good"),
        (2.25, "50 % above the noise", "warn"),
        (12.96, "3.6 times the noise", "warn"),
        (4.0e6, "2,000 times the noise", "warn"),
    ],
)
def test_chi_square_in_words(chi_square: float, words: str, mood: str) -> None:
    assert noise_words(chi_square) == (words, mood)


def test_enumerations_and_shares() -> None:
    assert joined(["a", "b", "c"], "or") == "a, b or c"
    assert joined(["a"]) == "a"
    assert (percent(0.123), percent(0.0012), percent(0.0)) == ("12 %", "0.12 %", "0 %")
