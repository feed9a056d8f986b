"""The second generator against analytic cases and statistics of its own draws."""

import copy
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from test.blind.imperfect import Case, make_case
from test.blind.imperfect.__main__ import main, read
from test.blind.imperfect.combined import refitted
from test.blind.imperfect.electrons import SPEED_OF_LIGHT, Sensor, sigma
from test.blind.imperfect.expert import Expert, Sight, _left, absorbed, observe
from test.blind.imperfect.geometry import Lens, Placement, Spot, Surface, mixed, trace, turn
from test.blind.imperfect.imperfections import OFF, PARTS, displaced, draw_world, reported
from test.blind.imperfect.plan import COUNTS, plan
from test.blind.imperfect.scenes import STYLES, draw_scene, swapped
from test.blind.imperfect.score import judged, overlap, rate, region, summary
from test.blind.imperfect.setups import SETUPS, decidable

SENSOR = Sensor(third=0.009 * np.exp(0.7j), fifth=0.003 * np.exp(-1.1j))


# electrons


@pytest.mark.parametrize("amplitude", [80.0, 300.0, 2500.0])
def test_stated_noise_is_that_of_the_electrons_to_a_percent(amplitude):
    drawn, of_amplitude = SENSOR.measured_noise(amplitude, seed=99, repetitions=200_000)
    stated = float(sigma(SENSOR.noise_model(), np.array(amplitude)))
    assert stated == pytest.approx(drawn, rel=0.01)
    # circular in the complex plane, as the camera file means it
    assert of_amplitude == pytest.approx(2 * np.pi / SENSOR.ambiguity * amplitude * stated, rel=0.02)


def test_noise_is_that_of_counting_electrons():
    # variance of a phase from four taps of mean B: B / (2 a^2), here with read-out and converter
    a = 400.0
    bare = replace(SENSOR, third=0j, fifth=0j, jitter=0.0)
    mean = a / bare.contrast * bare.electrons + bare.dark + bare.read**2 + bare.step**2 / 12
    expected = np.sqrt(mean / 2) / (a * bare.electrons) * SPEED_OF_LIGHT / (4 * np.pi * 20e6)
    assert bare.measured_noise(a, seed=3, repetitions=200_000)[0] == pytest.approx(expected, rel=0.01)


def test_energy_of_the_taps_is_the_light():
    phase = np.linspace(0.3, 6.0, 7)
    wave = 500 * np.exp(1j * phase)
    seen = []

    class Recording(Sensor):
        def collect(self, mean, rng):
            seen.append(mean)
            return mean

    sensor = Recording(third=0.02 + 0j, fifth=0.01j)
    found = sensor.demodulate((wave, wave**3 / 500**2, wave**5 / 500**4), np.full(7, 500.0), None)
    # the harmonics cancel in the sum of the taps, which is the light and the dark current
    np.testing.assert_allclose(sum(seen), 4 * (500 / sensor.contrast * sensor.electrons + sensor.dark))
    np.testing.assert_allclose(
        found / np.exp(1j * phase), 500 * (1 + 0.02 * np.exp(-4j * phase) + 0.01j * np.exp(4j * phase))
    )


def test_cyclic_error_is_that_of_the_harmonics():
    phase = np.linspace(0.1, 6.2, 500)
    wave = np.exp(1j * phase)
    measured = (
        np.angle(SENSOR.demodulate((wave, wave**3, wave**5), np.ones(500), None) * np.conj(wave))
        * SENSOR.ambiguity
        / (2 * np.pi)
    )
    stated = sum(a * np.sin(order * phase + p) for order, (a, p) in SENSOR.cyclic().items())
    # the product of both harmonics leaves a constant of second order, which is no cyclic error
    np.testing.assert_allclose(measured, stated, atol=4e-5)
    # to first order the error is Im((fifth - third) exp(4 i phase))
    by_hand = SENSOR.fifth - SENSOR.third
    amplitude, turned = SENSOR.cyclic()[4]
    assert amplitude == pytest.approx(abs(by_hand) * SENSOR.ambiguity / (2 * np.pi), rel=0.003)
    assert np.exp(1j * (turned - np.angle(by_hand))) == pytest.approx(1.0, abs=0.01)


# rays and pixels


def test_distorted_rays_agree_with_opencv():
    import cv2

    lens = Lens(102.0, 101.0, 44.0, 35.0, (-0.11, 0.04, 0.0007, -0.0005, 0.0))
    u, v = np.array([3.0, 44.0, 80.5]), np.array([66.0, 2.5, 30.0])
    rays = lens.directions(u, v)
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(lens.d))
    np.testing.assert_allclose(back[:, 0], np.stack([u, v], axis=1), atol=1e-6)


