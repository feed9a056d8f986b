"""The process that evaluates the coverage, so that the recording process does not lose messages.

Started by `rim_camera_ros.coverage.live` as ``python -m``; not meant to be run by hand. Both sides send
pickles: this process receives the files of scene and camera, then each `Message`, and sends `Report`. It ends
at the end of its input, after a last report, and at an error, which the last report states.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from typing import IO

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.coverage.evaluate import Evaluator
from rim_camera_ros.coverage.frames import Message, live_frames, posed_frames
from rim_camera_ros.coverage.picture import Report, coverage_picture
from rim_camera_ros.diagnose.variance import movement_of
from rim_camera_ros.errors import RimError
from rim_camera_ros.fit.reduction import of_known_exposure, reduce_frames
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.scene import Scene, load_scene

#: Seconds after which frames of one pose are evaluated even if the pose continues.
_BLOCK_SECONDS = 3.0
#: Seconds without any station after which the reason is reported.
_PATIENCE = 8.0
_NICENESS = 5


class _Stations:
    """Reduces frames to stations in a separate thread, while the main thread evaluates."""

    def __init__(self, source: IO[bytes], scene: Scene, camera: Camera) -> None:
        self.evaluator = Evaluator(scene, camera)
        self.news = threading.Event()
        self.ended = False
        self.failure: Exception | None = None
        self.moved: float | None = None
        self.count = self.frames = self.posed = 0
        self._source, self._scene, self._camera = source, scene, camera
        threading.Thread(target=self._run, name="stations", daemon=True).start()

    def _run(self) -> None:
        try:
            known = of_known_exposure(self._posed())
            for station in reduce_frames(known, self._camera, block_seconds=_BLOCK_SECONDS):
                if self.evaluator.add(station):
                    self.moved, self.count = movement_of(station), self.count + 1
                    self.news.set()
        except Exception as error:
            self.failure = error
        finally:
            self.ended = True
            self.news.set()

    def _counted(self) -> Iterator[RawFrame]:
        for frame in live_frames(self._messages()):
            self.frames += 1
            yield frame

    def _posed(self) -> Iterator[RawFrame]:
        for frame in posed_frames(self._counted(), self._scene, self._camera):
            self.posed += 1
            yield frame

    def _messages(self) -> Iterator[Message]:
        while True:
            try:
                yield pickle.load(self._source)
            except (EOFError, pickle.UnpicklingError):
                return


def serve(source: IO[bytes], sink: IO[bytes]) -> None:
    """Evaluate the messages of ``source`` until it ends, and report to ``sink``, also errors."""

    def send(report: Report) -> None:
        pickle.dump(report, sink)
        sink.flush()

    try:
        _evaluate(source, send)
    except BrokenPipeError:
        raise  # the recording process is gone
    except RimError as error:
        send(Report(None, problem=str(error), ended=True))
    except Exception as error:
        traceback.print_exc()
        words = f"unexpected {type(error).__name__}: {error} (please report this)"
        send(Report(None, problem=words, ended=True))


def _evaluate(source: IO[bytes], send: Callable[[Report], None]) -> None:
    files = pickle.load(source)
    scene, camera = load_scene(files[0]), load_camera(files[1])
    stations = _Stations(source, scene, camera)
    evaluated, warned = 0, False
    while True:
        if not stations.news.wait(None if evaluated or warned else _PATIENCE):
            warned = stations.frames > 0 and stations.posed == 0
            if warned:
                send(Report(None, problem=_without_poses(scene)))
            continue
        stations.news.clear()
        ended, count = stations.ended, stations.count
        if count > evaluated:
            evaluated = count
            coverage = stations.evaluator.evaluate(moved=stations.moved)
            picture = coverage_picture(coverage, ambiguity=camera.sensor.ambiguity)
            send(Report(coverage, picture))
        if ended:
            if stations.failure is not None:
                raise stations.failure
            return


def _without_poses(scene: Scene) -> str:
    names = " and ".join(f"'{one}'" for one in scene.needs_truth)
    return (
        f"no frame has the pose of {names} so far: neither is it published nor found in the images "
        "(the whole board must be in view, its squares 5 px and more)"
    )


def main() -> int:
    """Evaluate the messages on standard input; output of libraries goes to standard error."""
    os.nice(_NICENESS)
    source, sink = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(source, sink)
    except BrokenPipeError:
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
