#!/usr/bin/env python3
"""Write the .npy files that the shipped camera files name: fixed patterns, covariances, the integral table.

None of these arrays is a measurement. The fixed patterns have a fixed seed and the size that is usual for the device class; the
covariances hold the 1-sigma of each parameter as listed below, squared, without correlations. They are small enough that a
correction with parameters drawn from them stays good to about a centimetre. Run it again after a change of the tables below; with
`--check` nothing is written, and the exit status is 1 where a file on disk or a `covariance.parameters` list differs.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import yaml

FOLDER = Path(__file__).resolve().parents[1]
SEED = 3000

# (path in the camera file, 1 sigma in the unit of the parameter): all assumed
SR3000 = [
    ("effects.cyclic_error.harmonics.0.amplitude", 0.002),  # m
    ("effects.cyclic_error.harmonics.0.phase", 0.03),  # rad
    ("effects.cyclic_error.gradient.0", 2.0e-4),  # rad/px
    ("effects.cyclic_error.gradient.1", 2.0e-4),
    (
        "effects.amplitude_offset.hyperbola.16.a",
        0.9,
    ),  # m counts: about 1 % at 16, the worst fit (sec. 3.3.5), else 0.5 %
    ("effects.amplitude_offset.hyperbola.60.a", 1.2),
    ("effects.amplitude_offset.hyperbola.100.a", 2.0),
    ("effects.incidence_angle.polynomial.16.3", 2.0e-5),  # m/gon
    ("effects.incidence_angle.polynomial.60.3", 2.0e-5),
    ("effects.incidence_angle.polynomial.100.3", 2.0e-5),
    ("effects.integration_time_offset.offset.16", 0.002),  # m
    ("effects.integration_time_offset.offset.60", 0.002),
    ("effects.integration_time_offset.offset.100", 0.002),
    ("effects.warm_up_drift.terms.0.amplitude", 0.004),  # m
    ("effects.warm_up_drift.terms.1.amplitude", 0.002),
    ("effects.ambient_temperature.coefficient", 2.0e-4),  # m/degC
    ("effects.distance_scale.scale", 3.0e-4),
    ("effects.scattering.kernels.0.weight", 0.002),
    ("effects.scattering.kernels.1.weight", 0.002),
    ("effects.emitter_offset.position.0", 0.001),  # m
    ("effects.emitter_offset.position.1", 0.001),
]

EVERY_EFFECT = [
    ("effects.cyclic_error.harmonics.0.amplitude", 0.002),
    ("effects.cyclic_error.harmonics.0.phase", 0.03),
    ("effects.cyclic_error.harmonics.1.amplitude", 0.001),
    ("effects.cyclic_error.harmonics.1.phase", 0.1),
    *SR3000[2:19],
    ("effects.scattering.ghost.weight", 5.0e-4),
    *SR3000[19:],
    ("effects.background_light.offset", 0.001),  # m
    ("effects.amplitude_nonlinearity.compression", 5.0e-8),  # 1/counts
    ("effects.reference_path.nominal", 0.001),  # m
]

SR2 = [
    ("effects.cyclic_error.harmonics.0.amplitude", 0.003),  # m
    ("effects.cyclic_error.harmonics.0.phase", 0.04),  # rad
    ("effects.integration_time_offset.offset.16", 0.003),  # m
    ("effects.integration_time_offset.offset.60", 0.003),
    ("effects.integration_time_offset.offset.100", 0.003),
    ("effects.warm_up_drift.terms.0.amplitude", 0.004),  # m
    ("effects.ambient_temperature.coefficient", 5.0e-4),  # m/degC
    ("effects.scattering.kernels.0.weight", 0.002),
    ("effects.scattering.kernels.1.weight", 0.002),
]

PMD = [
    ("effects.cyclic_error.harmonics.0.amplitude", 0.003),  # m
    ("effects.cyclic_error.harmonics.0.phase", 0.04),  # rad
    ("effects.scattering.kernels.0.weight", 0.002),
    ("effects.scattering.kernels.1.weight", 0.002),
]

COVARIANCES = {
    "sr3000": SR3000,
    "sr3000_every_effect": EVERY_EFFECT,
    "sr2": SR2,
    "pmd768s": PMD,
    "pmd1ks2": PMD,
    "pmd3ks": PMD,
    "pmd19k": PMD,
}


def fixed_pattern(*, width, height, smooth, white, seed):
    """Offset per pixel [m]: a smooth field of the given RMS (tilt, bowl and four long waves) plus white noise; mean 0."""
    random = np.random.Generator(np.random.PCG64(seed))
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    terms = [x, y, x * x + y * y]
    for _ in range(4):
        frequency = random.uniform(-1.5, 1.5, 2)
        terms.append(
            0.5 * np.cos(np.pi * (frequency[0] * x + frequency[1] * y) + random.uniform(0, 2 * np.pi))
        )
    field = sum(random.normal() * term for term in terms)
    field -= field.mean()
    field *= smooth / field.std()
    noise = random.normal(0.0, white, field.shape)
    return (field + noise - noise.mean()).astype(np.float32)


def integral_table():
    """Offsets [m] at the knots u, v, d of sr3000_every_effect.yaml: a few millimetres that change over the array and the distance."""
    u, v, d = np.meshgrid([0, 88, 175], [0, 72, 143], [0.5, 2.0, 4.0, 7.0], indexing="ij")
    u, v = (u - 87.5) / 87.5, (v - 71.5) / 71.5
    return (0.004 * u * v + 0.003 * np.sin(2 * np.pi * d / 7.0) * (1 - 0.5 * u)).astype(np.float32)


def arrays():
    """Every shipped array by file name."""
    result = {
        f"{name}_covariance.npy": np.diag(np.array([sigma for _, sigma in table]) ** 2)
        for name, table in COVARIANCES.items()
    }
    result["sr3000_fixed_pattern.npy"] = fixed_pattern(
        width=176, height=144, smooth=0.008, white=0.0015, seed=SEED
    )
    result["sr3000_every_effect_integral.npy"] = integral_table()
    return result


def differences():
    """Sentences that say what on disk differs from the tables above."""
    for name, array in arrays().items():
        path = FOLDER / name
        if not path.exists():
            yield f"{name} does not exist"
        else:
            stored = np.load(path)
            # another numpy or another processor may round the last bit differently
            if (
                stored.shape != array.shape
                or stored.dtype != array.dtype
                or not np.allclose(stored, array, rtol=1e-6, atol=1e-9)
            ):
                yield f"{name} differs"
    for name, table in COVARIANCES.items():
        camera = yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
        if camera["covariance"]["parameters"] != [path for path, _ in table]:
            yield f"{name}.yaml: covariance.parameters differ from this script"


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing, compare with what is on disk")
    if parser.parse_args(arguments).check:
        found = list(differences())
        print("\n".join(found) if found else "all as this script makes them")
        return 1 if found else 0
    for name, array in arrays().items():
        np.save(FOLDER / name, array)
        print(f"{name}  {array.dtype} {array.shape}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
