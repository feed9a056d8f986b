"""The diagnosis in a few lines, for a terminal."""

from __future__ import annotations

from pathlib import Path

from rim_camera_ros.diagnose.result import Diagnosis

WORDS = {
    "consistent": "The simulation explains this recording.",
    "wrong_parameters": "Known effects explain this recording, with other parameters than the camera file's.",
    "missing_physics": "The camera file lacks physics that this recording shows.",
    "unknown_physics": "The recording shows something that no effect of the vocabulary explains.",
    "inconsistent_setup": "Recording, scene and camera file do not belong together; no physics is named.",
}


def summary(result: Diagnosis, folder: Path) -> str:
    """Return the verdict, the missing physics, and the evidence, as text."""
    lines = [f"{result.verdict}: {WORDS[result.verdict]}"]
    if result.reason is not None:
        lines.append(f"  {result.reason}")
    for effect in result.missing:
        lines.append(f"  {effect.sentence} (probability {effect.probability:.2g})")
    for names in result.indistinguishable:
        lines.append(f"  indistinguishable by this recording: {', '.join(names)}")
    if result.next_recording:
        lines.append(f"  record next: {result.next_recording}")
    if result.adjusted:
        moved = ", ".join(term.effect for term in result.adjusted)
        lines.append(f"  known terms that moved: {moved}")
    fit = result.accuracy
    poses = "held-out poses" if fit.held_out else "the poses fitted, as nothing could be held out"
    lines.append(
        f"  {poses}: RMS {fit.rms_before * 1e3:.2f} -> {fit.rms_after * 1e3:.2f} mm "
        f"(noise {fit.noise_floor * 1e3:.2f} mm), chi-square per value {fit.chi2_before:.3f} -> "
        f"{fit.chi2_after:.3f}"
    )
    lines.append(f"  {folder / 'report.html'}, report.json, where.npy, camera.yaml")
    return "\n".join(lines)
