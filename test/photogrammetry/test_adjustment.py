"""The bundle adjustment against OpenCV, against its own covariance, and with input that it cannot use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rim_camera_ros.camera_file import camera_numbers
from rim_camera_ros.errors import InputError
from rim_camera_ros.frame import Pose
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry import Distance, ImagePoint, Observations, estimate_optics
from rim_camera_ros.photogrammetry.projection import OPTICS_PARAMETERS, projection_derivatives
from rim_camera_ros.rotations import quaternion

from .helpers import HEIGHT, SR3000, WIDTH, camera, field, seen, stations, vector

START = Optics(fx=205.0, fy=203.0, cx=87.5, cy=71.5)


def test_derivatives_equal_opencv() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([-0.5, -0.4, 1.1], [0.5, 0.6, 2.9], (30, 3))
    optics = replace(SR3000, fy=187.3)
    matrix = np.array([[optics.fx, 0, optics.cx], [0, optics.fy, optics.cy], [0, 0, 1.0]])
    _, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(optics.d))
    jacobian = jacobian.reshape(30, 2, -1)
    by_optics, by_point = projection_derivatives(optics, points)
    np.testing.assert_allclose(by_point, jacobian[..., 3:6], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(by_optics, jacobian[..., 6:15], rtol=1e-9, atol=1e-9)


def test_same_solution_as_opencv() -> None:
    """cv2.calibrateCamera takes float32 points: 1e-5 px."""
    rng = np.random.default_rng(1)
    observations = seen(field(), stations(rng), rng, sigma=0.08)
    observations = replace(
        observations,
        points=tuple(
            replace(p, u=float(np.float32(p.u)), v=float(np.float32(p.v))) for p in observations.points
        ),
    )
    by_station: dict[int, list[ImagePoint]] = {}
    for one in observations.points:
        by_station.setdefault(one.station, []).append(one)
    objects = [
        np.array([observations.field.targets[p.target].position for p in points], np.float32)
        for points in by_station.values()
    ]
    images = [np.array([(p.u, p.v) for p in points], np.float32) for points in by_station.values()]
    rms, matrix, d, rotations, translations = cv2.calibrateCamera(
        objects,
        images,
        (WIDTH, HEIGHT),
        np.array([[205.0, 0, 87.5], [0, 203, 71.5], [0, 0, 1]]),
        None,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 1000, 1e-15),
    )
    optics, covariance, report = estimate_optics(
        observations, start=START, significance=None, loss="squared", correct_ellipses=False
    )
    expected = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *d.ravel()])
    sigma = np.sqrt(np.diag(covariance.matrix))
    np.testing.assert_allclose((vector(optics) - expected) / sigma, 0, atol=1e-3)
    assert report.residual_rms * np.sqrt(2) == pytest.approx(rms, rel=1e-6)
    for i, station in enumerate(by_station):
        np.testing.assert_allclose(report.poses[station].position, translations[i].ravel(), atol=2e-6)
        turn = (
            Rotation.from_quat(report.poses[station].orientation)
            * Rotation.from_rotvec(rotations[i].ravel()).inv()
        )
        assert turn.magnitude() < 2e-6


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"targets": "free"},
        {"targets": "free", "distances": [Distance("t00", "t44", float(np.hypot(1.0, 0.88)), 1e-4)]},
    ],
    ids=["known", "free", "free with a distance"],
)
def test_covariance_holds_what_it_promises(options: dict[str, Any]) -> None:
    """Table 3.2's camera: within 3 sigma (3.5 for the largest of 108), pooled normalised errors near 1."""
    errors, zeros = [], []
    for seed in range(12):
        rng = np.random.default_rng(300 + seed)
        observations = seen(field(), stations(rng), rng)
        optics, covariance, report = estimate_optics(observations, start=START, significance=None, **options)
        assert len(covariance.parameters) == 9
        errors.append((vector(optics) - vector(SR3000)) / np.sqrt(np.diag(covariance.matrix)))
        zeros.append(report.sigma_zero)
    pooled = np.array(errors)
    assert np.abs(pooled).max() < 3.5
    assert (np.abs(pooled) < 3).mean() > 0.99
    assert 0.8 < np.sqrt(np.mean(pooled**2)) < 1.2
    assert np.mean(zeros) == pytest.approx(1.0, abs=0.03)


def test_precision_is_that_of_the_thesis() -> None:
    """Table 3.2: 25 targets, 16 images, 4.01 um = 0.1 px RMS give c to 0.35 px, principal point to 0.5 px."""
    rng = np.random.default_rng(8)
    observations = seen(field(), stations(rng), rng, sigma=0.1)
    _, covariance, _ = estimate_optics(observations, start=START, significance=None)
    for path, stated in (("optics.fx", 0.347), ("optics.cx", 0.492), ("optics.cy", 0.507)):
        assert stated / 2 < covariance.sigma(path) < stated * 2
    with pytest.raises(KeyError, match=r"optics\.fz"):
        covariance.sigma("optics.fz")


