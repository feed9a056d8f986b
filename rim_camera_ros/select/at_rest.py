"""Stations in which something moves from frame to frame, and drivers that smooth their images."""

from __future__ import annotations

from dataclasses import replace

from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.design import BEYOND
from rim_camera_ros.fit.neighbours import NEAR, pooled
from rim_camera_ros.select.thresholds import FEW, LEAST_SIGMA, NOISE_SIGMA

#: Share of the variance of repeated frames above which its cause matters: a noise model is known no better.
_SHARE = BEYOND * NOISE_SIGMA


def at_rest(dataset: Dataset) -> Dataset:
    """Return a recording without the few stations in which a part of the scene moves, with a note.

    There the noise of pixels correlates with that of pixels far from them, also in the frames after the
    first, which may contain a remainder of the exposure before. Where many stations do so, it is no accident:
    all are kept.
    """
    moving = [station for station in dataset.stations if _moves(station)]
    placements = {(station.recording, station.placed) for station in moving}
    if not moving or len(placements) > FEW * dataset.placements:
        return dataset
    kept = [station for station in dataset.stations if not _moves(station)]
    when = ", ".join(f"{station.time:.1f} s" for station in moving)
    note = (
        f"excluded: {len(moving)} of {len(dataset.stations)} stations, at {when}, in which something moves: "
        "within them, a part of the image changes together from frame to frame, by more than noise"
    )
    frames = dataset.frames - sum(station.frames for station in moving)
    return replace(dataset, stations=kept, frames=frames, notes=[*dataset.notes, note])


def _moves(station: Station) -> bool:
    found = station.neighbours
    if found is None:
        return False
    pairs = ((found.far, found.sigma), (found.far_later, found.sigma_later))
    return all(value > max(_SHARE, LEAST_SIGMA * sigma) for value, sigma in pairs)


def note_on_smoothing(dataset: Dataset) -> str | None:
    """Return in words that a driver smooths its images: None where the noise of neighbours is independent."""
    found = pooled(station.neighbours for station in dataset.stations)
    if found is None or found.near[0] - max(found.far, 0.0) <= max(_SHARE, LEAST_SIGMA * found.sigma):
        return None
    sizes = " and ".join(f"{value:.2f} at {lag} px" for lag, value in zip(NEAR, found.near, strict=True))
    return (
        f"the noise of neighbouring pixels correlates from frame to frame (by {sizes}), as where the driver "
        "smooths its images: noise, edges and steps of the reflectivity are then not those of the camera; "
        "switch off the driver's filters to calibrate and to diagnose"
    )
