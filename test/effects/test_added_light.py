"""Light that does not come from the scene, by hand: its phasor, and what a correction leaves of it."""

from __future__ import annotations

import numpy as np
import pytest

from rim_camera_ros.camera import Camera, Radiometry
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.effects.added_light import AddedLight
from rim_camera_ros.effects.scattering import Kernel, Scattering
from rim_camera_ros.effects.signal import Context, Signal
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.correct import Correction

from .test_contract import SETTINGS, camera, frame_of, room

LIGHT = AddedLight(real=((0.001, 0.003), (-0.002, 0.005)), imaginary=((0.002, 0.0), (0.004, -0.001)))


def with_gain(cam: Camera) -> Camera:
    return Camera(
        sensor=cam.sensor,
        optics=cam.optics,
        device=cam.device,
        minimum_amplitude=0.0,
        radiometry=Radiometry(gain=250.0),
    )


def test_a_phasor_is_added_at_the_place_of_the_pixel() -> None:
    """Pixel (10, 8) of 41 x 33: shares (10.5 / 41, 8.5 / 33) of the way between the four knots."""
    cam = with_gain(camera())
    context = Context(cam, SETTINGS)
    distance, amplitude = np.full(cam.shape, 2.4), np.full(cam.shape, 310.0)
    amplitude[3, 5] = 0.0
    found = LIGHT.simulate(Signal(distance, amplitude), context)
    across, down = 10.5 / 41, 8.5 / 33
    corners = [
        ((1 - down) * (1 - across), 0.001 + 0.002j),
        ((1 - down) * across, 0.003 + 0.0j),
        (down * (1 - across), -0.002 + 0.004j),
        (down * across, 0.005 - 0.001j),
    ]
    # gain of 250 counts m^2 per unit, integration time 72
    added = 250.0 * 72.0 * sum(share * value for share, value in corners)
    ambiguity = 299_792_458 / 40e6
    own = 310.0 * np.exp(2j * np.pi * 2.4 / ambiguity)
    both = own + added
    assert found.amplitude[8, 10] == pytest.approx(abs(both), rel=1e-12)
    moved = np.angle(both / own) * ambiguity / (2 * np.pi)
    assert abs(moved) > 0.05
    assert found.distance[8, 10] == pytest.approx(2.4 + moved, abs=1e-12)
    # no light of the scene, no measurement
    assert found.amplitude[3, 5] == 0.0


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("scatters", [True, False])
def test_a_correction_subtracts_it(
    monkeypatch: pytest.MonkeyPatch, *, compiled: bool, scatters: bool
) -> None:
    if compiled and kernels.LIBRARY is None:
        pytest.skip("the kernels are not compiled")
    if not compiled:
        monkeypatch.setattr(kernels, "LIBRARY", None)
    stray = Scattering(kernels=(Kernel(weight=0.08, sigma=(6.0, 4.0)),))
    plain = {stray.name: stray} if scatters else {}
    cam = with_effects(with_gain(camera()), {**plain, LIGHT.name: LIGHT})
    _, _, raw = frame_of(room(), cam)
    _, _, without = frame_of(room(), with_effects(cam, plain))
    lit = raw.amplitude > 0
    # it moves distances by up to decimetres, as a room's dark tiles send little
    assert np.abs(raw.distance - without.distance)[lit].max() > 0.1
    expected = Correction(with_effects(cam, plain)).correct_distance(without)
    for integration_time in (72.0, 30.0):
        # another setting has another light
        _, _, raw = frame_of(room(), cam, integration_time=integration_time)
        assert isinstance(raw, RawFrame)
        found = Correction(cam).correct_distance(raw)
        error = np.abs(found.distance - expected.distance)[lit]
        assert np.nanmax(error) < 1e-4
    np.testing.assert_array_equal(np.isfinite(found.distance), np.isfinite(expected.distance))


def test_images_of_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"real has the shape \(1, 2\), imaginary \(2, 1\)"):
        AddedLight(real=((0.1, 0.2),), imaginary=((0.1,), (0.2,)))
    with pytest.raises(ValueError, match="rows of the same length, one value at least"):
        AddedLight(real=((0.1, 0.2), (0.3,)), imaginary=((0.1, 0.2), (0.3, 0.4)))
