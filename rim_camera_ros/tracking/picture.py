"""People's tracks from above, and over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rim_camera_ros.tracking.trial import Trial


def draw(trial: Trial, path: Path) -> None:
    """Write a PNG: the floor from above with walks and tracks, and the position to the left over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (above, beside) = plt.subplots(1, 2, figsize=(11, 4.6), constrained_layout=True)
    for k in range(trial.truth.shape[1]):
        label = "walked" if k == 0 else None
        above.plot(-trial.truth[:, k, 1], trial.truth[:, k, 0], color="0.6", lw=4, label=label, zorder=1)
        beside.plot(trial.times, trial.truth[:, k, 1], color="0.6", lw=4, label=label, zorder=1)
    for i, (identity, track) in enumerate(sorted(trial.tracks.items())):
        seen = track[:, 3] == 0
        for axis, across, along in (
            (above, -track[:, 2], track[:, 1]),
            (beside, track[:, 0], track[:, 2]),
        ):
            axis.plot(across[seen], along[seen], ".", color=f"C{i}", label=f"person {identity}")
            axis.plot(across[~seen], along[~seen], "o", mfc="none", color=f"C{i}", ms=4)
    above.plot(0, 0, "k^", label="camera")
    above.set_xlabel("to the right [m]")
    above.set_ylabel("forward [m]")
    above.set_aspect("equal")
    above.set_ylim(-0.2, float(np.max(trial.truth[..., 0])) + 0.3)
    above.set_title("from above", fontsize=10)
    beside.set_xlabel("time [s]")
    beside.set_ylabel("to the left [m]")
    beside.set_xlim(0.0, float(trial.times[-1]))
    beside.set_ylim(-2.8, 2.8)
    beside.set_title("over time (rings: hidden or out of view, predicted)", fontsize=10)
    above.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
