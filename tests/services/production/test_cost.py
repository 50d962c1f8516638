"""The cost of a production that is stated before it is made."""

from dataclasses import replace

import pytest

from amers.services.production.block_plan import PlannedImage
from amers.services.production.cost import ProductionCost, production_cost

IMAGE = PlannedImage("one", (5.0, 45.0), (60_000.0, 60_000.0), 1.5, 15.0, 280.0, 5.0)


def cost(side_km: float, count: int = 12, spacing_m: float = 1414.0) -> ProductionCost:
    side_m = side_km * 1000.0
    images = [replace(IMAGE, name=str(k), size_m=(side_m, side_m)) for k in range(count)]
    return production_cost(images, side_km**2, spacing_m)


def test_features_grow_with_the_points_and_not_with_the_pixels() -> None:
    small, large = cost(15.0, spacing_m=1500.0), cost(60.0, spacing_m=6000.0)
    assert large.points == small.points == 100
    assert large.core_s == pytest.approx(small.core_s)


def test_a_point_for_two_square_kilometres_costs_what_was_measured() -> None:
    whole = cost(60.0)
    assert whole.points == pytest.approx(1800, rel=0.01)
    assert 5.0 < whole.core_s["features"] / 12 < 30.0
    # 1.6 billion pixels an image, of which at most a third is read.
    assert whole.read_bytes < 12 * 1.6e9 * 2 / 3
    assert "core-hours" in whole.words


@pytest.mark.parametrize(("count", "expected_mib"), [(2_000, 569), (20_000, 2_700)])
def test_a_large_block_needs_the_memory_that_was_measured(count: int, expected_mib: float) -> None:
    """Those blocks were measured without the points of a production, which are few here."""
    stated = cost(60.0, count, spacing_m=20_000.0)
    assert stated.block_mib == pytest.approx(expected_mib, rel=0.15)
    assert ("assembles the adjustment" in stated.words) == (count > 5_000)
