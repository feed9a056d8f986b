#!/usr/bin/env python3
"""Turn a lens calibration by Australis (or another Brown bundle adjustment) into the `optics` of a camera file.

Two models that run in opposite directions:

* Australis *corrects measured coordinates to ideal ones*, in millimetres on the chip, with x = x_measured - xp,
  y = y_measured - yp, r^2 = x^2 + y^2 (Brown 1971; Kahlmann 2007, sec. 3.2):

      x_ideal = x + x (K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 x^2) + 2 P2 x y
      y_ideal = y + y (K1 r^2 + K2 r^4 + K3 r^6) + P2 (r^2 + 2 y^2) + 2 P1 x y

* ROS `plumb_bob` goes *from ideal to distorted coordinates*, in units of the camera constant, and has the two decentring
  coefficients exchanged:

      x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
      y_d = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

To first order k1 = -K1 c^2, p1 = -P2 c, p2 = -P1 c. The inverse of a polynomial is no polynomial, so the five coefficients are
fitted: every pixel centre is corrected by Australis' formulas, distorted again by plumb_bob, and the five coefficients make the sum of
the squared differences over the array smallest. fx, fy, cx, cy are not fitted, they follow from c, xp, yp and the pixel pitch. The
largest and the RMS difference that is left is printed: no set of five coefficients does better in the least-squares sense.

Sign conventions assumed, change them if your project differs:

* xp, yp is the position of the principal point relative to the centre of the array, pixel ((width - 1) / 2, (height - 1) / 2);
* x points right, as the column number does;
* y points down, as the row number does (`--y-axis down`, the default). For y pointing up give `--y-axis up`: yp and P2 change sign;
* the correction is added to the measured coordinate, as written above.

The affinity B1 and shear B2 (SCX, SHR) have no place in plumb_bob and are left out.
"""

import argparse
import sys

import numpy as np
from scipy.optimize import least_squares

EXAMPLES = """examples:
  the SR-3000 of Kahlmann 2007, table 3.2:
    %(prog)s --width 176 --height 144 --pitch 0.040 0.040 --c 7.9955 --xp 0.0997 --yp 0.4357 \\
        --K 1.65764e-3 3.78532e-5 -2.65190e-6 --P 3.17463e-4 -1.43750e-4
  the SR-2, table 3.1:
    %(prog)s --width 160 --height 124 --pitch 0.0392 0.0548 --c 7.656 --xp -0.1158 --yp 0.1051 \\
        --K -2.388e-3 1.286e-4 0
"""


def australis_correct(x, y, K, P):
    """Measured to ideal coordinates, millimetres relative to the principal point."""
    r2 = x * x + y * y
    radial = r2 * (K[0] + r2 * (K[1] + r2 * K[2]))
    return (
        x + x * radial + P[0] * (r2 + 2 * x * x) + 2 * P[1] * x * y,
        y + y * radial + P[1] * (r2 + 2 * y * y) + 2 * P[0] * x * y,
    )


def plumb_bob_distort(x, y, d):
    """Ideal to distorted normalised coordinates; d = k1 k2 p1 p2 k3."""
    k1, k2, p1, p2, k3 = d
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def convert(*, width, height, pitch, c, xp, yp, K=(0.0, 0.0, 0.0), P=(0.0, 0.0), y_axis="down"):
    """Return (optics, error): the `optics` mapping of a camera file and the distance in pixels, (height, width), that the fit leaves.

    pitch, c, xp, yp in millimetres, K in mm^-2, mm^-4, mm^-6, P in mm^-1.
    """
    if y_axis == "up":
        yp, P = -yp, (P[0], -P[1])
    fx, fy = c / pitch[0], c / pitch[1]
    cx, cy = (width - 1) / 2 + xp / pitch[0], (height - 1) / 2 + yp / pitch[1]
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    x, y = australis_correct((u - cx) * pitch[0], (v - cy) * pitch[1], K, P)
    x, y = x / c, y / c

    def difference(d):
        xd, yd = plumb_bob_distort(x, y, d)
        return np.concatenate([(fx * xd + cx - u).ravel(), (fy * yd + cy - v).ravel()])

    # plumb_bob is linear in its coefficients: one step solves it
    start = np.zeros(5)
    columns = np.stack([difference(row) - difference(start) for row in np.eye(5)], axis=1)
    used = [0, 1, 4] if not any(P) else list(range(5))  # a lens without decentring keeps none
    solution = least_squares(
        lambda p: difference(start) + columns[:, used] @ p,
        np.zeros(len(used)),
        x_scale="jac",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    d = np.zeros(5)
    d[used] = solution.x
    dx, dy = np.split(difference(d), 2)
    optics = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "d": d.tolist()}
    return optics, np.hypot(dx, dy).reshape(height, width)


def number(value):
    """Text that YAML 1.1 reads as a float."""
    text = f"{value:.9g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    return text if "." in text else text + ".0"


def is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, required=True, metavar="N", help="columns")
    parser.add_argument("--height", type=int, required=True, metavar="N", help="rows")
    parser.add_argument(
        "--pitch", type=float, nargs=2, required=True, metavar=("X", "Y"), help="pixel pitch, mm"
    )
    parser.add_argument("--c", type=float, required=True, metavar="MM", help="camera constant, mm")
    parser.add_argument("--xp", type=float, default=0.0, metavar="MM", help="principal point, mm")
    parser.add_argument("--yp", type=float, default=0.0, metavar="MM", help="principal point, mm")
    parser.add_argument(
        "--K",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("K1", "K2", "K3"),
        help="radial distortion, mm^-2, mm^-4, mm^-6",
    )
    parser.add_argument(
        "--P",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("P1", "P2"),
        help="decentring distortion, mm^-1",
    )
    parser.add_argument(
        "--y-axis",
        choices=["down", "up"],
        default="down",
        help="direction of y in the project (default: %(default)s)",
    )
    # argparse takes -2.4e-3 for an option; with a blank before it, it is a value
    options = parser.parse_args(
        [
            " " + text if text.startswith("-") and is_number(text) else text
            for text in (sys.argv[1:] if arguments is None else arguments)
        ]
    )
    if min(options.width, options.height, *options.pitch, options.c) <= 0:
        parser.error("width, height, pitch and c must be positive")
    optics, error = convert(**vars(options))
    row, column = np.unravel_index(error.argmax(), error.shape)
    pairs = ", ".join(f"{name}: {number(optics[name])}" for name in ("fx", "fy", "cx", "cy"))
    print(f"optics: {{{pairs},\n         d: [{', '.join(number(value) for value in optics['d'])}]}}")
    print(
        f"# left by the fit: RMS {np.sqrt((error**2).mean()):.2g} px, largest {error.max():.2g} px at column {column}, row {row}; "
        f"y axis {options.y_axis}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
