"""A plan predicts what the adjustment declares, and proposes the site that helps most."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.errors import DisconnectedBlock, InputError
from amers.services.production.block_plan import (
    BlockPlan,
    PlanGeometry,
    PlannedHeights,
    PlannedImage,
    PlannedSite,
    SiteSigmas,
    observed_and_known,
    plan_geometry,
)
from amers.services.production.planning import block_of, forecast
from amers.services.quality.normal_law import LINEAR_LE90, normal_ce90
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Array

MIDDLE = (5.4, 43.3)
EAST_DEG = 0.0616
"""Five kilometres."""


def strip(count: int = 5) -> tuple[PlannedImage, ...]:
    """Images of 10 km in a row, each over half of the next, from both sides in turn."""
    return tuple(
        PlannedImage(
            name=f"image {k + 1}",
            lon_lat=(MIDDLE[0] + k * EAST_DEG, MIDDLE[1]),
            size_m=(10_000.0, 10_000.0),
            gsd_m=2.0,
            incidence_deg=15.0,
            azimuth_deg=100.0 if k % 2 else 280.0,
            sigma_m=6.0,
        )
        for k in range(count)
    )


def sites(count: int = 5) -> tuple[PlannedSite, ...]:
    """One under the middle of every image."""
    return tuple(
        PlannedSite(f"site {k + 1}", (MIDDLE[0] + k * EAST_DEG, MIDDLE[1] + 0.005)) for k in range(count)
    )


PLAN = BlockPlan(strip(), spacing_m=600.0, sites=sites()[:1], candidates=sites()[1:])
MIXED = replace(
    PLAN,
    images=(
        *strip(3)[:2],
        replace(
            strip(3)[2],
            size_m=(30_000.0, 30_000.0),
            gsd_m=10.0,
            incidence_deg=8.0,
            is_ortho=True,
        ),
    ),
    spacing_m=1200.0,
    heights=PlannedHeights(sigma_m=2.0, frame_sigma_m=1.5),
    candidates=(),
)


def simulated(plan: BlockPlan, geometry: PlanGeometry, known: list[int], seed: int) -> BlockAdjustment:
    """The adjustment of the plan with errors as large as it states."""
    rng = np.random.default_rng(seed)
    observations, control = observed_and_known(plan, geometry, known)
    line_sample = observations.line_sample.copy()
    for number, image in enumerate(geometry.images):
        rows = observations.image == number
        off = image.corrected(rng.normal(0.0, image.sigma))
        assert isinstance(off, CorrectedModel)
        line_sample[rows] = off.correction.apply(line_sample[rows])
    line_sample += rng.normal(0.0, observations.sigma_px[:, None], line_sample.shape)
    measured = replace(observations, line_sample=line_sample)
    return adjust_block(geometry.images, measured, control=control, passes=geometry.pass_members)


def earth_sigmas_m(relative_m2: Array, frame_m2: Array) -> Array:
    return np.asarray(np.sqrt(np.diagonal(relative_m2 + frame_m2, 0, 1, 2)))


@pytest.mark.parametrize("plan", [PLAN, MIXED], ids=["stereo", "with an ortho-image"])
@pytest.mark.thorough
def test_the_prediction_is_what_the_adjustment_declares(plan: BlockPlan) -> None:
    geometry = plan_geometry(plan)
    predicted = block_of(plan, geometry, [0])
    ratios = []
    for seed in range(4):
        block = simulated(plan, geometry, [0], seed)
        rows = np.flatnonzero(np.isfinite(block.lon_lat_h[:, 0]))
        declared = earth_sigmas_m(block.point_covariance_m2[rows], block.frames[0].covariance_m2)
        frames_m2 = predicted.frames[0].covariance_m2
        ratios.append(earth_sigmas_m(predicted.point_covariance_m2[rows], frames_m2) / declared)
    middle = np.median(np.concatenate(ratios), axis=0)
    np.testing.assert_allclose(middle, 1.0, atol=0.1)
    assert np.quantile(np.abs(np.mean([np.median(r, axis=0) for r in ratios], axis=0) - 1.0), 1.0) < 0.1


@pytest.mark.thorough
def test_the_proposed_site_is_the_best_of_all_in_the_adjustment() -> None:
    geometry = plan_geometry(PLAN)
    found = forecast(PLAN)
    ground = np.flatnonzero(geometry.site < 0)
    means_m = []
    for candidate in range(len(PLAN.candidates)):
        of_seeds = []
        for seed in range(3):
            block = simulated(PLAN, geometry, [0, 1 + candidate], seed)
            earth_m2 = block.point_covariance_m2[ground[ground < len(block.lon_lat_h)]]
            earth_m2 = earth_m2[:, :2, :2] + block.frames[0].covariance_m2[:2, :2]
            of_seeds.append(np.nanmean(normal_ce90(earth_m2)))
        means_m.append(np.mean(of_seeds))
    (proposal,) = found.proposed
    assert proposal.site == PLAN.candidates[int(np.argmin(means_m))]
    assert int(np.nanargmax(proposal.gain_m)) == int(np.argmin(means_m))
    np.testing.assert_allclose(proposal.on_the_earth.ce90_m, min(means_m), rtol=0.1)
    assert proposal.on_the_earth.ce90_m < found.on_the_earth.ce90_m


def test_the_accuracy_of_a_plan_and_of_each_image_is_that_of_its_places() -> None:
    """On the Earth with the frame of the block; of several places the means, and the largest."""
    plan = replace(PLAN, candidates=(), spacing_m=2000.0)
    geometry, found = plan_geometry(plan), forecast(plan)
    block = block_of(plan, geometry, [0])
    ground = np.flatnonzero((geometry.site < 0) & (block.group >= 0))
    relative_m2 = block.point_covariance_m2
    earth_m2 = relative_m2 + block.frames[0].covariance_m2
    np.testing.assert_allclose(found.ce90_m, normal_ce90(earth_m2[ground, :2, :2]))
    np.testing.assert_allclose(found.le90_m, LINEAR_LE90 * np.sqrt(earth_m2[ground, 2, 2]))
    stated = [(found.relative, found.on_the_earth, ground)]
    for number, image in enumerate(found.images):
        own = geometry.observations.point[geometry.observations.image == number]
        stated.append((image.relative, image.on_the_earth, np.intersect1d(own, ground)))
        assert image.points == len(stated[-1][2]) < len(ground)
    for relative, earth, rows in stated:
        for accuracy, all_m2 in ((relative, relative_m2[rows]), (earth, earth_m2[rows])):
            ce90_m, le90_m = normal_ce90(all_m2[:, :2, :2]), LINEAR_LE90 * np.sqrt(all_m2[:, 2, 2])
            assert accuracy.ce90_m == pytest.approx(ce90_m.mean())
            assert accuracy.le90_m == pytest.approx(le90_m.mean())
            assert accuracy.worst_ce90_m == pytest.approx(ce90_m.max())
            assert accuracy.worst_le90_m == pytest.approx(le90_m.max())


def test_a_place_that_one_image_shows_is_not_determined_by_a_known_height() -> None:
    geometry = plan_geometry(MIXED)
    block = block_of(MIXED, geometry, [0])
    rays = np.bincount(geometry.observations.point, minlength=len(geometry.lon_lat_h))
    alone = (rays == 1) & (geometry.site < 0)
    assert alone.sum() > 20
    assert (block.group[alone] == -1).all()
    assert np.isnan(block.point_covariance_m2[alone]).all()
    assert (block.group[(rays > 1) & (geometry.site < 0)] == 0).all()


def test_a_larger_base_gives_better_heights_and_more_points_a_better_shape() -> None:
    steep = replace(PLAN, candidates=())
    slanted = tuple(replace(image, incidence_deg=30.0) for image in strip())
    dense = replace(steep, spacing_m=250.0)
    plain, wide, many = (forecast(plan) for plan in (steep, replace(steep, images=slanted), dense))
    assert wide.relative.le90_m < 0.7 * plain.relative.le90_m
    assert many.relative.ce90_m < plain.relative.ce90_m


def test_sites_that_no_image_shows_are_not_proposed() -> None:
    nowhere = PlannedSite("nowhere", (MIDDLE[0] - 1.0, MIDDLE[1]))
    found = forecast(replace(PLAN, candidates=(nowhere, PLAN.candidates[0])))
    assert found.proposed[0].site == PLAN.candidates[0]
    assert np.isnan(found.proposed[0].gain_m[0])


def test_what_cannot_be_computed_is_refused() -> None:
    with pytest.raises(InputError, match="1 images"):
        forecast(replace(PLAN, images=strip(1)))
    with pytest.raises(InputError, match="state another `spacing_m`"):
        forecast(replace(PLAN, spacing_m=20_000.0))
    apart = (*strip(2), *(replace(one, name=f"far {one.name}", lon_lat=(7.0, 43.3)) for one in strip(2)))
    with pytest.raises(DisconnectedBlock, match="far image 1, far image 2"):
        forecast(replace(PLAN, images=apart, spacing_m=1000.0, candidates=()))


def test_a_plan_without_sites_lies_as_its_models_do_whatever_their_pixels() -> None:
    """Stated in metres: the frame of five images is between one of them and their mean."""
    sigmas_m = []
    for gsd_m in (2.0, 5.0):
        images = tuple(replace(image, gsd_m=gsd_m, slope=1e-6) for image in strip())
        plan = replace(PLAN, images=images, sites=(), candidates=(), spacing_m=2000.0)
        frame = block_of(plan, plan_geometry(plan), []).frames[0]
        sigmas_m.append(frame.sigma_m)
        assert 0.8 * 6.0 / np.sqrt(5.0) < frame.sigma_m < 6.0
    assert sigmas_m[0] == pytest.approx(sigmas_m[1], rel=0.1)


def test_relief_of_a_planned_ortho_image_leans_away_from_its_satellite() -> None:
    """Ground a hundred metres above its terrain, seen from 280 degrees at 8 degrees: to the east."""
    geometry = plan_geometry(MIXED)
    model, (lon, lat) = geometry.images[2].model, MIXED.images[2].lon_lat
    low, high = model.project(np.array([[lon, lat, 0.0], [lon, lat, 100.0]]))
    lean_m = (high - low)[::-1] * [10.0, -10.0]
    towards = np.radians(MIXED.images[2].azimuth_deg)
    expected_m = -100.0 * np.tan(np.radians(8.0)) * np.array([np.sin(towards), np.cos(towards)])
    np.testing.assert_allclose(lean_m, expected_m, atol=1.0)


def test_a_loosely_known_site_counts_by_the_squares_of_its_sigmas() -> None:
    """Five points of 4 m, and models of 6 m each, tell of the frame what both know."""
    loose = SiteSigmas(points=5, sigma_m=(4.0, 4.0), frame_sigma_m=(0.1, 0.1))
    images = tuple(replace(image, slope=1e-6) for image in strip())
    plan = replace(PLAN, images=images, sites=(replace(sites()[2], sigmas=loose),), candidates=())
    plan = replace(plan, spacing_m=2000.0)
    geometry = plan_geometry(plan)
    free, held = (block_of(plan, geometry, known).frames[0].sigma_m for known in ([], [0]))
    of_site_m2 = 4.0**2 / 5.0 + 0.1**2
    assert held == pytest.approx((free**-2.0 + 1.0 / of_site_m2) ** -0.5, rel=0.25)


def test_heights_of_a_model_are_those_of_the_points_where_rays_tell_less() -> None:
    heights = PlannedHeights(sigma_m=0.2, frame_sigma_m=0.01)
    plan = replace(PLAN, heights=heights, candidates=(), spacing_m=2000.0)
    geometry = plan_geometry(plan)
    block = block_of(plan, geometry, [0])
    known = np.isin(np.arange(len(geometry.site)), geometry.observations.point) & (block.group >= 0)
    up_m = np.sqrt(block.point_covariance_m2[known, 2, 2])
    assert 0.19 < np.median(up_m) < 0.3


def test_a_second_site_gains_what_it_adds_to_the_first() -> None:
    plan = replace(PLAN, images=strip(3), candidates=sites()[1:3], added=2, spacing_m=2000.0)
    first, second = forecast(plan).proposed
    assert first.site != second.site
    gained_m = first.on_the_earth.ce90_m - second.on_the_earth.ce90_m
    assert np.nanmax(second.gain_m) == pytest.approx(gained_m)
    assert 0.0 < gained_m < np.nanmax(first.gain_m)


def test_the_order_of_images_and_groups_changes_nothing() -> None:
    """Each image measures as well as it states, and each group lies as its own site does."""
    away, sigmas_px = 4 * EAST_DEG, (0.1, 0.2, 0.5, 1.0)
    images = tuple(
        replace(one, name=f"image {k}", lon_lat=(one.lon_lat[0] + far * away, MIDDLE[1]), sigma_px=px)
        for k, (far, one, px) in enumerate(zip((0, 0, 1, 1), strip(2) * 2, sigmas_px, strict=True))
    )
    loose = SiteSigmas(frame_sigma_m=(5.0, 5.0))
    known = sites()[0], replace(sites()[4], sigmas=loose)
    plan = BlockPlan(images, spacing_m=1500.0, sites=known)
    found, turned = forecast(plan), forecast(replace(plan, images=images[::-1]))
    np.testing.assert_allclose(turned.ce90_m, found.ce90_m, rtol=1e-6)
    np.testing.assert_allclose(turned.le90_m, found.le90_m, rtol=1e-6)
    for one, same in zip(found.images, turned.images[::-1], strict=True):
        assert one.name == same.name
        assert one.relative.ce90_m == pytest.approx(same.relative.ce90_m)
        assert one.on_the_earth.le90_m == pytest.approx(same.on_the_earth.le90_m)
