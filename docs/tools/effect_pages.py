#!/usr/bin/env python3
"""Write docs/effects/*.md from the effects' own classes; ``--check`` says whether they are up to date."""

from __future__ import annotations

import dataclasses
import inspect
import sys
import typing
from pathlib import Path

from pages import DOCS, run

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.effects import ORDER, PARTICULAR, SECTIONS
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.files import find_camera

FOLDER = DOCS / "effects"
UNDO = {
    "exact": "exactly, from one frame",
    "planes": "on planes, from one frame: the normals come from the frame itself",
    "partial": "as far as one frame tells",
    "none": "not from one frame: pixels are flagged where they can be detected, the rest stays",
}

ADDING = """## Adding one

One file, one line in `ORDER`, and this command; another package: a subclass of
`rim_camera_ros.effects.Effect` and the entry-point group `rim_camera_ros.effects`. Nothing else names it (a
test says so): simulation, correction, calibration, diagnosis and reports ask for what the class declares.

| what | by |
|---|---|
| parameters with unit, bounds, common size | the dataclass, `quantity`; `priors` |
| what it does, and undoing it | `simulate`, `correct`; `term` or `apply` of its base class |
| derivatives by its parameters | `columns`, `phasor_columns` |
| how a search begins with it | `candidates`: variants linear about a start, several where that is blind |
| what its form may do otherwise | `discrepancy`, `has_discrepancy` |
| where it acts | traits in `effects/physics.py`, `effects/base.py`: `shows_in`, `in_time`, `at_edges`, ... |
| what a fit may do to it | `reach`, `longest_step`, `greatest`, `shapes`, `estimated` |
| fewer pixels | `in_pixels`, `per_pixel`, `resampled` |
| sentence, curve, experiment | `sentence`; `graph`, `drawn_over`; `observable`, `refuted_by`, `lacking` |
"""


def rows(kind: type, prefix: str = "") -> list[str]:
    """Return the table rows of a parameter dataclass and of those inside it."""
    result = []
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        inner = next((one for one in _classes(hints[field.name])), None)
        unit, doc = field.metadata.get("unit", ""), field.metadata.get("doc", "")
        default = "" if field.default is dataclasses.MISSING else f" (default {field.default})"
        if inner is not None and dataclasses.fields(inner)[0].metadata:
            result.append(f"| `{prefix}{field.name}` | | {doc}{default} |")
            result += rows(inner, f"{prefix}{field.name}[].")
        else:
            result.append(f"| `{prefix}{field.name}` | {unit} | {doc}{default} |")
    return result


def _classes(hint: object) -> list[type]:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return [hint]
    return [one for argument in typing.get_args(hint) for one in _classes(argument)]


def page(effect: type[Effect]) -> str:
    """Return the page of one effect."""
    example = effect.example(load_camera(find_camera("gated" if effect in PARTICULAR else "sr3000")))
    formula, *text = inspect.cleandoc(inspect.getdoc(effect) or "").split("\n\n")
    source = (inspect.getmodule(effect).__doc__ or "").strip().splitlines()[0]
    formula = " ".join(formula.split())
    return "\n".join(
        [
            f"# {effect.name}",
            "",
            source,
            "",
            f"    {formula}",
            *(line for one in text for line in ("", " ".join(one.split()))),
            "",
            "| parameter | unit | |",
            "|---|---|---|",
            *rows(effect),
            "",
            f"- **Undone** {UNDO[effect.undo]}.",
            f"- **A recording shows it** if it contains {effect.observable}.",
            f"- **Refuted by** {effect.refuted_by}.",
            f"- **In words**, for an example: {example.sentence()}.",
            "",
        ]
    )


def pages() -> dict[Path, str]:
    """Return the content of every page by its path."""
    result = {FOLDER / f"{one.name}.md": page(one) for one in (*ORDER, *PARTICULAR)}
    sections = sorted({one.section for one in SECTIONS.values()})
    lines = [
        "# Effects, in the order along the light",
        "",
        "Scene and optics effects act on the complex image A exp(i 2 pi d / L) and deliver one distance and",
        "one amplitude per pixel; every other term is evaluated at those, and the terms add up.",
        "",
        "| effect | what it is | undone |",
        "|---|---|---|",
        *(f"| [{one.name}]({one.name}.md) | {one.title} | {one.undo} |" for one in (*ORDER, *PARTICULAR)),
        "",
        "The last is of [gated cameras](../gated.md) alone.",
        "",
        "These pages are written by `docs/tools/effect_pages.py` from the classes in `effects/`.",
        "The names " + ", ".join(f"`{one}`" for one in SECTIONS) + " belong to the vocabulary as well;",
        f"their parameters are sections of the camera file ({', '.join(sections)}).",
        "",
        *ADDING.splitlines(),
        "",
    ]
    result[FOLDER / "README.md"] = "\n".join(lines)
    return result


if __name__ == "__main__":
    sys.exit(run(__doc__ or "", pages))
