"""The files of a diagnosis."""

from __future__ import annotations

REPORT = "report.json"
PAGE = "report.html"
WHERE = "where.npy"
#: The improved camera.
MODEL = "camera.yaml"
