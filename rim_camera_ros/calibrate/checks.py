"""Whether recordings of a scene can calibrate a camera: errors in one line, with a remedy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.bags import Recording, Topics
from rim_camera_ros.calibrate.held_out import wrapped
from rim_camera_ros.calibrate.recordings import takes_schedule
from rim_camera_ros.camera import Camera
from rim_camera_ros.effects import without_poses
from rim_camera_ros.errors import InputError
from rim_camera_ros.fit.data import Dataset, MissingPoses
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.reduction import check_frame, of_known_exposure
from rim_camera_ros.frame import Intrinsics, RawFrame
from rim_camera_ros.geometry import see
from rim_camera_ros.rotations import rotation_matrix
from rim_camera_ros.scene import Scene, ScenePose

Array = NDArray[Any]

#: A pose that deviates by more than this [m] from the others is no pose of this scene; if all of them deviate
#: by more than `WHOLE_SCENE` [m], it is another scene.
FAR_POSE = 0.3
WHOLE_SCENE = 0.8
#: Share of the poses that may be excluded before the scene is refused.
MOST_EXCLUDED = 0.2
#: Spread of the distances that a pixel sees over the poses [m], below which they are all the same.
LEAST_DEPTH = 0.05
#: Changes of a surface's recorded pose up to which it counts as fixed: [m], and of its normal [rad].
_STILL_METRES, _STILL_RADIANS = 0.02, 0.02
#: Least pixels of a surface whose distance in a pose counts, and most poses that an error names.
LEAST_PIXELS = 20
_NAMED = 4
#: Least poses of one setting for a line of their distances over the amplitude.
_LEAST_POSES = 8


@dataclass(frozen=True)
class RecordingFacts:
    """Metadata of a recording, before its images are read."""

    path: Path
    frames: int
    device: str
    intrinsics: Intrinsics | None
    surfaces: tuple[str, ...]
    integration_time: float | None


def examine(path: str | PathLike[str], camera: Camera, topics: Topics | None) -> RecordingFacts:
    """Read the first frame of a recording.

    Raises `InputError` naming the recording where it has no frame or another camera made it.
    """
    with Recording(path, topics=topics) as bag:
        first: RawFrame | None = next(of_known_exposure(bag.frames()), None)
        if first is None:
            why = ", ".join(f"{n} {reason}" for reason, n in bag.skipped.items() if n)
            raise InputError(
                "it holds no complete frame" + (f": {why}" if why else ""),
                file=path,
                remedy="was the recording ended properly? rim info shows what is in it",
            )
        try:
            check_frame(first, camera)
        except InputError as error:
            raise error.located(path) from None
        return RecordingFacts(
            Path(path),
            bag.frame_count,
            first.device,
            first.intrinsics,
            bag.truth_surfaces,
            camera.stated_integration_time(first.settings),
        )


def agree(recordings: Sequence[RecordingFacts]) -> list[str]:
    """Return notes on recordings of one camera. Raises `InputError` for recordings of several cameras."""
    notes: list[str] = []
    known = [recording for recording in recordings if recording.device]
    for other in known[1:]:
        if other.device != known[0].device:
            raise InputError(
                f"it was made by '{other.device}', but {known[0].path} by '{known[0].device}'",
                file=other.path,
                remedy="calibrate each camera by itself",
            )
    with_geometry = [recording for recording in recordings if recording.intrinsics is not None]
    for one in with_geometry[1:]:
        if one.intrinsics != with_geometry[0].intrinsics:
            notes.append(
                f"{one.path}: its camera_info differs from that of {with_geometry[0].path}; the optics of "
                "the camera file hold for all"
            )
    for recording in recordings:
        if recording.integration_time is None:
            raise InputError(
                "it states no integration_time (no frame_info)",
                file=recording.path,
                remedy="give sensor.integration_time in the camera file",
            )
    return notes


def scenes_of(recordings: Sequence[RecordingFacts], given: Scene | Sequence[Scene] | None) -> list[Scene]:
    """Return the scene of each recording: the common one, or one each in order. Raises as `require_scene`."""
    if given is None or isinstance(given, Scene):
        return [require_scene(recordings, given)] * len(recordings)
    if len(given) == 1:
        return [require_scene(recordings, given[0])] * len(recordings)
    if len(given) != len(recordings):
        raise InputError(
            f"{len(given)} scenes for {len(recordings)} recordings",
            place="--scene",
            remedy="give one scene for all recordings, or one for each in their order",
        )
    return [require_scene([recording], scene) for recording, scene in zip(recordings, given, strict=True)]


def require_scene(recordings: Sequence[RecordingFacts], scene: Scene | None) -> Scene:
    """Return the scene. Raises `InputError` where there is none, or a recording lacks a pose it needs."""
    if scene is None:
        found = sorted({name for recording in recordings for name in recording.surfaces})
        surfaces = f"poses of {', '.join(found)}" if found else "no poses of surfaces"
        raise InputError(
            f"without a scene nothing says what the camera saw (the recordings hold {surfaces})",
            place="--scene",
            remedy="give a scene file with these surfaces and pose: truth"
            if found
            else "give a scene file with the poses of its surfaces, free: [...] where they are not known",
        )
    if takes_schedule(
        scene, {name for recording in recordings for name in recording.surfaces}, len(recordings)
    ):
        return scene
    for recording in recordings:
        for name in scene.needs_truth:
            if name not in recording.surfaces:
                held = ", ".join(recording.surfaces) or "none"
                raise MissingPoses(
                    f"the scene takes the pose of '{name}' from the recording, which holds poses of: {held}",
                    file=recording.path,
                    place=f"/ground_truth/{name}/pose",
                    remedy="record the poses, give the pose in the scene file, or give one recording for "
                    "each station of its schedule",
                )
    return scene


def require_fixed_poses(dataset: Dataset, scene: Scene, path: str | PathLike[str] | None = None) -> None:
    """Raise `InputError` where the recording holds different poses of a surface that is fixed in the scene.

    ``path`` is that of the recording, for the error.
    """
    if scene.camera_motion.moves:
        return
    for surface in scene.surfaces:
        stated = [
            station.truth[surface.name] for station in dataset.stations if surface.name in station.truth
        ]
        if not isinstance(surface.pose, ScenePose) or len(stated) < 2:
            continue
        positions = np.array([pose.position for pose in stated])
        axes = np.array([rotation_matrix(pose.orientation)[:, 2] for pose in stated])
        moved, turned = (
            float(np.linalg.norm(position - position[0], axis=1).max()) for position in (positions, axes)
        )
        if moved > _STILL_METRES or turned > _STILL_RADIANS:
            raise InputError(
                f"the scene states one pose of '{surface.name}', the recording holds poses that differ by up "
                f"to {moved:.2g} m and {np.degrees(turned):.2g} degrees",
                file=path,
                place=f"/ground_truth/{surface.name}/pose",
                remedy="write pose: truth for it in the scene file, which takes the poses of the recording",
            )


def with_plausible_poses(dataset: Dataset, scene: Scene, camera: Camera, tick: Callable[[], None]) -> Dataset:
    """Return the stations whose distances agree with the scene within a few decimetres; note the others.

    Poses are compared with the median of all of their setting, with a line over the inverse of the amplitude,
    and with the prediction by the camera file. So an unknown offset of the camera does not count, nor one
    that grows as the light falls, nor stray light that the file contains.
    ``tick`` is called for each station. Raises `InputError` for a scene that describes another
    recording, naming the poses that deviate, and how far.
    """
    found = list(_medians(dataset, scene, camera, tick))
    if not found:
        raise InputError(
            "no pixel can be used: no surface of the scene is where the recording has measurements",
            remedy="check that the scene file describes the recording (rim info BAG lists its surfaces)",
        )
    number, setting, value = (np.array([one[i] for one in found]) for i in range(3))
    centre = float(np.median(value))
    if abs(centre) > WHOLE_SCENE:
        raise InputError(
            f"the recorded distances differ from the scene's by {centre:+.2f} m in the median pose",
            remedy="check the scene's poses: surface frames in the camera optical frame, metres",
        )
    level = {t: float(np.median(value[setting == t])) for t in np.unique(setting)}
    off = value - np.array([level[t] for t in setting])
    # few poses of one setting: their own median may be the wrong one
    off = np.where(np.abs(off) > np.abs(value - centre), value - centre, off)
    far = np.abs(off) > FAR_POSE
    if far.any():
        off = _deviations_given_amplitudes(setting, value, np.array([one[3] for one in found]), off)
        far = np.abs(off) > FAR_POSE
    if far.any():
        predicted = _deviations_given_camera(dataset, scene, camera, tick)
        rest = np.array([predicted.get((one[0], one[4]), 0.0) for one in found])
        off = np.where(np.abs(rest) < np.abs(off), rest, off)
        far = np.abs(off) > FAR_POSE
    if not far.any():
        return dataset
    named = []
    for i in np.flatnonzero(far)[np.argsort(-np.abs(off[far]))][:_NAMED]:
        one = dataset.stations[int(number[i])]
        surface = found[int(i)][4]
        named.append(f"'{surface}' in pose {one.pose} at {one.time:.1f} s by {off[i]:+.2f} m")
    left = {dataset.stations[int(i)].recording: i for i in number[far]}
    bad = {(dataset.stations[int(i)].recording, dataset.stations[int(i)].pose) for i in number[far]}
    more = f" and {int(far.sum()) - _NAMED} more" if far.sum() > _NAMED else ""
    which = "; ".join(named) + more
    file = dataset.files[next(iter(left))] if dataset.files else None
    if len(bad) > max(1, MOST_EXCLUDED * dataset.poses) or len(bad) == dataset.poses:
        raise InputError(
            f"{len(bad)} of {dataset.poses} poses are off from what was recorded: {which}",
            file=file,
            remedy="check these poses in the scene file or the reference instrument's messages",
        )
    kept = [station for station in dataset.stations if (station.recording, station.pose) not in bad]
    note = (
        f"{file}: excluded {len(bad)} of {dataset.poses} poses that are off from what was recorded: {which}"
    )
    return replace(
        dataset, stations=kept, notes=[*dataset.notes, note], frames=sum(one.frames for one in kept)
    )


def _deviations_given_amplitudes(setting: Array, value: Array, amplitude: Array, off: Array) -> Array:
    """Return the deviations of poses, or those from a line over the inverse of the amplitude where smaller.

    The line of each setting is Siegel's, for which up to half of the poses may be outliers. Deviations of
    settings with few poses are returned unchanged.
    """
    from scipy.stats import siegelslopes

    result = off.copy()
    for t in np.unique(setting):
        mine = np.flatnonzero(setting == t)
        if len(mine) < _LEAST_POSES or np.ptp(amplitude[mine]) == 0:
            continue
        line = siegelslopes(value[mine], 1.0 / amplitude[mine])
        rest = value[mine] - line.intercept - line.slope / amplitude[mine]
        result[mine] = np.where(np.abs(rest) < np.abs(off[mine]), rest, off[mine])
    return result


def _deviations_given_camera(
    dataset: Dataset, scene: Scene, camera: Camera, tick: Callable[[], None]
) -> dict[tuple[int, str], float]:
    """Return the median residual [m] of each station and surface by the camera file, less that of all.

    Surfaces that are too dark to be judged are not included.
    """
    forward = Forward(dataset, scene, camera)
    forward.estimate_amplitudes()
    result = {}
    for number, prediction in enumerate(forward.predictions(slopes=False)):
        tick()
        for i, surface in enumerate(scene.surfaces):
            mine = prediction.used & (prediction.view.geometry.surface == i)
            if mine.sum() >= LEAST_PIXELS:
                result[number, surface.name] = float(np.median(prediction.residual[mine]))
    centre = float(np.median(list(result.values()))) if result else 0.0
    return {key: value - centre for key, value in result.items()}


def _medians(
    dataset: Dataset, scene: Scene, camera: Camera, tick: Callable[[], None]
) -> Iterator[tuple[int, float, float, float, str]]:
    """Yield for each station and surface: its number, setting, median residual [m], amplitude, surface."""
    for number, station in enumerate(dataset.stations):
        tick()
        setting = camera.integration_time(station.settings)
        geometry = see(scene, scene.poses_for(station.truth), camera.rays)
        difference = wrapped(station.distance - geometry.distance, camera)
        valid = geometry.hit & (station.count > 0) & np.isfinite(difference)
        for i, surface in enumerate(scene.surfaces):
            mine = valid & (geometry.surface == i)
            if mine.sum() >= LEAST_PIXELS:
                amplitude = max(float(np.median(station.amplitude[mine])), 1.0)
                yield number, setting, float(np.median(difference[mine])), amplitude, surface.name


def require_variety(dataset: Dataset, scene: Scene, camera: Camera, effects: Sequence[str] | None) -> None:
    """Raise `InputError` for one pose only, or for all poses at one distance.

    No error is raised where all requested effects change with time or setting.
    """
    if effects and set(effects) <= set(without_poses()):
        return
    only = ", ".join(without_poses())
    file = dataset.files[0] if len(dataset.files) == 1 else None
    if dataset.poses < 2:
        raise InputError(
            "only one pose: nothing that depends on distance, amplitude or angle can be distinguished from "
            "the offset of each pixel",
            file=file,
            remedy=f"record the surface at 20 poses or more; one pose does for --effects {only}",
        )
    shape = camera.shape
    near, far = np.full(shape, np.inf), np.full(shape, -np.inf)
    for station in dataset.stations:
        geometry = see(scene, scene.poses_for(station.truth), camera.rays)
        used = geometry.hit & (station.count > 0)
        near[used] = np.minimum(near[used], geometry.distance[used])
        far[used] = np.maximum(far[used], geometry.distance[used])
    seen = np.isfinite(near) & (far > -np.inf)
    if not seen.any():
        return
    depth = float(np.median((far - near)[seen]))
    if depth < LEAST_DEPTH:
        raise InputError(
            f"all at one distance: over the {dataset.poses} poses a pixel sees distances that differ by only "
            f"{depth * 1e3:.0f} mm (median)",
            file=file,
            remedy="record the surface at distances over the whole range of use; with one distance only "
            f"--effects {only} can be fitted",
        )
