"""Simulated people through simulator, correction and tracking: who is who, and where."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="scikit-learn is an optional extra")

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.errors import InputError
from rim_camera_ros.files import find_camera, find_scene
from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.geometry import see
from rim_camera_ros.scene import load_scene
from rim_camera_ros.tracking import __main__ as program
from rim_camera_ros.tracking.figures import (
    GROUND,
    SHIPPED,
    SHIPPED_FRAMES,
    Walk,
    crossing,
    overtaking,
    shipped_text,
    walking_scene,
)
from rim_camera_ros.tracking.people import PeopleSettings, PeopleTracker
from rim_camera_ros.tracking.tracks import TrackSettings
from rim_camera_ros.tracking.trial import Trial, run


@pytest.fixture(scope="module")
def camera() -> Camera:
    return load_camera(find_camera("sr3000"))


@pytest.fixture(scope="module")
def shipped(camera: Camera) -> Trial:
    return run(SHIPPED, camera, seed=3, frames=SHIPPED_FRAMES)


# --- the figures --------------------------------------------------------------------------------


def test_the_shipped_scene_is_the_one_that_is_written() -> None:
    assert find_scene("walking_people").read_text() == shipped_text()


def test_the_shipped_scene_holds_the_walks(tmp_path: Path) -> None:
    scene = load_scene(find_scene("walking_people"))
    assert sum(one.frames for one in scene.schedule) == 25 + SHIPPED_FRAMES
    assert {one.rate for one in scene.schedule} == {10.0}
    for frame in (0, 23, 59):
        for walk in SHIPPED:
            head = scene.schedule[1 + frame].poses[f"{walk.name}_head"].position
            place = GROUND.from_optical(np.array([head]))[0]
            assert place == pytest.approx([*walk.position(frame / 10), 1.63], abs=2e-4)
    assert SHIPPED[1].position(2.6) == pytest.approx(
        np.array([4.7, -2.5]) + 0.93 * 2.0 * np.array([-2.1, 4.8]) / np.hypot(2.1, 4.8)
    )


def test_the_room_is_empty_at_first_and_one_hides_the_other_later(camera: Camera) -> None:
    scene = load_scene(find_scene("walking_people"))
    names = [one.name for one in scene.surfaces]

    def visible(poses: dict, name: str) -> int:
        surface = see(scene, poses, camera.rays).surface
        mine = [i for i, one in enumerate(names) if one.startswith(name)]
        return int(np.isin(surface, mine).sum())

    poses = scene.poses_for({})
    assert visible(poses, "anna") == visible(poses, "bert") == 0
    share = []
    for station in scene.schedule[1:]:
        poses |= {name: one.pose for name, one in station.poses.items()}
        share.append(visible(poses, "bert"))
    middle = share[23:33]
    assert min(middle) < 0.25 * max(share)
    assert max(share) > 1000


def test_walks_that_are_drawn_keep_apart_and_cross(camera: Camera) -> None:
    times = np.arange(0, 8, 0.05)
    for seed in range(5):
        a, b = (np.array([walk.position(time) for time in times]) for walk in crossing(seed))
        assert np.linalg.norm(a - b, axis=1).min() >= 0.6
        assert crossing(seed) == crossing(seed)
    assert crossing(0) != crossing(1)
    slow, fast = (np.array([walk.position(time) for time in times]) for walk in overtaking(0))
    assert slow[20, 1] < fast[20, 1]
    assert slow[110, 1] > fast[110, 1]


# --- the tracking -------------------------------------------------------------------------------


def test_identities_are_kept_through_the_crossing(shipped: Trial) -> None:
    assert shipped.identities_kept
    assert np.sqrt(np.mean(shipped.errors**2)) < 0.03
    assert shipped.errors.max() < 0.12
    # each is followed for most of the time in view, about 2.5 s
    assert all((track[:, 3] == 0).sum() > 20 for track in shipped.tracks.values())
    # nobody is seen in the empty room
    assert not shipped.detected[shipped.times < 0].any()


def test_somebody_is_hidden_in_between(shipped: Trial) -> None:
    bert = next(one for one in shipped.tracks if set(shipped.owners(one)) == {1})
    track = shipped.tracks[bert]
    between = (track[:, 0] > 2.3) & (track[:, 0] < 3.3)
    assert track[between, 3].any()
    index = np.searchsorted(shipped.times, track[between, 0] - 1e-6)
    apart = np.linalg.norm(shipped.truth[index, 1] - track[between, 1:3], axis=1)
    assert apart.max() < 0.2


def test_without_prediction_the_identities_are_lost(camera: Camera) -> None:
    settings = PeopleSettings(ground=GROUND, tracks=TrackSettings(coast=0.0))
    assert not run(SHIPPED, camera, seed=3, frames=SHIPPED_FRAMES, settings=settings).identities_kept


def test_a_wrong_inclination_is_a_wrong_place(camera: Camera, shipped: Trial) -> None:
    settings = PeopleSettings(ground=replace(GROUND, pitch=GROUND.pitch - 0.1))
    tilted = run(SHIPPED, camera, seed=3, frames=44, settings=settings)
    assert np.median(tilted.errors) > 3 * np.median(shipped.errors)


@pytest.mark.parametrize("seed", [0, 1])
def test_crossings_drawn_at_random(camera: Camera, seed: int) -> None:
    trial = run(crossing(seed), camera, seed=seed)
    assert trial.identities_kept
    assert np.sqrt(np.mean(trial.errors**2)) < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sr3000", "sr3000_every_effect"])
def test_many_crossings(name: str) -> None:
    camera = load_camera(find_camera(name))
    # a bounce between surfaces that move takes 2 s a frame
    effects = {key: one for key, one in camera.effects.items() if key != "multipath"}
    camera = replace(camera, effects=effects, covariance=None)
    trials = [run(crossing(seed), camera, seed=seed) for seed in range(2, 10)]
    assert sum(one.identities_kept for one in trials) >= 7
    errors = np.concatenate([one.errors for one in trials])
    assert np.sqrt(np.mean(errors**2)) < 0.06


@pytest.mark.slow
def test_who_overtakes_another_behind_him(camera: Camera) -> None:
    trials = [run(overtaking(seed), camera, seed=seed) for seed in range(6)]
    assert sum(one.identities_kept for one in trials) >= 5


def test_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    picture = tmp_path / "tracks.png"
    monkeypatch.setattr("sys.argv", ["tracking", "--picture", str(picture)])
    assert program.main() == 0
    assert "identities kept in 1 of 1; position" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr("sys.argv", ["tracking", "--camera", "sr30000"])
    assert program.main() == 2
    assert "did you mean 'sr3000'?" in capsys.readouterr().err


# --- the chain as an object ---------------------------------------------------------------------


def cloud(camera: Camera, walk: Walk, time: float) -> np.ndarray:
    """Return the noise-free cloud (H, W, 3) of a walk in the room."""
    scene = walking_scene([walk], frames=1)
    poses = scene.poses_for({}) | {
        name: pose.pose
        for name, pose in walking_scene([replace(walk, wait=-time)], frames=1).schedule[1].poses.items()
    }
    return see(scene, poses, camera.rays).points


def test_stamps_that_jump_back_end_the_tracks_and_keep_the_background(camera: Camera) -> None:
    walk = Walk(name="anna", start=(3.2, 2.2), end=(3.2, -2.2), speed=1.0)
    people = PeopleTracker(PeopleSettings(ground=GROUND))
    sigma = np.full(camera.shape, 0.01)
    empty = cloud(camera, walk, 0.0)
    for i in range(20):
        assert people.missing_frames == 20 - i
        assert people.take(empty, sigma, stamp=i * NANOSECONDS // 10) == []
    assert people.missing_frames == 0
    for start, identity in ((2, 1), (0, 2)):
        for i in range(6):
            stamp = start * NANOSECONDS + i * NANOSECONDS // 10
            found = people.take(cloud(camera, walk, 1.5 + i / 10), sigma, stamp=stamp)
        assert [one.identity for one in found] == [identity]
        assert found[0].position == pytest.approx(walk.position(2.0), abs=0.06)
    people.use(PeopleSettings(ground=GROUND, tracks=TrackSettings(coast=1.0)))
    assert len(people.people) == 1
    people.use(PeopleSettings(ground=replace(GROUND, height=2.3)))
    assert people.people == []
    assert people.missing_frames == 0
    people.learn_anew()
    assert people.missing_frames == 20
    assert people.background is None
    assert people.people == []


def test_another_size_is_refused(camera: Camera) -> None:
    people = PeopleTracker(PeopleSettings(ground=GROUND))
    people.take(np.ones((12, 16, 3)), np.ones((12, 16)), stamp=0)
    with pytest.raises(InputError, match=r"10 x 8 px and 10 x 8 px, the background has 16 x 12 px"):
        people.take(np.ones((8, 10, 3)), np.ones((8, 10)), stamp=NANOSECONDS)
