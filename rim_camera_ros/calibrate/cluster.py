"""More work than one machine does: recordings are reduced and candidates fitted on workers of a Dask cluster.

Both are pure functions: a lost worker costs time and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import Topics
from rim_camera_ros.calibrate.reduction import reduce_recording
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.calibrate.trials import Workers
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.scene import Scene

#: Times that a work is given to another worker when one is lost.
_RETRIES = 3
_CONNECT_SECONDS = 10


@contextmanager
def on_workers(scheduler: str | None) -> Iterator[Workers]:
    """Give what calls a function for each of some things on a cluster, in the order of the things.

    Without a ``scheduler`` they are called here, one after the other. Raises `InputError` where
    dask.distributed is not installed or the scheduler does not answer; calls raise what the function raises,
    and `RimError` where the cluster fails.
    """
    if scheduler is None:
        yield map
        return
    try:
        import distributed
    except ImportError:
        raise InputError(
            "--scheduler needs dask.distributed", remedy="pip install 'rim_camera_ros[cluster]'"
        ) from None
    try:
        cluster: Any = distributed
        client = cluster.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no scheduler answers: {type(error).__name__}",
            place=f"--scheduler {scheduler}",
            remedy="start one with dask-scheduler and give its address, tcp://HOST:8786",
        ) from None

    def call(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        futures = [client.submit(function, one, retries=_RETRIES, pure=False) for one in items]
        for future in futures:
            try:
                yield future.result()
            except RimError:
                raise
            except Exception as error:
                raise RimError(
                    f"the cluster failed: {type(error).__name__}: {error}",
                    remedy="workers need this package and the same paths",
                ) from None

    with client:
        yield call


def reduce_on_cluster(
    paths: Sequence[Path],
    camera: Camera,
    scenes: Sequence[Scene],
    *,
    topics: Topics | None = None,
    scheduler: str,
) -> list[Dataset]:
    """Return the stations of each recording, reduced on a cluster whose workers see the same files.

    Raises what `on_workers` and the reduction raise.
    """
    works = [
        partial(reduce_recording, path.absolute(), camera, topics=topics, recording=number, scene=scene)
        for number, (path, scene) in enumerate(zip(paths, scenes, strict=True))
    ]
    with on_workers(scheduler) as workers:
        parts = list(workers(_done, works))
    for part, path in zip(parts, paths, strict=True):
        part.files = [str(path)]
    return parts


def _done(work: Callable[[], Dataset]) -> Dataset:
    return work()
