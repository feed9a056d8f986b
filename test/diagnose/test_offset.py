"""An offset that all distances share: no other set-up; said where a recording cannot tell whose it is."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera_file import load_camera
from rim_camera_ros.diagnose.compare_setups import compare_setups
from rim_camera_ros.diagnose.hypotheses import best_setup
from rim_camera_ros.fit.reduction import reduce_recording
from rim_camera_ros.scene import load_scene

from .helpers import CAMERA, run, scene_text

EFFECTS = "effects: {fixed_pattern_offset: {map: offset.npy}}\n"


@pytest.mark.long
@pytest.mark.parametrize("metres", [0.03, -0.03, 0.0])
def test_an_offset_of_all_distances_is_no_other_lens(tmp_path: Path, metres: float) -> None:
    """A shorter focal length makes distances beside the axis longer, which half of an offset looks like."""
    (tmp_path / "scene.yaml").write_text(scene_text())
    for name, offset in (("true", metres), ("stated", 0.0)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "camera.yaml").write_text(CAMERA + EFFECTS)
        np.save(tmp_path / name / "offset.npy", np.full((20, 24), offset, np.float32))
    files = [tmp_path / one / "camera.yaml" for one in ("true", "stated")]
    run("simulate", tmp_path / "scene.yaml", camera=files[0], out=tmp_path / "bag", seed=2)
    scene, camera = load_scene(tmp_path / "scene.yaml"), load_camera(files[1])
    data = reduce_recording(tmp_path / "bag", camera, scene=scene)
    data.with_poses(scene, tmp_path / "bag")
    found = compare_setups(data, scene, camera)
    assert best_setup(found) is None
    lens = next(one for one in found if one.hypothesis == "other_lens")
    assert lens.gain < -20
    given = {"camera": files[1], "scene": tmp_path / "scene.yaml", "out": tmp_path / "out", "threads": 1}
    run("diagnose", tmp_path / "bag", **given)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["verdict"], report["missing"]) == ("consistent", [])
    said = [one for one in report["notes"] if "at all poses alike" in one]
    if metres:
        number, way = re.search(r"are ([\d.]+) mm (longer|shorter) than", said[0]).groups()  # type: ignore[union-attr]
        assert float(number) == pytest.approx(30.0, abs=0.5)
        assert way == ("longer" if metres > 0 else "shorter")
    else:
        assert said == []