def test_area_of_a_pixel_against_the_coverage_of_an_edge():
    spot, edges = Spot(0.9, 0.2), np.linspace(-0.8, 0.8, 41)
    angle = 0.3  # not along the rows, so that the rays do not step over it together
    along = spot.offsets() @ np.array([np.cos(angle), np.sin(angle)])
    counted = np.array([(along < edge).mean() for edge in edges])
    rng = np.random.default_rng(4)
    drawn = rng.uniform(-0.45, 0.45, (400_000, 2)) + rng.normal(0, 0.2, (400_000, 2))
    exact = np.array([(drawn @ [np.cos(angle), np.sin(angle)] < edge).mean() for edge in edges])
    np.testing.assert_allclose(counted, exact, atol=0.035)
    np.testing.assert_allclose(
        [(drawn[:, 0] < edge).mean() for edge in edges], spot.coverage(edges), atol=0.004
    )
    assert spot.offsets().std(axis=0) == pytest.approx([spot.blur, spot.blur], rel=1e-6)
    assert drawn.std(axis=0) == pytest.approx([spot.blur] * 2, rel=0.01)


def test_defocus_has_the_blur_of_a_disc():
    spot = Spot(0.9, 0.1, disc=1.6)
    expected = np.sqrt(0.9**2 / 12 + 0.1**2 + 1.6**2 / 4)
    assert spot.offsets().std(axis=0) == pytest.approx([expected] * 2, rel=1e-6)


def test_edges_are_found_where_tiles_change():
    lens = Lens(100.0, 100.0, 43.6, 30.2, (0.0,) * 5)
    board = Surface("board", "plane", np.array([[0.2, 0.7]]), (0.5, 9.0))
    places = {"board": Placement(np.array([0.0, 4.4, 1.0]), np.eye(3))}
    found = mixed(lens, (60, 88), [board], places)
    # tiles change at x = 0 and 0.5 m, hence at 43.6 and 93.6 px, and -6.4 px
    assert set(np.flatnonzero(found.any(axis=0))) == {43, 44}
    assert set(np.flatnonzero(mixed(lens, (60, 88), [board], places, reach=4).any(axis=0))) == {43, 44}
    assert set(np.flatnonzero(mixed(lens, (60, 88), [board], places, reach=5).any(axis=0))) == {
        42,
        43,
        44,
        45,
    }


