"""Prior for bends of an image that its points do not determine, outside of the points.

An image may be bent along its lines (attitude) or its samples (optics), and points on a part of it show
little of that: a parabola whose ends are 1.5 px off is 0.1 px beside a straight line over three fifths
of the image. A priori, an image is as likely bent as straight, by a Legendre polynomial over the image
with a normal coefficient. Where points do not say which, the mean square of the coefficient that is left
becomes the variance of a component of the displacement.
"""

from dataclasses import replace

import numpy as np

from amers.services.misfit.displacement_components import Along, Component, Kind
from amers.services.misfit.displacement_solution import by_affine, padded
from amers.services.misfit.structure import Residuals
from amers.services.sensors.correction import no_correction
from amers.services.types import Array

_EXPECTED_PX = 1.0
"""Standard deviation of the coefficient of a bent image, unless points clearly show a larger one."""
_BENT = 0.5
"""A priori probability that it is."""
_CLEAR = 3.0
"""Standard deviations from which on an estimate is more than chance."""
_GROWN: dict[Kind, float] = {"quadratic": 5.0, "cubic": 8.0}
"""Times its size (rms) at the points that a bend must reach at some place of the image.

Of points all over an image that leave half a chip at its borders, it reaches up to 4 and up to 6 times:
what they do not see is not large."""
_LEAST = 4.0
"""Times the variance of an affine correction, at some place, that bends must be to be followed."""
_PLACES = 9
"""Along each axis, at which that is looked at."""
_UNSEEN_PX2 = 1e6
"""Variance of a coefficient that the points tell nothing of."""


def bends(residuals: Residuals, expected: Array, shape: tuple[int, int]) -> tuple[Component, ...]:
    """The bends along lines and along samples that the points leave open; none where that is little.

    Args:
        residuals: of the active measures, with a covariance that includes all their errors and the
            followed components.
        expected: (2, k) a priori weights of the parameters.
        shape: lines and samples of the image.
    """
    # The model may be off by as much as the image is large: the image lies where its points are seen.
    first = -np.median(residuals.misfit, axis=0)
    last = first + np.array(shape) - 1.0
    line_sample = np.stack(
        np.meshgrid(*np.linspace(first, last, _PLACES).T, indexing="ij"), axis=-1
    ).reshape(-1, 2)
    t = padded(by_affine(line_sample, no_correction(shape)), residuals.design.shape[1])
    grown = [
        one for one in _bends(first, last) if _growth(one, residuals, line_sample, t) > _GROWN[one.kind]
    ]
    if not grown:
        return ()
    variance_px2 = np.zeros((len(grown), 2))
    matters = False
    for k in range(2):
        inverse = np.linalg.inv(residuals.covariance[k])
        weighted = inverse @ residuals.design
        own = np.linalg.pinv(residuals.design.T @ weighted + np.diag(expected[k]), hermitian=True)
        of_affine = ((t @ own) * t).sum(axis=1)
        of_bends = np.zeros(len(t))
        for j, one in enumerate(grown):
            column = one.polynomial(residuals.line_sample)
            affine = own @ (weighted.T @ column)
            pulled = inverse @ (column - residuals.design @ affine)
            precision = max(float(column @ pulled), 1.0 / _UNSEEN_PX2)
            estimate = float(pulled @ residuals.misfit[:, k]) / precision
            square, variance_px2[j, k] = _left_px2(estimate, 1.0 / precision)
            of_bends += square * (one.polynomial(line_sample) - t @ affine) ** 2
        matters |= bool((of_bends > _LEAST * of_affine).any())
    if not matters:
        return ()
    return tuple(replace(one, variance_px2=own) for one, own in zip(grown, variance_px2, strict=True))


def _bends(first: Array, last: Array) -> list[Component]:
    """The bends of unit variance over an image between two corners (2,)."""
    along: tuple[Along, ...] = ("lines", "samples")
    return [
        Component(degree, float(half_px), float(middle_px), np.ones(2), along=one)
        for one, half_px, middle_px in zip(
            along, (last - first) / 2.0, (last + first) / 2.0, strict=True
        )
        for degree in _GROWN
    ]


def _growth(bend: Component, residuals: Residuals, line_sample: Array, t: Array) -> float:
    """Largest size of a bend at places (m, 2) over that at the points (rms), beyond what is affine.

    Args:
        bend: of unit variance.
        residuals: at the points.
        line_sample: the places.
        t: (m, k) derivatives by the parameters there.
    """
    column = bend.polynomial(residuals.line_sample)
    affine = np.linalg.lstsq(residuals.design, column, rcond=None)[0]
    at_points_px = float(np.sqrt(np.mean((column - residuals.design @ affine) ** 2)))
    over_image_px = float(np.abs(bend.polynomial(line_sample) - t @ affine).max())
    return over_image_px / max(at_points_px, 1e-300)


def _left_px2(estimate: float, variance: float) -> tuple[float, float]:
    """Mean square of a coefficient, bent or not, and the variance of a normal one of that mean square.

    Args:
        estimate: of the coefficient by the points alone.
        variance: of it.
    """
    expected = max(_EXPECTED_PX**2, estimate**2 - _CLEAR**2 * variance)
    bent = variance + expected
    log_odds = -0.5 * (np.log(bent / variance) + estimate**2 / bent - estimate**2 / variance)
    probability = _BENT / (_BENT + (1.0 - _BENT) * np.exp(-np.clip(log_odds, -500.0, 500.0)))
    share = expected / bent
    square = float(probability * ((share * estimate) ** 2 + share * variance))
    # A normal coefficient of variance v: x^2 estimate^2 + x variance, where x = v / (v + variance).
    x = 2.0 * square / (variance + float(np.sqrt(variance**2 + 4.0 * estimate**2 * square)))
    return square, variance * x / max(1.0 - x, 1e-9)
