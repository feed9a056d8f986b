"""The rows of the table: what is measured, against what, and what is required."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rim_camera_ros.bags.images import decode_image
from rim_camera_ros.camera import Camera
from rim_camera_ros.camera_file import with_effects
from rim_camera_ros.fit.data import Dataset
from rim_camera_ros.fit.design import present_blocks
from rim_camera_ros.fit.forward import Forward
from rim_camera_ros.fit.normal_equations import accumulate
from rim_camera_ros.fit.reduction import reduce_frames
from rim_camera_ros.frame import RawFrame
from rim_camera_ros.phasor import demodulate, to_phasor
from rim_camera_ros.pipeline import kernels
from rim_camera_ros.pipeline.correct import Correction
from test.bench import baseline, cases

Work = Callable[[], Any]


@dataclass(frozen=True)
class Row:
    """``ours`` against ``naive``; ``required`` is the least ratio. Without ``naive``: frames per second."""

    work: str
    size: tuple[int, int]
    ours: Work
    naive: Work | None = None
    required: float | None = None


def cloud(size: tuple[int, int]) -> Row:
    """Counts -> corrected cloud with cyclic, per-pixel and amplitude terms."""
    camera = cases.plain(*size)
    frame = cases.frame_of(camera)
    correction = Correction(camera)
    minimum = correction.minimum_for(frame.settings)

    def ours() -> Any:
        return correction.cloud(correction.correct_distance(frame))

    def naive() -> Any:
        return baseline.cloud(camera, 100.0, minimum, frame.distance, frame.amplitude)

    expected, found = naive(), ours()
    known = np.isfinite(expected[..., :3])
    assert known.any()
    np.testing.assert_array_equal(np.isfinite(found[..., :3]), known)
    np.testing.assert_allclose(found[..., :3][known], expected[..., :3][known], atol=1e-5)
    np.testing.assert_array_equal(found[..., 3], expected[..., 3])
    return Row("counts -> cloud", size, ours, naive, 18.0)


def scattering(size: tuple[int, int]) -> Row:
    """Delivered distance and amplitude -> those without stray light of two kernels."""
    _check_fourier(size)
    camera = cases.scattering(*size)
    frame = cases.frame_of(camera)
    correction = Correction(camera)
    division = baseline.FourierDivision(camera)
    lsb = camera.sensor.lsb

    def ours() -> Any:
        return correction.correct_distance(frame)

    def naive() -> Any:
        return division.undo(frame.distance * lsb, frame.amplitude.astype(float))

    # the result, spread again by way of Fourier, is what was measured
    found = ours()
    lit = np.isfinite(found.distance)
    wrapped = np.where(lit, found.distance, 0.0).astype(float)
    light = to_phasor(wrapped, np.where(lit, found.amplitude, 0.0).astype(float), camera.sensor.ambiguity)
    # padded so far that the wide kernel does not come round
    again = baseline.FourierDivision(camera, pad=5).spread(light)
    measured = to_phasor(frame.distance * lsb, frame.amplitude * lit.astype(float), camera.sensor.ambiguity)
    np.testing.assert_allclose(
        again[lit], measured[lit], rtol=3e-3, atol=1e-3 * float(np.median(np.abs(measured)))
    )
    return Row("scattering undone", size, ours, naive, 5.0 if size[0] < 640 else 4.0)


def _check_fourier(size: tuple[int, int]) -> None:
    """Check that both undo the same where no light reaches the sensor's edge."""
    camera = cases.scattering(*size, compact=True)
    division = baseline.FourierDivision(camera)
    distance, amplitude = cases.spot(camera)
    delivered = division.spread(to_phasor(distance, amplitude, camera.sensor.ambiguity))
    measured = np.angle(delivered) % (2 * np.pi) * (camera.sensor.ambiguity / (2 * np.pi))
    expected, light = division.undo(measured, np.abs(delivered))
    lit = amplitude > 0
    np.testing.assert_allclose(expected[lit], distance[lit], atol=1e-9)
    frame = RawFrame(stamp=0, distance=measured, amplitude=np.abs(delivered), settings=cases.SETTINGS)
    found = Correction(camera).correct_distance(frame)
    np.testing.assert_allclose(found.distance[lit], expected[lit], atol=1e-5)
    np.testing.assert_allclose(found.amplitude[lit], light[lit], rtol=1e-5)