def test_tiles_planes_and_spheres_by_hand():
    surfaces = [
        Surface("wall", "rectangle", np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]), (0.4, 0.3), (4.0, 2.0)),
        Surface("ball", "sphere", np.array([[0.7]]), radius=0.5),
    ]
    places = {
        "wall": Placement(np.array([0.0, 0.0, 3.0]), turn((0, 1, 0), np.radians(30))),
        "ball": Placement(np.array([1.0, 0.0, 2.0]), np.eye(3)),
    }
    rays = np.array([[0, 0.1, 1], [0.5, 0, 1.0], [0, 0.9, 1]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = trace(rays, surfaces, places)
    np.testing.assert_array_equal(hits.surface, [0, 1, -1])
    assert hits.distance[0] == pytest.approx(3 * np.sqrt(1.01))
    assert hits.cosine[0] == pytest.approx(np.cos(np.radians(30)) / np.sqrt(1.01))
    # y = 0.3 is in the second row of tiles, or the first at the border: take what is inside
    assert hits.distance[1] == pytest.approx(np.sqrt(5) - 0.5)
    assert hits.cosine[1] == pytest.approx(1.0)


# imperfections


def test_pose_errors_have_the_stated_size_and_half_of_it_in_common():
    rng = np.random.default_rng(8)
    along, common = [], []
    for _ in range(150):
        scene = draw_scene("sweep", rng, stations=6)
        said = reported(scene, rng)
        off = np.array(
            [
                (one["target"].position - true["target"].position) @ true["target"].rotation[:, 2]
                for one, true in zip(said, scene.places, strict=True)
            ]
        )
        along.append(off)
        common.append(off.mean())
    along = np.array(along)
    assert along.std() == pytest.approx(0.0012, rel=0.12)
    within = along.std(axis=1, ddof=1)
    assert np.sqrt((within**2).mean()) == pytest.approx(0.0012 * np.sqrt(0.5), rel=0.1)
    # variance of the mean of six: half and a twelfth
    assert np.std(common) == pytest.approx(0.0012 * np.sqrt(7 / 12), rel=0.2)


def test_a_displaced_surface_is_moved_along_its_normal_and_tilted():
    place = Placement(np.array([0.3, -0.2, 2.0]), turn((1, 2, 0), 0.4))
    found = displaced(place, 0.003, 0.002, -0.001)
    np.testing.assert_allclose((found.position - place.position) @ place.rotation, [0, 0, -0.003], atol=1e-12)
    normal = place.rotation.T @ found.rotation[:, 2]
    np.testing.assert_allclose(normal, [-0.001, -0.002, 1.0], atol=1e-5)


def test_imperfections_can_be_switched_off_and_have_their_sizes():
    scene = draw_scene("board", np.random.default_rng(2))
    ideal, said = draw_world(scene, OFF["ideal"], np.random.default_rng(3))
    assert said.places is scene.places
    assert said.blur is None
    assert ideal.spot is None
    assert said.lens == ideal.lens
    assert not ideal.pattern.any()
    assert (ideal.gains == 1).all()
    assert (ideal.power == 1).all()
    np.testing.assert_array_equal(ideal.reflectivity["board"], scene.surfaces[1].values)
    whole, said = draw_world(scene, OFF["all"], np.random.default_rng(3))
    assert whole.pattern.std() == pytest.approx(np.hypot(0.009, np.hypot(0.0015, 0.001)), rel=0.1)
    assert whole.gains.std() == pytest.approx(0.015, rel=0.05)
    off = [
        draw_world(scene, OFF["all"], np.random.default_rng(seed))[0].reflectivity["board"]
        / scene.surfaces[1].values
        for seed in range(12)
    ]
    assert np.std(off) == pytest.approx(0.06, rel=0.12)
    focal = [draw_world(scene, OFF["all"], np.random.default_rng(seed)) for seed in range(60)]
    ratio = [told.lens.fx / world.lens.fx - 1 for world, told in focal]
    assert np.std(ratio) == pytest.approx(0.0015, rel=0.25)
    assert np.sqrt(said.covariance[0, 0]) / said.lens.fx == pytest.approx(0.0015, rel=1e-6)
    with pytest.raises(KeyError):
        OFF["none"]
    assert set(OFF["ideal"]) == set(PARTS)


# the expert


def test_absorbing_agrees_with_dense_least_squares():
    rng = np.random.default_rng(6)
    weight = rng.uniform(0.5, 2, (3, 4, 5))
    vectors = [rng.normal(size=(3, 4, 5)) for _ in range(2)]
    local = [rng.normal(size=(2, 4, 5)) for _ in range(3)]
    found = absorbed(vectors, weight, local, 0.7)
    w = weight.ravel()
    design = np.zeros((60, 20 + 6))
    for s in range(3):
        design[s * 20 : (s + 1) * 20, :20] = np.eye(20) * 0.7
        design[s * 20 : (s + 1) * 20, 20 + 2 * s : 22 + 2 * s] = local[s].reshape(2, 20).T
    rows = np.vstack([design * w[:, None], np.eye(26)])
    goal = np.concatenate([vectors[0].ravel() * w, np.zeros(26)])
    _, left, *_ = np.linalg.lstsq(rows, goal, rcond=None)
    assert found[0, 0] == pytest.approx(float(left[0]), rel=1e-9)
    again = np.concatenate([vectors[1].ravel() * w, np.zeros(26)])[:, None]
    _, left, *_ = np.linalg.lstsq(np.hstack([rows, again]), goal, rcond=None)
    assert _left(found, [1]) == pytest.approx(float(left[0]), rel=1e-6)


def test_differences_of_distances_are_taken_modulo_a_period():
    one = Sight(np.array([[[0.1]]]), np.zeros((1, 1, 1)))
    other = Sight(np.array([[[7.4]]]), np.zeros((1, 1, 1)))
    assert one.minus(other, 7.5).distance[0, 0, 0] == pytest.approx(0.2)


# set-ups and plan


def test_swapping_exchanges_bright_and_dark():
    values = np.array([[0.1, 0.3], [0.9, 0.3]])
    np.testing.assert_array_equal(swapped(values), [[0.9, 0.3], [0.1, 0.3]])


@pytest.mark.parametrize("name", SETUPS)
def test_a_wrong_set_up_says_something_else_than_what_was(name):
    style = "sweep" if name == "depth" else "board"
    rng = np.random.default_rng(11)
    scene = draw_scene(style, rng)
    world, stated = draw_world(scene, OFF["ideal"], rng)
    told = SETUPS[name](scene, stated, rng)
    before = {s.name: s for s in scene.surfaces}
    changed = {
        "tiles": any(not np.array_equal(s.values, before[s.name].values) for s in told.surfaces),
        "cells": any(s.cell != before[s.name].cell for s in told.surfaces),
        "places": any(
            not np.allclose(one[n].position, two[n].position)
            or not np.allclose(one[n].rotation, two[n].rotation)
            for one, two in zip(told.places, scene.places, strict=True)
            for n in one
        ),
        "lens": told.lens != world.lens,
        "counts": told.along_z,
    }
    expected = {
        "turned_180": "tiles",
        "mirrored": "tiles",
        "inverted": "tiles",
        "scale": "cells",
        "other_lens": "lens",
        "z_distance": "counts",
    }.get(name, "places")
    assert [what for what, yes in changed.items() if yes] == [expected]
    allowed = "turned_180 mirrored inverted scale depth pose units z_distance other_lens"
    assert told.hypothesis in allowed.split()


def test_plan_meets_effects_in_turn_and_keeps_its_first_cases():
    cases = plan({"single": 32, "null": 3})
    assert sorted(c.effects for c in cases[:16]) == sorted(c.effects for c in cases[16:32])
    assert plan({"null": 2})[1] == cases[33]
    assert len(plan()) == sum(COUNTS.values())
    with pytest.raises(ValueError, match=r"no such tiers or imperfections: doubles"):
        plan({"doubles": 1})


# cases


def test_a_case_is_determined_by_its_seed_and_readable(tmp_path):
    case = Case("null-000", "null", 21, (), "all")
    truths = [make_case(tmp_path / name, case) for name in ("one", "two")]
    assert {k: v for k, v in truths[0].items() if k != "seconds"} == {
        k: v for k, v in truths[1].items() if k != "seconds"
    }
    for name in ("camera.yaml", "scene.yaml", "covariance.npy", "truth.npy", "recording/recording.mcap"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), name
    ended = subprocess.run(
        [sys.executable, "-m", "rim_camera_ros.cli", "info", str(tmp_path / "one" / "recording"), "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(ended.stdout)["frames"] == 60
    for name in ("camera.yaml", "scene.yaml"):
        subprocess.run(
            [sys.executable, "-m", "rim_camera_ros.cli", "info", str(tmp_path / "one" / name)],
            capture_output=True,
            check=True,
        )


@pytest.mark.parametrize("style", STYLES)
def test_scenes_fill_the_picture(style):
    scene = draw_scene(style, np.random.default_rng(21))
    world, _ = draw_world(scene, OFF["ideal"], np.random.default_rng(22))
    height, width = scene.shape
    u, v = np.meshgrid(np.arange(0.0, width, 4), np.arange(0.0, height, 4))
    rays = world.lens.directions(u.ravel(), v.ravel())
    seen = [trace(rays, scene.surfaces, places).surface >= 0 for places in scene.places]
    assert np.mean(seen) > 0.3
    assert min(np.mean(one) for one in seen) > 0.1


# scores


def said(verdict="missing_physics", names=(), **more):
    missing = [{"effect": name, "probability": 0.9} for name in names]
    return {
        "verdict": verdict,
        "missing": missing,
        "adjusted": [],
        "indistinguishable": [],
        "setup": [],
    } | more


def truth(tier="single", *effects, hypothesis="as_given"):
    return {"tier": tier, "effects": list(effects), "hypothesis": hypothesis}


def test_judging_a_report():
    single = truth("single", "scattering")
    assert judged(single, said(names=["scattering"])) == {"right": True, "wrong": False, "tied": False}
    assert judged(single, said(names=["scattering", "noise"]))["wrong"]
    assert not judged(single, said(names=["scattering", "noise"]))["right"]
    tie = said(names=["multipath"], indistinguishable=[["scattering", "multipath"]])
    assert judged(single, tie) == {"right": False, "wrong": False, "tied": True}
    assert not judged(single, said(names=["unknown"]))["wrong"]
    lens = truth("single", "lens_distortion")
    assert judged(lens, said("wrong_parameters", adjusted=["lens_distortion"]))["right"]
    assert judged(truth("null"), said("consistent"))["right"]
    assert judged(truth("null"), said(names=["noise"]))["wrong"]
    setup = truth("setup", "mirrored", hypothesis="mirrored")
    best = [{"hypothesis": "mirrored", "surface": "board", "gain": 5.0}]
    assert judged(setup, said("inconsistent_setup", setup=best))["right"]
    other = judged(setup, said("inconsistent_setup", setup=[{**best[0], "hypothesis": "pose"}]))
    assert (other["right"], other["said_as_such"]) == (False, True)
    wrong = truth("wrong_parameters", "cyclic_error")
    assert judged(wrong, said("wrong_parameters", adjusted=["cyclic_error", "noise"]))["right"]
    assert not judged(wrong, said("consistent"))["right"]


def test_region_and_overlap_by_hand():
    values = np.array([[5.0, 4.0], [0.6, 0.4]])
    np.testing.assert_array_equal(region(values), [[True, True], [False, False]])
    assert overlap(values, np.array([[9.0, 0.0], [0.5, 0.5]])) == pytest.approx(1 / 2)
    assert overlap(values, np.zeros((2, 2))) is None


def test_rates_are_met_when_they_are_themselves():
    assert rate([True] * 18 + [False] * 2).interval == pytest.approx((0.699, 0.972), abs=1e-3)
    line = {"tier": "null", "effects": [], "right": True, "wrong": False, "tied": False, "missing": []}
    bad = {**line, "right": False}
    table = summary([line] * 18 + [bad])
    assert "5.3% (1 of 19)" in table
    assert "<= 5% | no" in table
    assert "<= 5% | yes" in summary([line] * 19 + [bad])


def test_runner_says_what_is_wrong_with_its_options(tmp_path, capsys):
    assert main(["--out", str(tmp_path), "--tiers", "doubles"]) == 2
    assert "no such tiers" in capsys.readouterr().err
    (tmp_path / "results.jsonl").write_text('{"name": "a", "seed": 1, "imperfections": "all"}\n{"na')
    assert list(read(tmp_path / "results.jsonl")) == [("a", 1, "all")]
    assert main(["--out", str(tmp_path), "--tiers", "null", "--cases", "1"]) == 2
    assert "--resume goes on" in capsys.readouterr().err


def test_a_term_refitted_without_the_hidden_effect_takes_what_it_can():
    # what is hidden is the known term itself, larger by a fifth: all of it goes into the file
    rng = np.random.default_rng(12)
    scene = draw_scene("board", rng, stations=4)
    world, stated = draw_world(scene, OFF["some"], rng)
    expert = Expert(world, noise=stated.noise, threshold=40, power_sigma=0.015)
    known = copy.deepcopy(world.known)
    for entry in known["amplitude_offset"]["hyperbola"].values():
        entry["a"] *= 1.2
    effect = observe(replace(world, known=known)).minus(expert.sight, world.sensor.ambiguity)
    believed, absorbed_share = refitted(world, expert, effect)
    assert absorbed_share > 0.97
    for setting in np.unique(world.settings):
        found = believed.known["amplitude_offset"]["hyperbola"][int(setting)]["a"]
        assert found == pytest.approx(known["amplitude_offset"]["hyperbola"][int(setting)]["a"], rel=0.02)


def test_hidden_effects_have_their_sizes():
    rng = np.random.default_rng(13)
    scene = draw_scene("room", rng, stations=2)
    world, stated = draw_world(scene, OFF["ideal"], rng)
    world = replace(world, shape={"distance_scale": {}, "camera_constant": {}})
    expert = Expert(world, noise=stated.noise, threshold=40, power_sigma=0.015)
    after = observe(world.with_hidden(distance_scale=0.004))
    effect = after.minus(expert.sight, world.sensor.ambiguity)
    far = np.stack([light.distance for light in expert.lights])
    valid = expert.weight > 0
    np.testing.assert_allclose(effect.distance[valid], 0.004 * far[valid], atol=1e-9)
    assert expert.size(effect)[0] == pytest.approx(
        np.sqrt(np.mean((0.004 * far / expert.sigma)[valid] ** 2)), rel=1e-9
    )
    assert world.with_hidden(camera_constant=0.01).true_lens.fx == pytest.approx(1.01 * world.lens.fx)


def test_a_pattern_counts_only_where_what_is_shown_of_it_decides() -> None:
    scene = draw_scene("room", np.random.default_rng(3))
    values = np.array(
        [[0.6, 0.12, 0.12, 0.35], [0.35, 0.9, 0.12, 0.12], [0.9, 0.9, 0.9, 0.6], [0.6, 0.9, 0.6, 0.35]]
    )

    def shown(size: tuple[float, float]) -> list[str]:
        surfaces = [
            replace(one, values=values, cell=(0.45, 0.45), size=size) if one.name == "front" else one
            for one in scene.surfaces
        ]
        own = replace(scene, surfaces=surfaces)
        return [one for one in ("turned_180", "mirrored", "inverted", "depth") if decidable(own, one)]

    # two columns of one grey each: turned, mirrored and inverted they look alike
    assert shown((0.8, 0.9)) == ["depth"]
    assert shown((1.8, 1.8)) == ["turned_180", "mirrored", "inverted", "depth"]
