"""Piecewise polynomials: the common form of orbits, attitudes, look angles and line times.

Each interpolation of a sensor model (Lagrange, Hermite, linear tables, polynomials) becomes polynomials
between breaks, so that one kernel evaluates them all.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from services.types import Array

LAGRANGE_NODES = 8
"""Samples in an interpolation by a polynomial of degree seven."""


@dataclass(frozen=True)
class PiecewisePolynomial:
    """A vector function of one variable, a polynomial between each pair of breaks.

    The first and the last polynomial also hold beyond the first and the last break.

    Attributes:
        breaks: (p + 1,) increasing.
        coefficients: (p, values, degree + 1), highest power first, of a variable that is -1 at the lower
            break of the piece and 1 at its upper break.
    """

    breaks: Array
    coefficients: Array

    def __call__(self, x: Array) -> Array:
        """Values (n, values) at positions (n,)."""
        return _evaluate(self.breaks, self.coefficients, np.ascontiguousarray(x, dtype=np.float64))[0]

    def derivative(self, x: Array) -> Array:
        """Derivatives (n, values) at positions (n,)."""
        return _evaluate(self.breaks, self.coefficients, np.ascontiguousarray(x, dtype=np.float64))[1]


def from_function(breaks: Array, function: Callable[[Array], Array], degree: int) -> PiecewisePolynomial:
    """The polynomials through `degree + 1` Chebyshev points of a function in each piece.

    Exact to rounding where the function itself is a polynomial of that degree in each piece.

    Args:
        breaks: (p + 1,) increasing.
        function: values (n, values) at positions (n,).
        degree: of the polynomials.
    """
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    middle, half = (breaks[1:] + breaks[:-1]) / 2.0, np.diff(breaks) / 2.0
    at_nodes = function((middle[:, None] + half[:, None] * nodes).ravel())
    at_nodes = at_nodes.reshape(len(middle), degree + 1, -1)
    inverse = np.linalg.inv(np.vander(nodes))
    offset = at_nodes.mean(axis=1, keepdims=True)
    coefficients = np.einsum("kn,pnv->pvk", inverse, at_nodes - offset)
    coefficients[:, :, -1] += offset[:, 0]
    return PiecewisePolynomial(
        np.ascontiguousarray(breaks, dtype=np.float64), np.ascontiguousarray(coefficients)
    )


def polynomial(centre: float, half_width: float, coefficients: Array) -> PiecewisePolynomial:
    """One polynomial of `(x - centre) / half_width`.

    Args:
        centre: where the variable is zero.
        half_width: where it is one, after the centre.
        coefficients: (values, degree + 1), constant first.
    """
    return PiecewisePolynomial(
        np.array([centre - half_width, centre + half_width]),
        np.ascontiguousarray(coefficients[None, :, ::-1], dtype=np.float64),
    )


def linear(x: Array, values: Array) -> PiecewisePolynomial:
    """The straight lines between samples; the first and the last line go on.

    Args:
        x: (m,) positions of the samples, increasing, at least two.
        values: (m, values).
    """
    middle, half = (values[1:] + values[:-1]) / 2.0, (values[1:] - values[:-1]) / 2.0
    return PiecewisePolynomial(
        np.ascontiguousarray(x, dtype=np.float64), np.stack([half, middle], axis=-1)
    )


def hermite(x: Array, values: Array, rates: Array) -> PiecewisePolynomial:
    """The cubic polynomials that have the values and the rates of samples at both ends of each interval.

    Args:
        x: (m,) positions of the samples, increasing, at least two.
        values: (m, values).
        rates: (m, values) derivatives.
    """
    half = np.diff(x)[:, None] / 2.0
    low, high, low_rate, high_rate = values[:-1], values[1:], half * rates[:-1], half * rates[1:]
    coefficients = [
        (low - high + low_rate + high_rate) / 4.0,
        (high_rate - low_rate) / 4.0,
        (3.0 * (high - low) - low_rate - high_rate) / 4.0,
        (2.0 * (low + high) + low_rate - high_rate) / 4.0,
    ]
    return PiecewisePolynomial(
        np.ascontiguousarray(x, dtype=np.float64), np.stack(coefficients, axis=-1)
    )


def extended(
    function: PiecewisePolynomial, range_: tuple[float, float], degree: int
) -> PiecewisePolynomial:
    """The same function over a range, beyond its breaks by its Taylor polynomials there.

    A polynomial of degree seven must not be used beyond its samples. Pieces outside the range are
    dropped: the fewer there are, the faster the rest is found.

    Args:
        function: to be used over the range.
        range_: where the result is used.
        degree: of the Taylor polynomials.
    """
    last = len(function.coefficients) - 1
    low, high = np.clip(np.searchsorted(function.breaks, range_, side="right") - 1, 0, last)
    breaks = function.breaks[low : high + 2]
    coefficients = function.coefficients[low : high + 1]
    order = coefficients.shape[2] - 1
    ends = ((0, range_[0] - breaks[0], -1.0), (-1, range_[1] - breaks[-1], 1.0))
    for piece, beyond, side in ends:
        if beyond * side <= 0.0:
            continue
        half, new_half = (np.diff(breaks)[piece] / 2.0, abs(beyond) / 2.0)
        new = np.zeros_like(coefficients[:1])
        for k, row in enumerate(coefficients[piece]):
            at_end = np.poly1d(row)(np.poly1d([1.0, side]))
            kept = np.zeros(order + 1)
            kept[: len(at_end.coeffs)] = at_end.coeffs[::-1]
            kept[degree + 1 :] = 0.0
            kept *= (new_half / half) ** np.arange(order + 1)
            moved = np.poly1d(kept[::-1])(np.poly1d([1.0, side])).coeffs
            new[0, k, order + 1 - len(moved) :] = moved
        if side < 0.0:
            breaks = np.concatenate([[range_[0]], breaks])
            coefficients = np.concatenate([new, coefficients])
        else:
            breaks = np.concatenate([breaks, [range_[1]]])
            coefficients = np.concatenate([coefficients, new])
    return PiecewisePolynomial(breaks, coefficients)


def lagrange(x: Array, values: Array) -> PiecewisePolynomial:
    """The interpolation by polynomials of degree seven over the eight samples around each interval.

    Args:
        x: (m,) positions of the samples, increasing, at least eight.
        values: (m, values).
    """

    def interpolated(at: Array) -> Array:
        first = np.clip(np.searchsorted(x, at) - LAGRANGE_NODES // 2, 0, len(x) - LAGRANGE_NODES)
        window = first[:, None] + np.arange(LAGRANGE_NODES)
        near = x[window]
        out = np.zeros((len(at), values.shape[1]))
        for i in range(LAGRANGE_NODES):
            others = np.delete(near, i, axis=1)
            weight = ((at[:, None] - others) / (near[:, i : i + 1] - others)).prod(axis=1)
            out += weight[:, None] * values[window[:, i]]
        return out

    return from_function(np.asarray(x, dtype=np.float64), interpolated, LAGRANGE_NODES - 1)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def piece_at(breaks: Array, x: float) -> tuple[int, float]:
    """Index of the piece that holds at x, and its variable there; fastest for pieces of equal width."""
    last = len(breaks) - 2
    piece = 0
    if x >= breaks[last]:
        piece = last
    elif x > breaks[0]:
        guess = (x - breaks[0]) / (breaks[last + 1] - breaks[0]) * (last + 1)
        piece = min(int(guess), last)
        while x < breaks[piece]:
            piece -= 1
        while x > breaks[piece + 1]:
            piece += 1
    low, high = breaks[piece], breaks[piece + 1]
    return piece, (2.0 * x - low - high) / (high - low)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def horner(coefficients: Array, piece: int, k: int, u: float) -> float:
    """Value k of a piece at its variable u."""
    value = coefficients[piece, k, 0]
    for j in range(1, coefficients.shape[2]):
        value = value * u + coefficients[piece, k, j]
    return value


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def horner_with_slope(coefficients: Array, piece: int, k: int, u: float) -> tuple[float, float]:
    """Value k of a piece at its variable u, and its derivative by u."""
    value, slope = coefficients[piece, k, 0], 0.0
    for j in range(1, coefficients.shape[2]):
        slope = slope * u + value
        value = value * u + coefficients[piece, k, j]
    return value, slope


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _evaluate(breaks: Array, coefficients: Array, x: Array) -> tuple[Array, Array]:
    """The function and its derivative (n, values) at positions (n,)."""
    values = np.empty((len(x), coefficients.shape[1]))
    rates = np.empty((len(x), coefficients.shape[1]))
    for i in range(len(x)):
        piece, u = piece_at(breaks, x[i])
        for k in range(coefficients.shape[1]):
            values[i, k], slope = horner_with_slope(coefficients, piece, k, u)
            rates[i, k] = slope * 2.0 / (breaks[piece + 1] - breaks[piece])
    return values, rates
