"""The benchmark's baselines compute what the package computes; times are not looked at here."""

from __future__ import annotations

import pytest

from test.bench import cases, joint, rows


@pytest.mark.parametrize("size", [cases.SIZES[0], (61, 47)])
@pytest.mark.parametrize("row", [rows.cloud, rows.scattering, rows.samples, rows.message, rows.decoding])
def test_the_baseline_agrees(row, size: tuple[int, int]) -> None:
    made = row(size)
    if made is None:
        pytest.skip("needs ROS")
    made.ours()
    made.naive()


def test_rows_without_a_baseline_run() -> None:
    for row in (rows.every_effect(), rows.simulation(), rows.threads(), *rows.parts_of_every_effect()[:2]):
        row.ours()


@pytest.mark.long
def test_the_joint_adjustment_finds_what_general_least_squares_find() -> None:
    given = joint.work(samples=32_000)
    (found, sigma), _, memory = joint.measured(lambda: joint.ours(given))
    expected, _, more = joint.measured(lambda: joint.naive(given))
    assert abs((found - expected) / sigma).max() < 0.03
    assert memory < more / 10
