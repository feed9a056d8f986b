"""The joint adjustment: damped Gauss-Newton steps over the forward chain, effects and nuisances at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from rim_camera_ros.camera import Camera
from rim_camera_ros.effects.candidate import Block
from rim_camera_ros.fit.gauss_newton import GaussNewton
from rim_camera_ros.fit.linearised import TOLERANCE
from rim_camera_ros.fit.problem import Fit, Point, Problem
from rim_camera_ros.fit.views import Views

Progress = Callable[[str], None]


def fit(
    problem: Problem,
    camera: Camera,
    *,
    fold_of: Mapping[tuple[int, int], int] | None = None,
    further: Sequence[Block] = (),
    iterations: int = 8,
    tolerance: float = TOLERANCE,
    views: Views | None = None,
    warm: Fit | Point | None = None,
    near: bool = False,
    progress: Progress | None = None,
) -> Fit:
    """Adjust a camera's parameters to the data.

    Steps end when no parameter moves by more than ``tolerance`` of its sigma. Unless edges move, the pixels
    stay the same once steps are compared, also where the problem has no masks. ``further`` blocks of
    regressors (candidates) are added to the final equations without being fitted. ``warm`` is a fit of the
    same data, or its point: the fit starts from its pattern, errors and powers. With no ``iterations`` the
    result is that solution, with the further blocks in its equations. ``near`` says that the camera is near
    the solution also in effects that are new: their widths move at once, and a step that raises the
    objective a little is followed by another one before it is taken back.

    Raises `RimError` where it does not converge to a finite solution, `InputError` without usable data.
    """
    begin = warm.point if isinstance(warm, Fit) else warm
    work = GaussNewton(
        problem, camera, iterations=iterations, tolerance=tolerance, views=views, warm=begin, near=near
    )
    best: Fit | None = None
    for count in range(iterations + 2):
        final = count >= iterations or work.ended
        here = work.linearised(
            work.predicted(count),
            count,
            further=further if final else (),
            fold_of=fold_of if final else None,
        )
        if work.went_too_far(here, count):
            work.shorten(final=final)
            continue
        work.accept(here)
        best = work.result(here, count, final=final)
        if final:
            break
        if progress is not None:
            square = here.square / max(here.reduced.expected, 1)
            progress(f"iteration {count + 1}: chi-square per value {square:.4f}")
        work.advance(here, count)
    assert best is not None
    work.judge(best)
    return best
