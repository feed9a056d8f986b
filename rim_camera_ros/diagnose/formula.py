"""The closed form of a curve: a sparse fit, written as a line of text, and read again."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.errors import InputError

Array = NDArray[Any]

#: Terms of a closed form in the covariate x.
_FORMS: Mapping[str, Callable[[Array], Array]] = MappingProxyType(
    {
        "x": lambda x: x,
        "x^2": lambda x: x**2,
        "x^3": lambda x: x**3,
        "1/x": lambda x: 1 / x,
        "1/x^2": lambda x: 1 / x**2,
        "sqrt(x)": np.sqrt,
        "log(x)": np.log,
    }
)
_NUMBER = re.compile(r"^([+-]?[0-9.]+(?:e[+-]?[0-9]+)?)$")
#: Share of a curve's range to which a formula must describe it: limits the weight of a class of pixels.
_COARSE = 0.02


def require_formulas() -> None:
    """Raise `InputError` where scikit-learn, which finds formulas, is not installed."""
    if find_spec("sklearn") is None:
        raise InputError(
            "scikit-learn is not installed: a curve of unknown physics would have no formula",
            remedy="sudo apt install python3-sklearn, or pip install 'rim_camera_ros[diagnosis]'",
        )


def product_form(names: tuple[str, str], knots: tuple[tuple[float, ...], ...], values: Array) -> str:
    """Return a bilinear table ``values`` (2, 2) in metres as a product of its two covariates.

    Parts that depend on one covariate alone are dropped: they are errors of poses and the fixed pattern.
    """
    (a, b), (c, d) = knots
    slope = (values[1, 1] - values[1, 0] - values[0, 1] + values[0, 0]) / ((b - a) * (d - c))
    x, y = names
    return f"{slope:.3g} ({x} - {(a + b) / 2:.4g}) ({y} - {(c + d) / 2:.4g}) [m]"


def closed_form(name: str, x: Array, y: Array, sigma: Array) -> tuple[str, float]:
    """Return the sparse formula in metres that describes a curve best, and its misfit (RMS) [m].

    The fit is by orthogonal matching pursuit. A term is added where it lowers chi-square by more than 2 ln N
    for N classes: twice the requirement of the Bayesian information criterion, as it is chosen among several.
    """
    from sklearn.linear_model import OrthogonalMatchingPursuit

    weight = 1.0 / np.maximum(np.hypot(sigma, _COARSE * np.ptp(y)), 1e-6)
    usable = {}
    for form, function in _FORMS.items():
        if np.min(x) <= 1e-9 and form in ("1/x", "1/x^2", "sqrt(x)", "log(x)"):
            continue
        values = function(x)
        if np.all(np.isfinite(values)) and np.ptp(values) > 0:
            usable[form] = values
    names = list(usable)
    columns = np.stack([usable[form] for form in names], axis=1)
    mean = np.average(columns, axis=0, weights=weight**2)
    centre = float(np.average(y, weights=weight**2))
    design = (columns - mean) * weight[:, None]
    target = (y - centre) * weight
    best: tuple[float, str, float] | None = None
    scale = np.linalg.norm(design, axis=0)
    for terms in range(1, min(3, len(names), len(x) - 2) + 1):
        model = OrthogonalMatchingPursuit(n_nonzero_coefs=terms, fit_intercept=False)
        model.fit(design / scale, target)
        coefficients = np.ravel(model.coef_) / scale
        rest = target - design @ coefficients
        criterion = float(rest @ rest) + 2 * terms * np.log(len(x))
        parts = [f"{c:+.3g} {form}" for c, form in zip(coefficients, names, strict=True) if c != 0.0]
        constant = centre - float(mean @ coefficients)
        text = f"{constant:.3g} " + " ".join(parts)
        if best is None or criterion < best[0]:
            best = (criterion, text, float(np.sqrt(np.mean((rest / weight) ** 2))))
    formula, missed = best[1:] if best is not None else (f"{centre:.3g}", float(np.std(y)))
    return f"{formula} [m], x = {name}", missed


def formula_terms(formula: str) -> list[tuple[float, str]] | None:
    """Return coefficients [m] and their forms (of the constant: empty); None where it is no such formula."""
    terms: list[tuple[float, str]] = []
    words = formula.split(" [m]")[0].split()
    while words:
        if _NUMBER.match(words[0]) is None:
            return None
        number = float(words.pop(0))
        form = words.pop(0) if words and words[0] in _FORMS else ""
        terms.append((number, form))
    return terms


def formula_curve(formula: str, x: Array) -> Array | None:
    """Return a closed form [m] at values of its covariate; None where it cannot be read."""
    terms = formula_terms(formula)
    if terms is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        total = sum(number * (_FORMS[form](x) if form else np.ones_like(x)) for number, form in terms)
    return np.asarray(total)
