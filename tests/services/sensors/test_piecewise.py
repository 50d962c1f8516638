"""Piecewise polynomials reproduce the interpolations that they stand for."""

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator

from amers.services.sensors.piecewise import (
    extended,
    from_function,
    hermite,
    lagrange,
    linear,
    polynomial,
)

rounding = 1e-9


def test_lagrange_reproduces_a_polynomial_of_degree_seven_between_uneven_samples() -> None:
    rng = np.random.default_rng(3)
    x = np.cumsum(rng.uniform(0.5, 2.0, 20))
    powers = rng.normal(size=(8, 3))

    def truth(at: np.ndarray) -> np.ndarray:
        return np.stack([np.polyval(c, (at - 15.0) / 15.0) for c in powers.T], axis=-1)

    at = rng.uniform(x[0], x[-1], 200)
    np.testing.assert_allclose(lagrange(x, truth(x))(at), truth(at), atol=rounding)


def test_lagrange_uses_the_eight_samples_around_a_position() -> None:
    x = np.arange(30.0)
    values = np.random.default_rng(5).normal(size=(30, 1))
    found = lagrange(x, values)(np.array([12.3, 0.4, 28.9]))[:, 0]
    for value, at, first in zip(found, (12.3, 0.4, 28.9), (9, 0, 22), strict=True):
        window = slice(first, first + 8)
        expected = BarycentricInterpolator(x[window], values[window, 0])(at)
        assert value == pytest.approx(expected, abs=rounding)


def test_the_derivative_is_that_of_the_function() -> None:
    wave = from_function(np.linspace(0.0, 3.0, 13), lambda t: np.stack([np.sin(t), np.cos(t)], -1), 9)
    t = np.linspace(0.0, 3.0, 101)
    np.testing.assert_allclose(wave.derivative(t)[:, 0], np.cos(t), atol=rounding)
    np.testing.assert_allclose(wave.derivative(t)[:, 1], -np.sin(t), atol=rounding)


def test_every_position_finds_its_piece_where_the_breaks_are_uneven() -> None:
    breaks = np.concatenate([[0.0, 1e-3, 2e-3], np.linspace(1.0, 2.0, 5), [50.0]])
    identity = from_function(breaks, lambda t: t[:, None], 1)
    t = np.concatenate([breaks, [-1.0, 60.0], np.random.default_rng(1).uniform(0.0, 50.0, 300)])
    np.testing.assert_allclose(identity(t)[:, 0], t, atol=rounding)


def test_a_polynomial_of_samples_goes_on_by_its_value_and_rate_beyond_them() -> None:
    x = np.linspace(2.0, 4.0, 12)
    wave = lagrange(x, np.stack([np.sin(x), np.cos(x)], -1))
    longer = extended(wave, (0.0, 9.0), 1)
    np.testing.assert_allclose(longer(x), wave(x), atol=rounding)
    for end, beyond in ((2.0, -0.7), (4.0, 3.1)):
        line = wave(np.array([end])) + beyond * wave.derivative(np.array([end]))
        np.testing.assert_allclose(longer(np.array([end + beyond])), line, atol=rounding)
    part = extended(wave, (2.5, 3.5), 1)
    inside = np.linspace(2.5, 3.5, 30)
    np.testing.assert_array_equal(part(inside), wave(inside))
    assert part.breaks[0] <= 2.5 < part.breaks[1] < part.breaks[-2] < 3.5 <= part.breaks[-1]


def test_straight_lines_between_samples_and_one_polynomial_have_their_values() -> None:
    table = linear(np.array([1.0, 2.0, 5.0]), np.array([[0.0], [4.0], [1.0]]))
    np.testing.assert_allclose(
        table(np.array([0.0, 1.5, 4.0, 6.0]))[:, 0], [-4.0, 2.0, 2.0, 0.0], atol=rounding
    )
    parabola = polynomial(10.0, 2.0, np.array([[1.0, 0.5, 3.0]]))
    np.testing.assert_allclose(parabola(np.array([10.0, 12.0, 8.0]))[:, 0], [1.0, 4.5, 3.5])


def test_hermite_reproduces_a_cubic_from_its_values_and_rates() -> None:
    cubic = np.poly1d([0.3, -1.0, 2.0, 5.0])
    x = np.array([0.0, 1.0, 4.0, 4.5])
    t = np.linspace(-0.5, 5.0, 30)
    found = hermite(x, cubic(x)[:, None], cubic.deriv()(x)[:, None])
    np.testing.assert_allclose(found(t)[:, 0], cubic(t), atol=rounding)
