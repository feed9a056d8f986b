"""People in corrected frames, by background, clusters and tracks one after the other."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.frame import NANOSECONDS
from rim_camera_ros.tracking.background import Background, BackgroundSettings
from rim_camera_ros.tracking.ground import Ground
from rim_camera_ros.tracking.moving import ClusterSettings, Detection, clusters, moving_points, solid_angle
from rim_camera_ros.tracking.tracks import Track, Tracker, TrackSettings

#: After a gap of this many seconds people are no longer where they were expected.
_GAP = 5.0


@dataclass(frozen=True, kw_only=True)
class PeopleSettings:
    """The mount of the camera, and the settings of the three steps."""

    ground: Ground
    background: BackgroundSettings = field(default_factory=BackgroundSettings)
    clusters: ClusterSettings = field(default_factory=ClusterSettings)
    tracks: TrackSettings = field(default_factory=TrackSettings)


class PeopleTracker:
    """Follows people in the organised clouds of a resting camera.

    ``moving`` [-]: share of the pixels that moved in the last frame; ``detections`` of the last frame.
    """

    def __init__(self, settings: PeopleSettings) -> None:
        self.settings = settings
        self.moving = 0.0
        self.detections: list[Detection] = []
        self._background = Background(settings.background)
        self._tracker = Tracker(settings.tracks)
        self._pixel = 0.0
        self._last: int | None = None

    @property
    def missing_frames(self) -> int:
        """Number of frames that the background still needs."""
        return self._background.missing_frames

    @property
    def people(self) -> list[Track]:
        """The people after the last frame."""
        return self._tracker.people

    @property
    def background(self) -> NDArray[np.float64] | None:
        """The background's radial distance (H, W) in m; None before it is learnt."""
        return self._background.distance

    def learn_anew(self) -> None:
        """Forget background and people."""
        self._background = Background(self.settings.background)
        self._tracker.forget()
        self.detections = []
        self.moving = 0.0

    def use(self, settings: PeopleSettings) -> None:
        """Use other settings; a learnt background is kept, tracks on another floor are not."""
        if settings.ground != self.settings.ground:
            self._tracker.forget()
        self.settings = settings
        self._background.settings = settings.background
        self._tracker.settings = settings.tracks

    def take(self, points: NDArray[Any], sigma: NDArray[Any], *, stamp: int) -> list[Track]:
        """Return the people after a frame; none while the background is learnt.

        ``points`` (H, W, >=3) in m in the optical frame and ``sigma`` (H, W) in m, NaN where invalid;
        ``stamp`` in ns. Where stamps jump back or ahead, all tracks end. Raises `InputError` where the size
        of the frame is not the background's, `RimError` for a cloud that is not organised.
        """
        if self._last is not None and not 0 < stamp - self._last < _GAP * NANOSECONDS:
            self._tracker.forget()
        self._last = stamp
        time = stamp / NANOSECONDS
        distance = np.linalg.norm(points[..., :3], axis=-1)
        moving = self._background.take(distance, sigma, time=time)
        if moving is None:
            return []
        if not self._pixel:
            self._pixel = solid_angle(points)
        self.moving = float(np.mean(moving))
        chosen = moving_points(points, moving, sigma, self.settings.clusters)
        self.detections = clusters(chosen, self.settings.ground, self.settings.clusters, pixel=self._pixel)
        return self._tracker.take(self.detections, time=time)
