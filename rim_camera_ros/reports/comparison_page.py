"""Two camera files compared as one HTML page. Importing this needs matplotlib."""

from __future__ import annotations

import numpy as np

from rim_camera_ros.reports.comparison import (
    DISTANCE_HEADINGS,
    EFFECT_HEADINGS,
    NUMBER_HEADINGS,
    Comparison,
    distance_rows,
    effect_rows,
    first_sentence,
    number_rows,
)
from rim_camera_ros.reports.figures import Map, maps
from rim_camera_ros.reports.page import Card, Figure, Part, Table, Text, render
from rim_camera_ros.reports.words import joined


def comparison_page(found: Comparison, *, names: tuple[str, str]) -> str:
    """Return the comparison as one HTML page that needs no other file. Needs matplotlib."""
    cards = [
        Card(f"{found.rms * 1e3:.2f} mm", "RMS difference of corrected distances"),
        Card(f"{found.most * 1e3:.2f} mm", "99 % of them differ by less"),
        Card(f"{len(found.effects)}", "effects are stated otherwise"),
        Card(f"{len(found.numbers)}", "numbers differ"),
    ]
    rows = number_rows(found)
    return render(
        "comparison",
        title="Two camera files",
        under=f"First: {names[0]}; second: {names[1]}",
        first=first_sentence(found),
        mood="" if found.numbers or found.effects else "good",
        cards=cards if np.isfinite(found.rms) else [],
        pictures=_pictures(found),
        rays=_ray_picture(found),
        effects=[Table(EFFECT_HEADINGS, effect_rows(found, ("the first", "the second")), numbers=(2,))]
        if found.effects
        else [],
        numbers=[Table(NUMBER_HEADINGS, rows, numbers=(1, 2, 3, 4))] if rows else [],
    )


def _pictures(found: Comparison) -> list[Part]:
    shown = range(0, len(found.walls), 2)
    images = [found.maps[i] * 1e3 for i in shown]
    known = np.concatenate([np.abs(image[np.isfinite(image)]) for image in images])
    if not known.size:
        return [Text("No pixel is valid by both files.")]
    top = max(float(np.quantile(known, 0.98)), 1e-3)
    titles = [f"wall at {found.walls[i].distance:.2f} m" for i in shown]
    picture = maps([Map(title, image, top) for title, image in zip(titles, images, strict=True)], "mm")
    setting = found.walls[0].integration_time
    caption = (
        "Corrected distance by the second file minus that by the first, of what a camera as in the first "
        f"measures without noise: a grey wall (reflectivity {found.walls[0].reflectivity:g}) across the axis"
        + (f", integration time {setting:g}" if setting is not None else "")
        + ", warm camera. White: not valid by one of them."
    )
    alt = f"Maps of the difference of corrected distances, {joined(titles)}; RMS {found.rms * 1e3:.2f} mm"
    rows = distance_rows(found)
    return [Figure(picture, alt, caption), Table(DISTANCE_HEADINGS, rows, numbers=range(1, 6))]


def _ray_picture(found: Comparison) -> list[Part]:
    if not np.abs(found.rays).max() > 1e-6:
        return []
    images = [Map("along the row", found.rays[..., 0]), Map("along the column", found.rays[..., 1])]
    picture = maps(images, "px")
    caption = "Where the second file's rays meet the image plane of the first, less the pixel."
    return [Figure(picture, "Maps of the difference of the rays, along the row and the column", caption)]
