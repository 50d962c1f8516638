"""Piecewise polynomials: the common form of orbits, attitudes, look angles and line times.

Each interpolation of a sensor model (Lagrange, Hermite, linear tables, polynomials) becomes polynomials
between breaks, so that one kernel evaluates them all.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from amers.services.types import Array

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
        return self._both(x)[0]

    def derivative(self, x: Array) -> Array:
        """Derivatives (n, values) at positions (n,)."""
        return self._both(x)[1]

    def _both(self, x: Array) -> tuple[Array, Array]:
        table, (place,) = tabulate([self])
        return _evaluate(table, place, np.ascontiguousarray(x, dtype=np.float64))


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


class Pieces(NamedTuple):
    """Where a piecewise polynomial lies in a table: its breaks, then its coefficients.

    Kernels get one table and numbers: each array in a tuple would cost more than a polynomial.

    Attributes:
        first: index of the first break.
        pieces: number of polynomials.
        values: values of each.
        terms: coefficients of each value.
    """

    first: int
    pieces: int
    values: int
    terms: int


def tabulate(functions: list[PiecewisePolynomial]) -> tuple[Array, list[Pieces]]:
    """One table (n,) of piecewise polynomials, and where each of them lies in it."""
    parts, places, first = [], [], 0
    for function in functions:
        places.append(Pieces(first, *function.coefficients.shape))
        parts += [function.breaks, function.coefficients.ravel()]
        first += len(parts[-2]) + len(parts[-1])
    return np.concatenate(parts), places


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def piece_at(table: Array, p: Pieces, x: float) -> tuple[int, float]:
    """Index of the piece that holds at x, and its variable there; fastest for pieces of equal width."""
    start, end = p.first, p.first + p.pieces
    at = start
    if x >= table[end - 1]:
        at = end - 1
    elif x > table[start]:
        at += min(int((x - table[start]) / (table[end] - table[start]) * p.pieces), p.pieces - 1)
        while x < table[at]:
            at -= 1
        while x > table[at + 1]:
            at += 1
    low, high = table[at], table[at + 1]
    return at - start, (2.0 * x - low - high) / (high - low)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def half_width(table: Array, p: Pieces, piece: int) -> float:
    """Half the width of a piece."""
    return (table[p.first + piece + 1] - table[p.first + piece]) / 2.0


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def horner(table: Array, p: Pieces, piece: int, k: int, u: float) -> float:
    """Value k of a piece at its variable u."""
    at = p.first + p.pieces + 1 + (piece * p.values + k) * p.terms
    value = table[at]
    for j in range(at + 1, at + p.terms):
        value = value * u + table[j]
    return value


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def horner_with_slope(table: Array, p: Pieces, piece: int, k: int, u: float) -> tuple[float, float]:
    """Value k of a piece at its variable u, and its derivative by u."""
    at = p.first + p.pieces + 1 + (piece * p.values + k) * p.terms
    value, slope = table[at], 0.0
    for j in range(at + 1, at + p.terms):
        slope = slope * u + value
        value = value * u + table[j]
    return value, slope


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _evaluate(table: Array, p: Pieces, x: Array) -> tuple[Array, Array]:
    """The function and its derivative (n, values) at positions (n,)."""
    values, rates = np.empty((len(x), p.values)), np.empty((len(x), p.values))
    for i in range(len(x)):
        piece, u = piece_at(table, p, x[i])
        for k in range(p.values):
            values[i, k], slope = horner_with_slope(table, p, piece, k, u)
            rates[i, k] = slope / half_width(table, p, piece)
    return values, rates
