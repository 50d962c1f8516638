"""What a block shall reach is met or missed where that is shown, and not shown otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.formats.block.document import rectangle
from amers.services.quality.accuracy import Quantile, accuracy
from amers.services.quality.block import (
    block_accuracy,
    block_quality,
    parse_quality_document,
    quality_document,
)
from amers.services.quality.block_cells import BlockCells
from amers.services.quality.block_heights import HeightModel, height_errors, height_quality
from amers.services.quality.block_requirements import (
    BlockCriterion,
    BlockRequirements,
    block_criteria,
    block_verdict,
    outcome_of,
)
from amers.services.quality.density import DensityCells
from amers.services.quality.normal_law import CIRCULAR_CE90, LINEAR_LE90
from amers.services.quality.planimetry import PlanimetricQuality
from amers.services.types import Frame
from tests.factories import control_points
from tests.services.quality.test_block_heights import sloping_terrain
from tests.services.quality.test_planimetric_figures import at_site, quality

BOX = (5.0, 43.0, 5.2, 43.1)


def quantile(lower: float, upper: float, n: int = 100) -> Quantile:
    return Quantile((lower + upper) / 2.0, lower, upper, n, 0.9, 0.9, "")


def cells(area_km2: list[float], points: list[int], short: list[int] | None = None) -> BlockCells:
    """Cells of a block with so much ground and so many points, of which some have too few images."""
    n = len(area_km2)
    density = DensityCells(np.zeros((n, 2)), np.array(area_km2), np.array(points, dtype=np.int64))
    fewer = np.array(short or [0] * n, dtype=np.int64)
    return BlockCells(density, np.zeros(n), np.ones(n), fewer, np.zeros(n))


PLENTY = cells([10.0], [100])


def judged(
    requirements: BlockRequirements,
    of: BlockCells = PLENTY,
    planimetry: tuple[PlanimetricQuality, ...] = (),
    fewest: int = 3,
) -> dict[str, BlockCriterion]:
    return {one.name: one for one in block_criteria(requirements, of, fewest, None, planimetry)}


def test_a_limit_is_met_or_missed_where_the_whole_interval_lies_on_one_side() -> None:
    assert outcome_of(quantile(1.0, 2.0), 2.0) == "met"
    assert outcome_of(quantile(1.0, 2.0), 1.9) == "not shown"
    assert outcome_of(quantile(1.0, 2.0), 1.0) == "not shown"
    assert outcome_of(quantile(1.0, 2.0), 0.9) == "missed"
    assert outcome_of(quantile(1.0, np.nan), 5.0) == "not shown"
    assert outcome_of(quantile(1.0, 2.0, n=30), 2.0) == "met"
    assert outcome_of(quantile(1.0, 2.0, n=29), 2.0) == "not shown"
    assert outcome_of(quantile(1.0, 2.0, n=29), 0.1) == "not shown"
    assert outcome_of(None, 100.0) == "not shown"


def test_ground_counts_by_its_area_where_it_has_as_many_whole_points_as_it_needs() -> None:
    """Two points a square kilometre: 20 of 10 km2, 3 of 1.9 km2, none of a sliver."""
    some = cells([10.0, 1.9, 0.4], [20, 2, 0])
    share = 10.4 / 12.3
    for least, outcome in ((share - 0.01, "met"), (share + 0.01, "missed")):
        requirements = BlockRequirements(points_per_km2=2.0, min_share=least)
        density = judged(requirements, some)["density"]
        assert density.outcome == outcome
        assert density.value == pytest.approx(100.0 * share)
        assert density.limit == pytest.approx(100.0 * least)
        assert density.note == "1 of 3 cells lack 1 points"


@pytest.mark.parametrize(("fewest", "outcome"), [(1, "missed"), (2, "met"), (3, "met")])
def test_every_point_is_shown_by_as_many_images_as_are_required(fewest: int, outcome: str) -> None:
    of = cells([1.0, 1.0], [5, 5], [2, 1] if fewest < 2 else [0, 0])
    views = judged(BlockRequirements(min_views=2), of, fewest=fewest)["images_per_point"]
    assert (views.outcome, views.value, views.limit) == (outcome, fewest, 2.0)
    assert views.note == ("3 points have fewer" if fewest < 2 else "")


def test_check_only_sites_judge_a_block_and_control_sites_alone_do_not_show_that_it_is_met() -> None:
    rng = np.random.default_rng(61)
    sites = [
        at_site(f"{name}{k}", rng.normal(0.0, sigma_m, (40, 2)), control=name == "control")
        for name, sigma_m in (("control", 0.2), ("check", 2.0))
        for k in range(8)
    ]
    known, new = sites[:8], sites[8:]
    requirements = BlockRequirements(ce90_m=1.0)
    cases = (((*known, *new), "missed", new), (new, "missed", new), (known, "not shown", known))
    for given, outcome, counted in cases:
        criterion = judged(requirements, planimetry=(quality(*given),))["ce90_m"]
        found = accuracy(np.concatenate([one.error_m for one in counted]))
        assert criterion.outcome == outcome
        assert criterion.value == pytest.approx(found.ce90_m.value)
    for limit_m, given, outcome in ((0.1, known, "missed"), (8.0, new, "met")):
        required = BlockRequirements(ce90_m=limit_m)
        assert judged(required, planimetry=(quality(*given),))["ce90_m"].outcome == outcome


def test_heights_are_judged_on_the_earth_with_the_error_that_all_points_share() -> None:
    rng, terrain = np.random.default_rng(62), sloping_terrain()
    points = control_points(400, rng, (5.0, 43.0, 5.9, 43.9))
    lon_lat_h = points.lon_lat_h.copy()
    lon_lat_h[:, 2] = terrain.height_m(lon_lat_h) + 5.0 + rng.normal(0.0, 0.1, 400)
    points = replace(points, lon_lat_h=lon_lat_h)
    model = HeightModel(replace(terrain, sigmas=0.1))
    heights = height_quality(height_errors(points, model), points, model, "flat")
    for limit_m, outcome in ((1.0, "missed"), (6.0, "met")):
        criteria = block_criteria(BlockRequirements(le90_m=limit_m), PLENTY, 3, heights, ())
        (criterion,) = [one for one in criteria if one.name == "le90_m"]
        assert (criterion.outcome, criterion.note) == (outcome, "")
        assert criterion.value == pytest.approx(5.13, abs=0.05)


def test_what_was_not_measured_is_not_shown_and_says_what_is_missing() -> None:
    criteria = judged(BlockRequirements(ce90_m=1.0, le90_m=1.0))
    for name, option in (("ce90_m", "--site"), ("le90_m", "--dem")):
        assert criteria[name].outcome == "not shown"
        assert criteria[name].unit == "m"
        assert np.isnan(criteria[name].value)
        assert option in criteria[name].note


def test_the_verdict_is_the_worst_outcome() -> None:
    required = BlockRequirements(points_per_km2=1.0)
    met, missed = judged(required)["density"], judged(required, cells([9.0], [1]))["density"]
    open_ = judged(BlockRequirements(ce90_m=1.0))["ce90_m"]
    assert block_verdict([met], required) == "met"
    assert block_verdict([met, open_], required) == "not shown"
    assert block_verdict([open_, missed, met], required) == "missed"
    views = judged(BlockRequirements())["images_per_point"]
    assert block_verdict([views], BlockRequirements()) == "not specified"


def test_the_figures_of_a_block_are_those_of_its_median_point_and_survive_a_document() -> None:
    points = control_points(301, np.random.default_rng(63), BOX)
    sigma_m = 1.25 * np.geomspace(0.5, 2.0, 301)
    covariance_m2 = sigma_m[:, None, None] ** 2 * np.diag([1.0, 1.0, 4.0])
    points = replace(points, covariance_m2=covariance_m2)
    figures = block_quality(points, np.full(301, 3), rectangle(*BOX))
    assert figures.sigma_horizontal_m.median == pytest.approx(1.25)
    assert figures.sigma_up_m.median == pytest.approx(2.5)
    assert figures.sigma_up_m.p90 == pytest.approx(2.5 * 0.5 * 4.0**0.9)
    assert figures.points_per_km2 == pytest.approx(301 / (16.27 * 11.11), rel=0.01)
    statement = block_accuracy(figures, Frame.from_sigmas(3.0, 6.0))
    relative, earth = statement.relative_to_control_points, statement.on_the_earth
    assert relative.ce90_m == pytest.approx(CIRCULAR_CE90 * 1.25, rel=1e-3)
    assert relative.le90_m == pytest.approx(LINEAR_LE90 * 2.5, rel=1e-3)
    assert earth.ce90_m == pytest.approx(CIRCULAR_CE90 * 3.25, rel=1e-3)
    assert earth.le90_m == pytest.approx(LINEAR_LE90 * 6.5, rel=1e-3)
    again = parse_quality_document(quality_document(figures))
    assert quality_document(again) == quality_document(figures)
