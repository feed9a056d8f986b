"""The two poses that fit the image of a small plane, mirrored at the line of sight.

Schweighofer and Pinz (2006): the image of a plane that appears small, or is seen from in front, hardly
changes when its normal is mirrored at the line of sight. Where residuals do not distinguish the two poses,
both are possible, and the pose is described by a mixture of the two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rim_camera_ros.photogrammetry.bundle import Adjusted, Bundle, predicted
from rim_camera_ros.photogrammetry.estimate import GROSS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fitted:
    """The pose of one station, adjusted to its targets; ``rejected``: number of gross errors among them."""

    adjusted: Adjusted
    bundle: Bundle
    rejected: int

    def cost(self, variance: float) -> float:
        """Return the sum of squared residuals over their variances, times a variance factor.

        Rejected targets count with a residual at the limit of rejection: a wrong pose with large residuals
        everywhere rejects none, and would otherwise be compared over other targets.
        """
        squares = self.adjusted.expected * self.adjusted.sigma_zero**2
        return squares / max(variance, 1e-300) + self.rejected * GROSS**2


@dataclass(frozen=True)
class PlacedPose:
    """A pose: ``rotation`` (3, 3), ``shift`` (3,) m, and the two parts of its covariance.

    ``own`` (6, 6): by the noise of its image; ``common`` (6, 6): by errors common to all stations. In the
    order x y z [m], rotations about the axes of the optical frame [rad].
    """

    rotation: Array
    shift: Array
    own: Array
    common: Array


def mirrored(rotation: Array, shift: Array, centre: Array) -> tuple[Array, Array]:
    """Return the pose whose normal is mirrored at the line of sight to a point of the target."""
    seen = rotation @ centre + shift
    sight = seen / np.linalg.norm(seen)
    normal = rotation[:, 2] * np.sign(rotation[:, 2] @ sight)
    # two reflections turn the normal by twice its angle with the line of sight
    half_turn = 2 * np.outer(sight, sight) - np.eye(3)
    back = 2 * np.outer(normal, normal) - np.eye(3)
    turned = half_turn @ back @ rotation
    return turned, seen - turned @ centre


def log_odds(first: Fitted, second: Fitted, variance: float) -> float:
    """Return the logarithm of the odds of one pose against another, by their residuals.

    ``variance``: factor on the variances of independent errors. The sums of squared residuals of the two
    poses differ only by components along d, the difference of the two images. Half their difference is
    therefore divided by the variance of errors along d, d'C d / d'd with the covariance C of the residuals:
    errors that targets share may look like one of the poses. The volume of the covariance of each pose
    accounts for all poses near it that fit as well.
    """
    bundle = first.bundle
    sigma = bundle.whole_sigma[:, None]
    # states without the targets that one of the two rejected
    states = [replace(fit.adjusted.state, targets=bundle.targets) for fit in (first, second)]
    images = [predicted(bundle, state) / sigma for state in states]
    apart = (images[1] - images[0]).ravel()
    square = float(apart @ apart)
    if square == 0:
        return 0.0
    alone = float(np.repeat((bundle.sigma / bundle.whole_sigma) ** 2, 2) @ apart**2)
    (shared,) = first.adjusted.shared or (np.zeros((len(apart), len(apart))),)
    pulled = apart / np.repeat(sigma, 2)
    together = float(pulled @ shared @ pulled)
    along = (variance * alone + max(variance, 1.0) * together) / square
    volumes = [np.linalg.slogdet(fit.adjusted.covariance_by(variance))[1] for fit in (first, second)]
    return float(second.cost(along) - first.cost(along) + volumes[0] - volumes[1]) / 2


def mixture(first: PlacedPose, second: PlacedPose, probability: float) -> PlacedPose:
    """Return mean and covariance of a mixture of two poses, of which the first has that ``probability``."""
    other = 1 - probability
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    apart = np.concatenate([second.shift - first.shift, turn])
    return PlacedPose(
        rotation=Rotation.from_rotvec(other * turn).as_matrix() @ first.rotation,
        shift=first.shift + other * apart[:3],
        own=probability * first.own + other * second.own + probability * other * np.outer(apart, apart),
        common=probability * first.common + other * second.common,
    )
