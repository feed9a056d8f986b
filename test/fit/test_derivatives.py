"""Derivatives of predicted readings through the whole chain are their difference quotients, for every effect.

Every other term sees the light that is partly predicted and partly measured: each change of the light,
or of what is published of it, changes distances as well.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import camera_numbers, with_effects
from rim_camera_ros.effects import ORDER
from rim_camera_ros.effects.amplitude_nonlinearity import AmplitudeNonlinearity
from rim_camera_ros.effects.amplitude_offset import AmplitudeOffset
from rim_camera_ros.effects.base import Effect
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.fit.amplitudes import AmplitudeModel
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.steps import with_numbers

from ..calibrate.helpers import camera, record, scene

#: Relative 1-sigma of predicted amplitudes: about that of one frame's, so that light is of both by halves.
ERROR = 0.03
#: Of the RMS of a derivative. The response's is taken at the predicted light, not at the measured one.
TOLERANCE = {AmplitudeNonlinearity: 0.05}


def stations_of(truth: Camera, tmp_path: Path) -> Dataset:
    """Two placements of the board, amplitudes wrong by some percent from tile to tile."""
    data = record(truth, scene(tmp_path), poses=3, seed=8)
    rng = np.random.default_rng(3)
    wrong = np.exp(ERROR * np.kron(rng.standard_normal((9, 11)), np.ones((4, 4))))
    return replace(
        data, stations=[replace(one, amplitude=one.amplitude * wrong) for one in data.stations[1:]]
    )


def readings(one: Prediction) -> tuple[np.ndarray, np.ndarray]:
    return one.distance, one.model_reading


@pytest.mark.parametrize("kind", ORDER, ids=lambda kind: str(kind.name))
def test_derivatives_through_the_chain_are_difference_quotients(kind: type[Effect], tmp_path: Path) -> None:
    stated = camera(tmp_path)
    others = (AmplitudeOffset.example(stated), Scattering((Kernel(0.12, (6.0, 5.0)),)))
    own = kind.example(stated)
    stated = with_effects(stated, {one.name: one for one in (*others, own)})
    board, data = scene(tmp_path), stations_of(stated, tmp_path)
    forward = Forward(data, board, stated)
    forward.amplitude_model = AmplitudeModel(tau=ERROR)
    at = list(forward.predictions())
    numbers = camera_numbers(stated)
    blocks = present_blocks(stated, effects=[kind.name])
    for block in blocks:
        columns = [block.columns(one) for one in at]
        for number, regressor in enumerate(block.regressors):
            step = 1e-3 * regressor.prior
            if numbers[regressor.label]:
                step = min(step, 1e-3 * abs(numbers[regressor.label]))
            moved = []
            for by in (step, -step):
                other = Forward(
                    data, board, with_numbers(stated, {regressor.label: numbers[regressor.label] + by})
                )
                other.amplitude_model = forward.amplitude_model
                moved.append(list(other.predictions()))
            found, expected = [], []
            for one, column, more, less in zip(at, columns, *moved, strict=True):
                for channel, (used, unit) in enumerate(
                    ((one.used, one.sigma), (one.amplitude_used, one.amplitude_sigma))
                ):
                    quotient = (readings(more)[channel] - readings(less)[channel]) / (2 * step)
                    derivative = column[number][channel]
                    derivative = np.zeros(used.shape) if derivative is None else derivative + 0 * unit
                    found.append((derivative / unit)[used])
                    expected.append((quotient / unit)[used])
            difference = np.concatenate(found) - np.concatenate(expected)
            size = np.sqrt(np.mean(np.square(np.concatenate(expected))))
            wrong = np.sqrt(np.mean(np.square(difference)))
            # what moves no reading by a thousandth of its noise within its prior shows rounding
            assert wrong <= TOLERANCE.get(kind, 0.01) * size + 1e-3 / regressor.prior, regressor.label