def samples(size: tuple[int, int]) -> Row:
    """Four samples -> phase, amplitude, offset."""
    rng = np.random.default_rng(5)
    four = rng.uniform(100.0, 4000.0, (4, size[1], size[0])).astype(np.float32)
    wide = four.astype(float)
    for found, expected in zip(demodulate(four), baseline.demodulate(wide), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    return Row("four samples -> phase", size, lambda: demodulate(four), lambda: baseline.demodulate(wide))


def message(size: tuple[int, int]) -> Row | None:
    """Cloud -> the field of its message; None without ROS."""
    try:
        from std_msgs.msg import Header

        from rim_camera_ros.nodes.common.messages import cloud as message_of
    except ImportError:
        return None
    points = np.random.default_rng(6).normal(size=(size[1], size[0], 4)).astype(np.float32)
    header = Header()
    assert message_of(points, header).data == baseline.message_bytes(points)
    return Row(
        "cloud -> message", size, lambda: message_of(points, header), lambda: baseline.message_bytes(points)
    )


def decoding(size: tuple[int, int]) -> Row:
    """Bytes of a raw image -> image."""
    width, height = size
    image = np.random.default_rng(7).integers(0, 65536, (height, width)).astype(np.uint16)
    data = image.astype("<u2").tobytes()

    def ours() -> Any:
        return decode_image("16UC1", height, width, 2 * width, False, data)

    np.testing.assert_array_equal(ours(), baseline.decode(data, (height, width)))
    return Row("image from bytes", size, ours, lambda: baseline.decode(data, (height, width)))


def every_effect() -> Row:
    """The complete correction of a frame with every effect: distance, amplitude, sigma, flags."""
    camera = cases.every_effect()
    return _compiled("all effects undone", camera, 2.0)


def stray_light_compiled() -> Row:
    """The correction of a camera whose only effect is stray light of two kernels."""
    return _compiled("stray light, compiled", cases.scattering(*cases.SIZES[0]), 1.6)


def _compiled(work: str, camera: Camera, required: float) -> Row:
    """Compiled kernels against numpy's path, which makes no ratio where there is no compiler."""
    frame = cases.frame_of(camera)
    correction = Correction(camera)
    if kernels.LIBRARY is None:
        return Row(f"{work} (not compiled)", cases.SIZES[0], lambda: correction.correct(frame))
    with _without_kernels():
        by_numpy = Correction(camera)

    def naive() -> Any:
        with _without_kernels():
            return by_numpy.correct(frame)

    expected, found = naive(), correction.correct(frame)
    # a few pixels at the rim of a plane go with another plane, as sums are rounded in another order
    apart = np.abs(found.distance - expected.distance)
    assert np.nanquantile(apart, 0.999) < 1e-4
    return Row(work, cases.SIZES[0], lambda: correction.correct(frame), naive, required)


@contextlib.contextmanager
def _without_kernels() -> Iterator[None]:
    library, kernels.LIBRARY = kernels.LIBRARY, None
    try:
        yield
    finally:
        kernels.LIBRARY = library


def parts_of_every_effect() -> list[Row]:
    """The same, effect by effect, less what a camera without effects costs: the first row."""
    camera = cases.every_effect()
    none = {"none": with_effects(camera, {})}
    alone = none | {name: with_effects(camera, {name: one}) for name, one in camera.effects.items()}
    # one effect at a time on the frame with all of them: the planes are as hard to find as there
    frame = cases.frame_of(camera)
    rows = []
    for name, one in alone.items():
        correction = Correction(one)
        rows.append(Row(name, cases.SIZES[0], lambda correction=correction: correction.correct(frame)))
    return rows


def simulation() -> Row:
    """A frame with every effect but sample level, multipath and motion."""
    camera = cases.every_effect()
    effects = {name: one for name, one in camera.effects.items() if name not in ("multipath", "motion")}
    simulated, exposure = cases.room(with_effects(camera, effects))
    return Row("simulated frame", cases.SIZES[0], lambda: simulated.frame(exposure), required=200.0)


def threads() -> Row:
    """Normal equations of stations with stray light, by two threads against one."""
    camera = cases.scattering(*cases.SIZES[0])
    simulated, exposure = cases.room(camera)
    # farther apart than what is averaged
    stamps = (exposure.stamp + k * 60 * 10**9 for k in range(8))
    frames = [simulated.frame(replace(exposure, stamp=stamp, pose_stamp=stamp)) for stamp in stamps]
    data = Dataset(list(reduce_frames(frames, camera)), ["bench"], [], len(frames))
    assert len(data.stations) == len(frames)
    blocks = present_blocks(camera)
    forward = Forward(data, simulated.scene, camera)
    forward.estimate_amplitudes()

    def work(number: int) -> Any:
        forward.threads = number
        return accumulate(forward, blocks).folds[0].gram

    np.testing.assert_array_equal(work(2), work(1))
    return Row("equations, two threads", cases.SIZES[0], lambda: work(2), lambda: work(1), 1.1)


def all_rows() -> Iterator[Row]:
    """Yield every row, checked."""
    for make in (cloud, scattering, samples, message, decoding):
        for size in cases.SIZES:
            row = make(size)
            if row is not None:
                yield row
    yield every_effect()
    yield stray_light_compiled()
    yield simulation()
    yield threads()