def test_free_targets_keep_the_datum_and_take_the_scale_of_a_distance() -> None:
    """Approximate coordinates wrong by 3 mm each and 2 % too large in all."""
    rng = np.random.default_rng(21)
    true = field(depth=0.06)
    observations = seen(true, stations(rng, 20), rng, sigma=0.02)
    rough = {
        name: replace(one, position=tuple(1.02 * np.array(one.position) + rng.normal(0, 0.003, 3)))
        for name, one in true.targets.items()
    }
    observations = replace(observations, field=replace(true, targets=rough))

    def length(positions: Any, first: str, second: str) -> float:
        return float(np.linalg.norm(np.subtract(positions[first], positions[second])))

    exact = {name: one.position for name, one in true.targets.items()}
    known = Distance("t00", "t43", length(exact, "t00", "t43"), 5e-5)
    optics, covariance, report = estimate_optics(
        observations, start=START, targets="free", distances=[known], significance=None
    )
    error = (vector(optics) - vector(SR3000)) / np.sqrt(np.diag(covariance.matrix))
    assert np.abs(error).max() < 3.5
    assert length(report.targets, "t40", "t04") == pytest.approx(length(exact, "t40", "t04"), abs=5e-4)
    # inner constraints: the centre of the targets stays where the approximate ones have it
    before = np.mean([one.position for one in rough.values()], axis=0)
    np.testing.assert_allclose(np.mean(list(report.targets.values()), axis=0), before, atol=1e-6)
    _, _, without = estimate_optics(observations, start=START, targets="free", significance=None)
    assert length(without.targets, "t40", "t04") > 1.015 * length(exact, "t40", "t04")


def test_uncorrected_ellipse_centres_bias_the_camera_constant() -> None:
    rng = np.random.default_rng(4)
    observations = seen(field(), stations(rng), rng, sigma=0.005)
    corrected, covariance, _ = estimate_optics(observations, start=START, significance=None)
    biased, _, _ = estimate_optics(observations, start=START, significance=None, correct_ellipses=False)
    assert abs(corrected.fx - SR3000.fx) < 3 * covariance.sigma("optics.fx") < 0.06
    assert abs(biased.fx - SR3000.fx) > 0.15


def test_gross_errors_are_rejected_and_named() -> None:
    rng = np.random.default_rng(6)
    observations = seen(field(), stations(rng), rng)
    points = list(observations.points)
    wrong = {17: (0.8, 0.0), 140: (0.0, -6.0), 290: (3.0, 4.0)}
    for i, (du, dv) in wrong.items():
        points[i] = replace(points[i], u=points[i].u + du, v=points[i].v + dv)
    optics, covariance, report = estimate_optics(
        replace(observations, points=tuple(points)), start=START, significance=None
    )
    named = {(one.target, one.station) for one in report.rejected}
    assert named == {(points[i].target, points[i].station) for i in wrong}
    (large,) = (one for one in report.rejected if one.station == points[140].station)
    assert large.residual[1] == pytest.approx(-6.0, abs=0.5)
    assert np.abs((vector(optics) - vector(SR3000)) / np.sqrt(np.diag(covariance.matrix))).max() < 3.5
    assert f"rejected: target {points[140].target} at station {points[140].station}" in report.text()
    _, _, plain = estimate_optics(
        replace(observations, points=tuple(points)), start=START, significance=None, loss="squared"
    )
    assert plain.rejected == ()
    assert plain.sigma_zero > 3 * report.sigma_zero


def test_a_result_that_is_not_to_be_used_says_so_first() -> None:
    """Every seventh target is a gross error; or all err three times as much as is stated."""
    rng = np.random.default_rng(19)
    observations = seen(field(), stations(rng, 10), rng)
    points = list(observations.points)
    for i in range(0, len(points), 7):
        points[i] = replace(points[i], u=points[i].u + 2.0)
    _, _, report = estimate_optics(replace(observations, points=tuple(points)), start=START)
    first = report.text().splitlines()[0]
    assert first.startswith(
        f"warning: {len(range(0, len(points), 7))} of {len(points)} targets were rejected"
    )
    assert "do not use these optics" in first
    closer = [replace(point, sigma=point.sigma / 3) for point in observations.points]
    _, covariance, report = estimate_optics(replace(observations, points=tuple(closer)), start=START)
    assert report.text().startswith(
        "warning: residuals are 3 times as large as the images of the targets imply"
    )
    _, stated, report = estimate_optics(observations, start=START)
    assert report.doubts == ()
    for path in stated.parameters:
        assert covariance.sigma(path) == pytest.approx(stated.sigma(path), rel=1e-3)


