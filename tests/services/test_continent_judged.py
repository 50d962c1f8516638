"""What judges a block on a simulated continent finds the errors that were put in."""

import json
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from amers.services.formats.block.check import check_block
from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import box_around, move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.correlate import CorrelationOptions, find_chip
from amers.services.quality.normal_law import normal_ce90
from amers.services.simulation.land import WATER
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.types import Array, ControlPoints, Frame
from benchmarks._continent import Continent
from benchmarks._continent_control import DEM_SIGMA_M, FRAME_SIGMA_M, POINT_SIGMA_M
from benchmarks._continent_judged import (
    LaterScene,
    counts,
    judge_density,
    never_found,
    register_later,
    textured_cells,
)
from benchmarks._continent_points import (
    PointVerdict,
    TruePlaces,
    common_error_m,
    errors_m,
    judge_points,
    true_places,
)
from benchmarks._simulated import lay_points

pytestmark = [pytest.mark.long, pytest.mark.endurance]

FRAME_M = np.array([1.6, -1.1, 2.3])
FRAME = Frame.from_sigmas(1.5, 2.5)
OWN_SIGMA_M = np.array([0.7, 0.7, 1.1])
a_tenth_of_a_pixel_m = 0.3
jitter_moves_a_point_by_m = 0.4
content_has_no_sharper_height_m = 0.8


@dataclass(frozen=True)
class Judged:
    """A block made by hand, and what is found about it."""

    points: ControlPoints
    chips: FolderChips
    put_in_m: Array
    places: TruePlaces
    verdict: PointVerdict
    later: list[LaterScene]
    swapped: Array


