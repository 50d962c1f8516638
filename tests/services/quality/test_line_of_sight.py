"""Chips of views from several sides imply the line of sight of a scene, beside that of its model."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.matching.chip_shears import ChipShears
from amers.services.quality.line_of_sight import MOST_CHANCE, ImpliedSight, implied_sight
from amers.services.types import Array

SIGMA = 0.004
"""Of a shear: some tenths of a pixel over a chip."""
VIEWS = np.array([[0.3, 0.0], [-0.25, 0.1], [0.05, 0.3], [0.0, -0.3]])
"""Leans of four views from all sides."""
SLOPE = 0.06
SEEN = np.array([0.1, -0.05])
"""Lean of the scene."""


def shears_of(
    seed: int, n: int = 60, views: Array = VIEWS, slope: float = SLOPE, seen: Array = SEEN
) -> ChipShears:
    """Shears of n points on slopes; views share most of their noise, and the scene has its own scale."""
    rng = np.random.default_rng(seed)
    k = len(views)
    slopes = slope * rng.standard_normal((n, 2))
    own_scale = 0.01 * rng.standard_normal((2, 2))
    gradient = np.einsum("ka,nj->nkaj", seen - views, slopes) + own_scale
    gradient += 0.9 * SIGMA * rng.standard_normal((n, 1, 2, 2))
    gradient += 0.44 * SIGMA * rng.standard_normal((n, k, 2, 2))
    return ChipShears(
        np.repeat(np.arange(n), k),
        np.tile(views, (n, 1)),
        gradient.reshape(-1, 2, 2),
        np.full(n * k, SIGMA),
    )


def by_model(lean: Array, shears: ChipShears) -> Array:
    return np.tile(lean, (len(shears.point), 1))


def turned(by_deg: float, towards_deg: float) -> Array:
    """The lean of a model whose lines of sight are about so far from those of the scene."""
    towards = np.radians(towards_deg)
    return SEEN + np.tan(np.radians(by_deg)) * np.array([np.sin(towards), np.cos(towards)])


def is_told(sight: ImpliedSight | None) -> bool:
    return sight is not None and sight.chance <= MOST_CHANCE


@pytest.mark.parametrize("towards_deg", [0.0, 110.0, 250.0])
@pytest.mark.parametrize("by_deg", [12.0, 20.0, 30.0])
def test_the_model_of_another_view_is_told_by_its_angle(by_deg: float, towards_deg: float) -> None:
    for seed in range(5):
        shears = shears_of(seed)
        sight = implied_sight(shears, by_model(turned(by_deg, towards_deg), shears))
        assert sight is not None
        assert sight.angle_deg == pytest.approx(by_deg, abs=3.0)
        assert 30 <= sight.points <= 60
        assert is_told(sight)


@pytest.mark.monte_carlo
def test_the_model_of_the_scene_is_not_accused() -> None:
    """On gentle and level ground, with few points and many."""
    chances, off = [], []
    for seed in range(200):
        for n, slope in ((15, SLOPE / 2), (60, SLOPE), (60, SLOPE / 2), (60, 0.0)):
            shears = shears_of(seed, n, slope=slope)
            sight = implied_sight(shears, by_model(SEEN, shears))
            assert not is_told(sight)
            if slope > 0.0 and sight:
                chances.append(sight.chance)
                off.append(sight.angle_deg)
    assert len(chances) > 500, "of 600 with slopes"
    assert np.quantile(chances, 0.01) > 0.005
    assert np.median(off) < 2.0


def test_what_is_seen_does_not_depend_on_the_scale_of_the_image_and_on_a_few_odd_chips() -> None:
    shears = shears_of(1)
    model = by_model(turned(15.0, 70.0), shears)
    expected = implied_sight(shears, model)
    scaled = replace(shears, gradient=shears.gradient + np.array([[0.005, -0.002], [0.004, -0.005]]))
    odd = shears.gradient.copy()
    odd[shears.point % 6 == 0] += 0.015
    assert expected is not None
    for other in (scaled, replace(shears, gradient=odd)):
        sight = implied_sight(other, model)
        assert sight is not None
        assert sight.angle_deg == pytest.approx(expected.angle_deg, abs=1.5)


def test_one_view_two_alike_and_few_points_tell_nothing() -> None:
    """One view leaves open whether a slope is steep or seen from the side."""
    alike = VIEWS[:1] + np.array([[0.0, 0.0], [0.03, -0.02]])
    for shears in (shears_of(2, views=VIEWS[:1]), shears_of(2, views=alike), shears_of(2, n=11)):
        assert implied_sight(shears, by_model(turned(25.0, 30.0), shears)) is None
    nothing = shears_of(2).take(np.zeros(0, dtype=np.int64))
    assert implied_sight(nothing, by_model(SEEN, nothing)) is None


def test_steep_slopes_whose_shears_fall_short_tell_nothing() -> None:
    """Views that see a slope most differently are sheared by less than they should be."""
    shears = shears_of(4, n=200, slope=0.3)
    size = np.linalg.norm(shears.gradient, axis=(1, 2))[:, None, None]
    short = replace(shears, gradient=shears.gradient / (1.0 + size / 0.15))
    sight = implied_sight(short, by_model(SEEN, short))
    assert not is_told(sight)
    assert sight is None or sight.points < 50


def test_an_angle_of_a_few_degrees_is_no_other_view() -> None:
    shears = shears_of(3, n=400)
    sight = implied_sight(shears, by_model(turned(3.0, 200.0), shears))
    assert sight is not None
    assert sight.angle_deg == pytest.approx(3.0, abs=1.0)
    assert not is_told(sight)
