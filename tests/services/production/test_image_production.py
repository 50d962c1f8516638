"""Points produced from simulated views are correct up to one translation of the whole block."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.adjustment.intersection import Intersection
from amers.services.conventions import CHIP_CENTRE, CHIP_SIZE
from amers.services.errors import ComputationError, InputError, NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, render_chip
from amers.services.matching.multi_image import stored_chip
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.simulation.view import plan_geometry
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray
from tests.services.simulated import (
    BLOCK_SIGMA_M,
    OPTIONS,
    SHAPE,
    block_views,
    plan,
    production,
    production_with_work,
    truth_of,
    world,
)
from tests.services.ties import difference_m

pytestmark = pytest.mark.long

a_centimetre = 0.01
a_tenth_of_a_pixel = 0.1
refined_limit_px = 0.3
four_sigma = 4.0
normalised_limit = 1.5


@pytest.fixture(scope="module")
def made() -> Production:
    return production()


@pytest.fixture(scope="module")
def true_points(made: Production) -> Intersection:
    return truth_of(made, block_views())


def scenes() -> list[Scene]:
    return [view.as_scene(BLOCK_SIGMA_M) for view in block_views()]


def seen_by(made: Production, row: int) -> Array:
    """Images of the fine views of a point."""
    views = made.points.views
    mine = slice(*views.start[row : row + 2])
    return views.image[mine][views.gsd_m[mine] == OPTIONS.fine_gsd_m]


def test_points_differ_from_the_truth_by_one_translation(
    made: Production, true_points: Intersection
) -> None:
    error_m = difference_m(made.points.lon_lat_h, true_points.lon_lat_h)
    assert error_m.std(axis=0).max() < 2.0 * a_centimetre


def test_adjusted_models_agree_like_the_true_models(made: Production, true_points: Intersection) -> None:
    # The rays of the true sensors through the positions of the adjusted models intersect as well, but
    # for drifts that 50 points tell as precisely as stated: two of them over the image in each position.
    stated_px = np.sqrt(made.adjustment.accuracy.variance()).reshape(-1, 2, 3)[:, :, 1:]
    assert stated_px.max() < a_tenth_of_a_pixel / 2.0
    assert np.abs(true_points.residual_px).max() < a_tenth_of_a_pixel
    rms_px = np.sqrt((true_points.residual_px**2).mean())
    assert rms_px < normalised_limit * np.sqrt(2.0 / 3.0 * (stated_px**2).mean())


def test_the_translation_is_within_the_stated_accuracy_of_the_models(
    made: Production, true_points: Intersection
) -> None:
    shift_m = difference_m(made.points.lon_lat_h, true_points.lon_lat_h).mean(axis=0)
    sigma_m = BLOCK_SIGMA_M / np.sqrt(len(block_views()))
    assert np.abs(shift_m[:2]).max() < four_sigma * sigma_m
    assert np.hypot(*shift_m[:2]) > a_centimetre  # images alone cannot give the true frame


def test_images_agree_on_the_points_they_show(made: Production) -> None:
    assert made.relative_accuracy.refined_px < refined_limit_px
    assert made.relative_accuracy.after_px < refined_limit_px
    assert made.relative_accuracy.before_px > 3.0 * made.relative_accuracy.after_px
    assert made.relative_accuracy.tie_points > 500


def test_chips_of_a_point_show_the_same_ground_at_their_centres(made: Production) -> None:
    core = np.s_[CHIP_CENTRE - 25 : CHIP_CENTRE + 26, CHIP_CENTRE - 25 : CHIP_CENTRE + 26]
    alike = []
    for row in range(len(made.points)):
        assert (made.chips(row) > 0).all()
        fine = made.chips(row)[: len(seen_by(made, row))].astype(np.float64)
        alike += [np.corrcoef(fine[0][core].ravel(), other[core].ravel())[0, 1] for other in fine[1:]]
    assert np.median(alike) > 0.7
    assert np.mean(np.array(alike) > 0.5) > 0.9


def test_every_point_has_enough_views_and_one_per_image(made: Production) -> None:
    for row in range(len(made.points)):
        images = seen_by(made, row)
        assert len(images) >= OPTIONS.min_views
        assert len(set(images)) == len(images)


@pytest.mark.thorough
def test_points_near_the_border_of_an_image_have_enough_views() -> None:
    # The second adjustment moves points: chips at the border of an image are then no longer whole.
    many = ProductionOptions(
        fine_gsd_m=3.0,
        coarse_gsd_m=6.0,
        points=2000,
        candidates=2,
        min_views=len(block_views()),
        surface_pairs=0,
    )
    points = produce_points(scenes(), many).points
    counts = [
        len(set(points.views.image[slice(*points.views.start[row : row + 2])]))
        for row in range(len(points))
    ]
    assert len(points) > 300
    assert min(counts) == many.min_views


def test_chips_are_those_of_the_views(made: Production) -> None:
    views = made.points.views
    for row in range(0, len(made.points), 9):
        chips = made.chips(row)
        mine = np.arange(views.start[row], views.start[row + 1])
        assert chips.shape == (len(mine), CHIP_SIZE, CHIP_SIZE)
        assert chips.dtype == np.uint16
        for chip, view in zip(chips, mine, strict=True):
            image = views.image[view]
            rendered = render_chip(
                block_views()[image].image,
                made.adjustment.models[image],
                made.points.lon_lat_h[row],
                views.gsd_m[view],
            )
            # Interpolation overshoots beside dark pixels; 0 is nodata.
            np.testing.assert_array_equal(chip, np.maximum(np.rint(rendered), 1))


def test_only_nodata_is_stored_as_zero() -> None:
    pixels = np.array([[np.nan, -3.0, 0.2], [1.4, 4095.6, 1e6]], dtype=np.float32)
    np.testing.assert_array_equal(stored_chip(pixels), [[0, 1, 1], [1, 4096, 65535]])
    assert stored_chip(pixels).dtype == np.uint16


def test_the_finest_views_come_first_and_the_rows_of_chips_are_contiguous(made: Production) -> None:
    points = made.points
    for row in range(len(points)):
        gsd_m = points.views.gsd_m[slice(*points.views.start[row : row + 2])]
        assert (np.diff(gsd_m) >= 0.0).all()
        assert set(gsd_m) <= {OPTIONS.fine_gsd_m, OPTIONS.coarse_gsd_m}
    np.testing.assert_array_equal(points.chip_row, points.views.start[:-1])
    assert len(set(points.id)) == len(points)


def test_directions_of_views_are_those_of_their_planned_images(made: Production) -> None:
    views = made.points.views
    for image, view in enumerate(block_views()):
        mine = views.image == image
        planned = view.geometry.plan
        assert np.abs(views.incidence_deg[mine] - planned.incidence_deg).max() < 0.2
        turn = (views.azimuth_deg[mine] - planned.azimuth_deg + 180.0) % 360.0 - 180.0
        assert np.abs(turn * np.sin(np.radians(planned.incidence_deg))).max() < 0.2


def test_points_cover_the_ground_that_the_images_share(made: Production) -> None:
    seen = made.adjustment.models[0].project(made.points.lon_lat_h)
    margin_px = CHIP_CENTRE + 10.0
    cell = np.floor((seen - margin_px) / (np.array(SHAPE) - 2.0 * margin_px) * 4.0).astype(int)
    occupied = set(map(tuple, np.clip(cell, 0, 3)))
    assert len(occupied) >= 14
    assert 0.5 * OPTIONS.points <= len(made.points) <= 1.5 * OPTIONS.points


def test_points_are_as_salient_and_precise_as_the_options_require(made: Production) -> None:
    sigma_m = np.sqrt(np.diagonal(made.points.covariance_m2, 0, 1, 2))
    assert (made.points.saliency >= OPTIONS.min_saliency).all()
    assert sigma_m[:, :2].max() <= OPTIONS.max_sigma_m
    assert sigma_m[:, 2].max() <= OPTIONS.max_sigma_up_m
    assert (np.linalg.eigvalsh(made.points.covariance_m2) > 0.0).all()


def test_the_outline_contains_the_points(made: Production) -> None:
    low, high = made.outline.min(axis=0), made.outline.max(axis=0)
    assert ((made.points.lon_lat_h[:, :2] > low) & (made.points.lon_lat_h[:, :2] < high)).all()
    closed = np.vstack([made.outline, made.outline[:1]])
    area = (closed[:-1, 0] * closed[1:, 1] - closed[1:, 0] * closed[:-1, 1]).sum() / 2.0
    assert area > 0.0  # counter-clockwise


def test_a_single_image_and_two_images_of_one_name_are_refused() -> None:
    one, other = scenes()[:2]
    with pytest.raises(InputError, match="1 image given, at least 2 needed"):
        produce_points([one], OPTIONS)
    with pytest.raises(InputError, match="0 image"):
        produce_points([], OPTIONS)
    with pytest.raises(InputError, match="different names"):
        produce_points([one, replace(other, acquisition=one.acquisition)], OPTIONS)


def test_images_of_different_places_have_nothing_in_common() -> None:
    lon, lat = (float(v) for v in world().centre_lon_lat)
    away = plan_geometry(world(), plan("away", lon_lat=(lon + 0.1, lat)), np.random.default_rng(0))
    scene = scenes()[0]
    # The content is the same: only the model places it elsewhere.
    elsewhere = replace(scene, model=away.delivered, acquisition=away.acquisition)
    with pytest.raises(NotEnoughPoints):
        produce_points([scene, elsewhere], OPTIONS)


@dataclass(frozen=True)
class Emptied:
    """Pixels without any ground."""

    name: str
    pixels: Array


@pytest.mark.parametrize(
    "emptied",
    [
        Emptied("flat", np.full(SHAPE, 500.0)),
        Emptied("missing", np.full(SHAPE, np.nan)),
        Emptied("noise", np.random.default_rng(0).normal(1000.0, 100.0, SHAPE)),
    ],
    ids=lambda e: e.name,
)
def test_images_without_ground_give_no_points(emptied: Emptied) -> None:
    one, other = scenes()[:2]
    blank = replace(other, image=ArrayImage(emptied.pixels.astype(np.float32)))
    with pytest.raises(ComputationError):
        produce_points([one, blank], OPTIONS)


@pytest.mark.parametrize(
    ("missing", "said"), [(0, "salient points out of 6"), (1, "tie points whose chip")]
)
def test_as_many_tie_points_as_a_block_needs_are_tried_and_no_fewer(missing: int, said: str) -> None:
    """All ground but that of the points nearest to the middle gets none; no chip is salient enough."""

    def excluded(lon_lat: Array) -> BoolArray:
        nearest = np.argsort(np.hypot(*((lon_lat - world().centre_lon_lat) * [0.7, 1.0]).T))
        beside = np.ones(len(lon_lat), dtype=np.bool_)
        beside[nearest[: OPTIONS.block.min_points - missing]] = False
        return beside

    kept = production_with_work()[1].kept
    shown = {name: kept[name] for name in kept if name.startswith(("features/", "matches/"))}
    options = replace(OPTIONS, min_saliency=2.0)
    with pytest.raises(NotEnoughPoints, match=said):
        produce_points(scenes(), options, excluded=excluded, work=Work(kept=shown))


def test_progress_grows_from_0_to_1() -> None:
    fractions: list[float] = []
    few = ProductionOptions(fine_gsd_m=2.0, coarse_gsd_m=4.0, points=8, candidates=1)
    made = produce_points(scenes()[:2], few, lambda fraction, message: fractions.append(fraction))
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0
    assert (np.diff(fractions) >= -1e-9).all()
    assert len(made.points) >= 6