@pytest.fixture(scope="module")
def by_hand(small_continent: Continent, tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """Points measured with true models in clear images, and moved by known errors.

    A tenth of them has the chips of other points.
    """
    continent, rng = small_continent, np.random.default_rng(7)
    clear = sorted(continent.views.values(), key=lambda view: view.conditions.cloud_cover)[:4]
    scenes = []
    for view in clear:
        image = read_scene(continent.folder / "archive" / "images" / f"{view.name}.tif").image
        geometry = continent.geometry(view)
        scenes.append(Scene(image, geometry.rpc, geometry.acquisition, 0.0))
    step = np.linspace(-0.3, 0.3, 9)
    offset = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    world = continent.world
    lon_lat = world.centre_lon_lat + offset * len(world.albedo) * world.step_deg
    true, cut = lay_points(world, scenes, lon_lat, (2.5,))
    own_m = rng.normal(0.0, OWN_SIGMA_M, (len(true), 3))
    points = replace(
        true,
        lon_lat_h=move_metres(true.lon_lat_h, FRAME_M + own_m),
        covariance_m2=np.tile(np.diag(OWN_SIGMA_M**2), (len(true), 1, 1)),
        frames=(FRAME,),
    )
    swapped = rng.permutation(len(true))[: max(3, len(true) // 10)]
    source = np.arange(len(true))
    source[swapped] = np.roll(swapped, 1)
    folder = tmp_path_factory.mktemp("by_hand") / "block"
    metadata = BlockMetadata(
        id="by-hand",
        version="1",
        title="Points with known errors",
        description="",
        license="",
        extent=box_around(points.lon_lat_h),
        created=datetime(2024, 2, 1, tzinfo=UTC),
        specification=BlockSpecification((2.5,), 4),
        provenance=Provenance("tests", "1", (), {}),
        frame=FRAME,
    )
    order = write_block(folder, metadata, points, lambda row: cut(int(source[row])), {})
    block, chips = read_block(folder).points, FolderChips(folder)
    places = true_places(continent, block, chips)
    later = register_later(continent, block, chips, places.lon_lat_h, FRAME_M)
    return Judged(
        block,
        chips,
        (FRAME_M + own_m)[order],
        places,
        judge_points(block, places),
        later,
        np.isin(order, swapped),
    )


def test_the_errors_of_points_are_those_put_in(by_hand: Judged) -> None:
    known = np.isfinite(by_hand.places.lon_lat_h[:, 0])
    assert known[~by_hand.swapped].mean() > 0.9
    off_m = (errors_m(by_hand.points, by_hand.places) - by_hand.put_in_m)[known & ~by_hand.swapped]
    assert np.abs(np.median(off_m[:, :2], axis=0)).max() < a_tenth_of_a_pixel_m
    assert np.hypot(*off_m[:, :2].T).max() < 2.0 * jitter_moves_a_point_by_m
    assert abs(np.median(off_m[:, 2])) < content_has_no_sharper_height_m
    assert np.percentile(np.abs(off_m[:, 2]), 90) < 2.5 * content_has_no_sharper_height_m


def test_chips_of_other_places_have_no_true_place(by_hand: Judged) -> None:
    assert by_hand.swapped.sum() >= 3
    assert np.isnan(by_hand.places.lon_lat_h[by_hand.swapped]).all()


def test_the_verdict_tells_frame_and_points_apart(by_hand: Judged) -> None:
    verdict = by_hand.verdict
    east_m, north_m, up_m = verdict.frame_error_m
    np.testing.assert_allclose([east_m, north_m], FRAME_M[:2], atol=0.35)
    assert up_m == pytest.approx(FRAME_M[2], abs=content_has_no_sharper_height_m)
    declared_m = float(normal_ce90(np.diag(OWN_SIGMA_M[:2] ** 2)[None])[0])
    assert verdict.declared_relative_ce90_m == pytest.approx(declared_m)
    assert verdict.relative_ce90_m == pytest.approx(declared_m, rel=0.35)
    assert verdict.declared_ce90_m > verdict.declared_relative_ce90_m
    assert verdict.ce90_m > np.hypot(*FRAME_M[:2])
    assert 0.5 < verdict.relative_normalised < 1.7
    expected = (FRAME_M**2 / np.diagonal(FRAME.covariance_m2)).mean()
    assert verdict.frame_normalised == pytest.approx(expected, abs=0.6)


def test_a_common_error_is_found_whatever_a_few_points_say() -> None:
    rng = np.random.default_rng(3)
    error_m = FRAME_M + rng.normal(0.0, OWN_SIGMA_M, (80, 3))
    error_m[:6] += 40.0
    covariance = np.tile(np.diag(OWN_SIGMA_M**2), (80, 1, 1))
    for frame in (FRAME, Frame(np.full((3, 3), np.nan))):
        found_m = common_error_m(error_m, covariance, frame)
        np.testing.assert_allclose(found_m, FRAME_M, atol=4.0 * OWN_SIGMA_M.max() / np.sqrt(74))
    nothing = common_error_m(error_m, covariance, Frame.from_sigmas(1e-6, 1e-6))
    np.testing.assert_allclose(nothing, 0.0, atol=1e-3)


def test_later_images_are_off_by_the_frame_on_the_earth_only(by_hand: Judged) -> None:
    outcomes = [scene.outcome for scene in by_hand.later if scene.outcome.delivered]
    assert outcomes
    for outcome in outcomes:
        assert outcome.ce90_before_m > 2.0 * outcome.ground_ce90_m
        assert not outcome.wrong
        assert not outcome.wrong_on_earth
        # The error of the frame, with what a higher frame moves in an inclined image.
        assert np.hypot(*FRAME_M[:2]) - 1.5 < outcome.ground_ce90_m < np.linalg.norm(FRAME_M) + 1.5
        assert outcome.ground_ce90_m > outcome.ce90_m
        assert outcome.ground_predicted_m > outcome.predicted_m


def test_points_that_no_image_finds_are_those_with_chips_of_other_places(by_hand: Judged) -> None:
    shown = np.any([scene.shown for scene in by_hand.later], axis=0)
    found = np.any([scene.found for scene in by_hand.later], axis=0)
    assert (shown & by_hand.swapped).any()
    assert not found[by_hand.swapped].any()
    assert found[shown & ~by_hand.swapped].mean() > 0.8
    assert never_found(by_hand.later) == pytest.approx((shown & ~found).sum() / shown.sum())


def test_density_counts_the_cells_that_have_texture(small_continent: Continent, by_hand: Judged) -> None:
    side_m = 400.0
    count, corner = counts(small_continent, by_hand.points.lon_lat_h[:, :2], side_m)
    assert len(corner) == int(small_continent.size.area_m / side_m) ** 2
    assert 0 < count.sum() <= len(by_hand.points)
    world = small_continent.world
    textured = textured_cells(world, corner, side_m)
    middle = np.rint(world.column_row(corner + side_m / 2.0 / world.posting_m * world.step_deg))
    column, row = (middle.astype(int) % len(world.albedo)).T
    wet = world.parcel[row, column] == WATER
    assert textured[~wet].mean() > 0.8
    assert textured[wet].mean() < 0.7
    verdict = judge_density(small_continent, by_hand.points)
    assert verdict.cells == 4
    assert verdict.reached == 1.0
    in_area = verdict.points_per_km2 * (small_continent.size.area_m * 1e-3) ** 2
    assert 0.7 * len(by_hand.points) < in_area <= len(by_hand.points)


def test_the_older_base_is_a_sound_block_off_by_what_it_declares(small_continent: Continent) -> None:
    folder = small_continent.folder / "control" / "base"
    block = check_block(folder)
    assert block.document.metadata.frame.sigma_m == pytest.approx(FRAME_SIGMA_M)
    true = json.loads((small_continent.truth / "control.json").read_text())["base"]
    assert true["points"] == len(block.points) > 10
    assert np.std(true["point_errors_m"], axis=0) == pytest.approx(POINT_SIGMA_M, rel=0.6)
    places = true_places(small_continent, block.points, FolderChips(folder))
    put_in_m = np.array(true["point_errors_m"]) + true["frame_error_m"]
    off_m = errors_m(block.points, places) - put_in_m
    assert np.isfinite(off_m).all()
    assert np.abs(off_m[:, :2]).max() < 0.15
    assert np.median(np.abs(off_m[:, 2])) < content_has_no_sharper_height_m


def test_the_elevation_model_is_off_by_what_it_declares(small_continent: Continent) -> None:
    terrain = read_dem(small_continent.folder / "control" / "dem.tif")
    true = json.loads((small_continent.truth / "control.json").read_text())["dem"]
    world = small_continent.world
    node = np.random.default_rng(5).integers(200, 1800, (4000, 2))
    surface_m = cv2.blur(np.maximum(world.terrain_m, world.roof_m), (15, 15))
    off_m = terrain.height_m(world.lon_lat(node.astype(float))) - surface_m[node[:, 1], node[:, 0]]
    assert np.mean(off_m) == pytest.approx(true["bias_m"], abs=0.3)
    assert np.std(off_m) == pytest.approx(DEM_SIGMA_M, rel=0.2)


def test_ortho_images_are_off_by_what_the_truth_states(small_continent: Continent) -> None:
    true = json.loads((small_continent.truth / "control.json").read_text())["orthos"]
    assert {site["role"] for site in true} == {"control", "check"}
    for site in true:
        ortho = read_scene(Path(small_continent.folder / site["path"]), sigma_m=site["sigma_m"])
        middle = (np.array([ortho.image.shape], dtype=np.float64) - 1.0) / 2.0
        ground = ortho.model.locate(middle, np.zeros(1))[0]
        ground[2] = small_continent.world.height_m(ground[None, :2])[0]
        from_above = seen_from_above(small_continent, ground)
        chip = render_chip(ortho.image, ortho.model, ground, 2.5)
        patch = render_chip(from_above.image, from_above.model, ground, 2.5, 121)
        peak = find_chip(patch, chip, CorrelationOptions(min_score=0.6))
        assert peak.reason == ""
        # What the map shows at a place lies by the error before it.
        error_m = 2.5 * np.array([-peak.row_col[1], peak.row_col[0]])
        np.testing.assert_allclose(error_m, site["error_m"], atol=0.3)


def seen_from_above(continent: Continent, ground: Array) -> Scene:
    plan = ViewPlan(
        "above",
        (float(ground[0]), float(ground[1])),
        (300, 300),
        2.0,
        acquired_at=datetime(2022, 7, 10, 10, 30, tzinfo=UTC),
    )
    geometry = plan_geometry(continent.world, plan, np.random.default_rng(0))
    image = TiledView(continent.world_on(plan.acquired_at.date()), geometry, 1)
    return Scene(image, geometry.true_model, geometry.acquisition, 0.0)
