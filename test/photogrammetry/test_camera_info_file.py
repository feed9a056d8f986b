"""camera_info YAML in and out."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from rim_camera_ros.errors import InputError
from rim_camera_ros.optics import Optics
from rim_camera_ros.photogrammetry.camera_info_file import read_camera_info, write_camera_info

#: As camera_calibration of image_pipeline writes it.
WRITTEN = """image_width: 176
image_height: 144
camera_name: sr3000
camera_matrix:
  rows: 3
  cols: 3
  data: [199.5, 0.     , 89.25,
           0.     , 201.5, 71.75,
           0.     ,   0.     ,   1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.05, 0.001, -0.002, 0.25]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [190., 0., 89., 0., 0., 195., 71., 0., 0., 0., 1., 0.]
"""
OPTICS = Optics(199.5, 201.5, 89.25, 71.75, (-0.1, 0.05, 0.001, -0.002, 0.25))


def test_reads_what_camera_calibration_writes(tmp_path: Path) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(WRITTEN)
    assert read_camera_info(path) == (OPTICS, (144, 176))


def test_written_and_read_again(tmp_path: Path) -> None:
    write_camera_info(tmp_path / "info.yaml", OPTICS, shape=(144, 176), name="sr3000")
    assert read_camera_info(tmp_path / "info.yaml") == (OPTICS, (144, 176))
    ours, theirs = (yaml.safe_load(text) for text in ((tmp_path / "info.yaml").read_text(), WRITTEN))
    assert ours.keys() == theirs.keys()
    assert ours["camera_matrix"] == theirs["camera_matrix"]
    assert ours["distortion_coefficients"] == theirs["distortion_coefficients"]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("plumb_bob", "fisheye", "distortion_model.*the distortion model is 'fisheye'"),
        ("0.25]", "0.25, 0.1, 0.2, 0.3]", "8 coefficients .plumb_bob has up to five"),
        ("[199.5", "[-199.5", "a focal length is not positive"),
        ("[199.5", "[0.0, 199.5", "camera_matrix has no data of 9 numbers"),
        ("image_width: 176", "image_width: wide", "image_width is 'wide'"),
        ("[-0.1", "[.nan", "distortion_coefficients has no data"),
    ],
)
def test_what_is_no_camera_info(tmp_path: Path, old: str, new: str, match: str) -> None:
    path = tmp_path / "info.yaml"
    path.write_text(WRITTEN.replace(old, new, 1))
    with pytest.raises(InputError, match=match):
        read_camera_info(path)
