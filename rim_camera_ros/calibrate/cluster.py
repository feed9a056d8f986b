"""More recordings than one machine: recordings are reduced to stations on the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rim_camera_ros.bags import Topics
from rim_camera_ros.calibrate.reduction import reduce_recording
from rim_camera_ros.calibrate.stations import Dataset
from rim_camera_ros.camera import Camera
from rim_camera_ros.errors import InputError, RimError
from rim_camera_ros.scene import Scene

#: Times that a recording is given to another worker when one is lost.
_RETRIES = 3
_CONNECT_SECONDS = 10


def reduce_on_cluster(
    paths: Sequence[Path],
    camera: Camera,
    scenes: Sequence[Scene],
    *,
    topics: Topics | None = None,
    scheduler: str,
) -> list[Dataset]:
    """Return the stations of each recording, reduced on a cluster whose workers see the same files.

    The reduction is a pure function of recording, camera and scene: a lost worker costs time and nothing
    else.

    Raises
    `InputError` where dask.distributed is not installed or the scheduler does not answer, and what the
    reduction raises.
    """
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
    with client:
        futures = [
            client.submit(
                reduce_recording,
                Path(path).absolute(),
                camera,
                topics=topics,
                recording=number,
                scene=scene,
                retries=_RETRIES,
                pure=False,
            )
            for number, (path, scene) in enumerate(zip(paths, scenes, strict=True))
        ]
        try:
            parts = client.gather(futures)
        except RimError:
            raise
        except Exception as error:
            raise RimError(
                f"the cluster failed: {type(error).__name__}: {error}",
                remedy="workers need this package and the same paths",
            ) from None
    for part, path in zip(parts, paths, strict=True):
        part.files = [str(path)]
    return list(parts)