def test_parameters_without_significance_are_not_estimated() -> None:
    """A lens with k1 only and square pixels."""
    rng = np.random.default_rng(13)
    lens = Optics(fx=199.9, fy=199.9, cx=90.0, cy=82.4, d=(-0.11, 0.0, 0.0, 0.0, 0.0))
    observations = seen(field(), stations(rng), rng, optics=lens)
    optics, covariance, report = estimate_optics(observations, start=replace(START, fy=205.0))
    assert {name for one in report.insignificant for name in one.parameters} == {"k3", "k2", "p1", "p2", "fy"}
    assert [one.parameters for one in report.insignificant].index(("k3",)) < [
        one.parameters for one in report.insignificant
    ].index(("k2",))
    assert all(one.probability > 0.05 for one in report.insignificant)
    assert optics.d[1:] == (0.0, 0.0, 0.0, 0.0)
    assert optics.fy == pytest.approx(optics.fx, rel=1e-12)
    assert covariance.parameters == ("optics.fx", "optics.fy", "optics.cx", "optics.cy", "optics.d.0")
    assert covariance.matrix[0, 1] == pytest.approx(covariance.matrix[0, 0], rel=1e-9)
    for path, true, value in zip(
        covariance.parameters, (199.9, 199.9, 90.0, 82.4, -0.11), vector(optics), strict=False
    ):
        assert abs(value - true) < 3 * covariance.sigma(path)
    assert set(covariance.parameters) <= set(camera_numbers(camera(optics)))
    assert "no significant change: p1 and p2 (kept as given, F = " in report.text()
    assert report.summary()["left_out"] == [name for one in report.insignificant for name in one.parameters]


def test_a_lens_with_everything_keeps_everything() -> None:
    rng = np.random.default_rng(14)
    lens = replace(SR3000, fy=203.4)
    observations = seen(field(), stations(rng), rng, sigma=0.01, optics=lens)
    optics, covariance, report = estimate_optics(observations, start=START)
    assert report.insignificant == ()
    assert np.abs((vector(optics) - vector(lens)) / np.sqrt(np.diag(covariance.matrix))).max() < 3.5


def test_parameters_that_are_not_requested_stay() -> None:
    rng = np.random.default_rng(15)
    observations = seen(field(), stations(rng), rng)
    start = replace(SR3000, fx=210.0, fy=210.0 * 1.001, cx=88.0)
    optics, covariance, report = estimate_optics(
        observations, start=start, parameters=["fx", "cx", "cy"], significance=None
    )
    assert optics.d == SR3000.d
    assert optics.fy / optics.fx == pytest.approx(1.001, rel=1e-12)
    assert covariance.parameters == ("optics.fx", "optics.fy", "optics.cx", "optics.cy")
    assert set(report.values) == set(OPTICS_PARAMETERS)
    assert "k1" not in report.sigmas
    assert abs(optics.cx - SR3000.cx) < 0.3


def test_without_roll_principal_point_and_decentring_are_not_separable() -> None:
    """Tilts to one side, as a camera on a tripod before a wall has them."""
    kinds = {}
    for roll in (False, True):
        rng = np.random.default_rng(16)
        poses = stations(rng, roll=roll, tilts=((-5, 5), (10, 30)))
        _, covariance, report = estimate_optics(seen(field(), poses, rng), start=START, significance=None)
        kinds[roll] = (covariance, report)
    (note,) = kinds[False][1].notes
    assert note.startswith("no station is rotated about the optical axis (largest roll between stations ")
    assert "principal point and decentring are not separable (correlation cx - p2 -0." in note
    assert f"note: {note}" in kinds[False][1].text()
    assert kinds[True][1].notes == ()
    for path, factor in (("optics.cx", 3), ("optics.d.3", 1.6)):
        assert kinds[False][0].sigma(path) > factor * kinds[True][0].sigma(path)


def test_strong_correlations_are_named() -> None:
    rng = np.random.default_rng(17)
    _, covariance, report = estimate_optics(seen(field(), stations(rng), rng), start=START, significance=None)
    index = {name: i for i, name in enumerate(OPTICS_PARAMETERS)}
    sigma = np.sqrt(np.diag(covariance.matrix))
    correlation = covariance.matrix / np.outer(sigma, sigma)
    strong = {
        frozenset((a, b))
        for a in OPTICS_PARAMETERS
        for b in OPTICS_PARAMETERS
        if a != b and abs(correlation[index[a], index[b]]) > 0.9
    }
    assert frozenset(("k1", "k2")) in strong
    assert {frozenset(pair[:2]) for pair in report.correlations} == strong
    assert any(a == "cx" and b.startswith("x of station") for a, b, _ in report.pose_correlations)


# --- what cannot work ------------------------------------------------------------------------------


def observations(seed: int = 31, **options: Any) -> Observations:
    rng = np.random.default_rng(seed)
    return seen(field(), stations(rng, 6), rng, **options)


def only(kept: Any) -> Observations:
    whole = observations()
    return replace(whole, points=tuple(one for one in whole.points if kept(one)))


def test_too_few_targets() -> None:
    with pytest.raises(InputError, match=r"which has most: 3 targets, at least 4 are needed \(bring more"):
        estimate_optics(only(lambda one: one.target in ("t11", "t23", "t32")), start=START)
    with pytest.raises(InputError, match="too few targets: none was observed"):
        estimate_optics(only(lambda one: False), start=START)
    few = ("t11", "t13", "t31", "t33")
    with pytest.raises(InputError, match=r"too few targets: 16 measured values for 21 unknowns"):
        estimate_optics(only(lambda one: one.target in few and one.station < 2), start=START)


def test_one_station() -> None:
    with pytest.raises(
        InputError, match=r"stations: only one station \(3\) has enough targets \(observe the"
    ):
        estimate_optics(only(lambda one: one.station == 3), start=START)


def test_a_station_with_few_targets_is_excluded() -> None:
    kept = ("t11", "t12", "t21")
    _, _, report = estimate_optics(only(lambda one: one.station != 2 or one.target in kept), start=START)
    assert "station 2 excluded: 3 targets, at least 4 are needed" in report.notes
    assert set(report.station_rms) == {0, 1, 3, 4, 5}


def test_a_plane_seen_from_one_direction() -> None:
    tilt = Rotation.from_euler("x", 25, degrees=True)
    poses = {i: Pose((0.05 * i, -0.04 * i, 1.3 + 0.15 * i), quaternion(tilt.as_matrix())) for i in range(5)}
    flat = seen(field(), poses, np.random.default_rng(3))
    with pytest.raises(
        InputError, match="all targets lie in a plane and all stations see it from one direct"
    ):
        estimate_optics(flat, start=START)
    # a field with depth needs no second direction
    deep = seen(field(depth=0.08), poses, np.random.default_rng(3))
    optics, covariance, _ = estimate_optics(deep, start=START)
    assert abs(optics.fx - SR3000.fx) < 3.5 * covariance.sigma("optics.fx")


def test_mismatched_ids() -> None:
    whole = observations()
    renamed = (replace(whole.points[0], target="T00"), *whole.points[1:])
    with pytest.raises(
        InputError, match=r"target 'T00' of station 0 is not in the target field \(did you mean"
    ):
        estimate_optics(replace(whole, points=renamed), start=START)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"parameters": ["fx", "k4"]}, r"parameters: unknown optics parameter 'k4' \(did you mean 'k"),
        ({"parameters": ["fy", "cx"]}, "fy is estimated without fx"),
        (
            {"distances": [Distance("t00", "t44", 1.0, 1e-4)]},
            "known distances were given together with known",
        ),
        (
            {"targets": "free", "distances": [Distance("t00", "t45", 1.0, 1e-4)]},
            r"names target 't45', which is not in the field \(did you mean 't4",
        ),
        (
            {"targets": "free", "distances": [Distance("t00", "t44", 1.0, 0.0)]},
            "t00 - t44 is 1 m, sigma 0 m",
        ),
    ],
)
def test_wrong_options(options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        estimate_optics(observations(), start=START, **options)
    assert "\n" not in str(caught.value)


def test_wrong_points() -> None:
    whole = observations()
    twice = (*whole.points, whole.points[7])
    with pytest.raises(InputError, match=f"'{whole.points[7].target}' was observed 2 times at station 0"):
        estimate_optics(replace(whole, points=twice), start=START)
    for wrong in ({"sigma": 0.0}, {"u": float("nan")}):
        spoiled = (replace(whole.points[0], **wrong), *whole.points[1:])
        with pytest.raises(InputError, match="must be numbers and sigma positive"):
            estimate_optics(replace(whole, points=spoiled), start=START)


def test_targets_on_a_line_are_no_station() -> None:
    row = ("t20", "t21", "t22", "t23", "t24")
    with pytest.raises(InputError, match="which has most: its 5 targets lie on one line"):
        estimate_optics(only(lambda one: one.target in row), start=START)
    _, _, report = estimate_optics(only(lambda one: one.station != 4 or one.target in row), start=START)
    assert "station 4 excluded: its 5 targets lie on one line" in report.notes


def test_what_the_geometry_does_not_determine_is_named() -> None:
    """Free targets, all stations at the same place: no ray says how far away a target is."""
    rng = np.random.default_rng(0)
    poses = dict.fromkeys(range(5), Pose((0.02, -0.03, 1.5)))
    with pytest.raises(
        InputError, match=r"stations: the observations do not determine the .+ \(add stations"
    ):
        estimate_optics(seen(field(depth=0.08), poses, rng), start=START, targets="free")
