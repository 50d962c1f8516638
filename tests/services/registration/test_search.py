"""First searches compare displacements in one frame, and say what to do next when they are refused."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NoConsensus, NotEnoughPoints
from amers.services.geodesy import ecef_from_east_north_up, ecef_from_lon_lat_h
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.matching.consensus import Consensus, Voters
from amers.services.registration.context import SearchStage
from amers.services.registration.search import (
    check_consensus,
    check_inliers,
    first_consensus,
    predict,
    select_inliers,
    summarise,
)
from amers.services.sensors.base import SensorModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Acquisition, Array
from tests.factories import control_points
from tests.services.conftest import GSD_M as FLAT_GSD_M
from tests.services.conftest import SHAPE, FlatModel, register
from tests.services.registration.small_ground import context_of, matches_at
from tests.services.registration.small_ground import scene as small_scene

LINES, GSD_M = 5000, 20.0
SHIFT_PX = np.array([180.0, -165.0])
"""4.9 km."""
LEVEL_M = 20.0
of_three_level_pixels = 3.0 * LEVEL_M


def wide_scene(lat_deg: float, incidence_deg: float) -> Scene:
    """A scene 100 km wide of which only the geometry counts."""
    model = pushbroom_over(
        np.array([20.0, lat_deg, 100.0]),
        (LINES, LINES),
        GSD_M,
        (incidence_deg, 100.0),
        (0.0, 1000.0),
        jitter_px=0.0,
        rng=np.random.default_rng(0),
    )
    blank = ArrayImage(np.zeros((LINES, LINES), dtype=np.float32))
    return Scene(blank, model, Acquisition("wide"), 1667.0)


def spread_positions() -> Array:
    return np.random.default_rng(1).uniform(700.0, LINES - 700.0, (60, 2))


def east_north_m(model: SensorModel, start: Array, end: Array) -> Array:
    """Displacements (n, 2) on the ground, each in the frame of its own start."""
    height_m = np.full(len(start), 100.0)
    origin, moved = (model.locate(position, height_m) for position in (start, end))
    ecef = ecef_from_lon_lat_h(moved) - ecef_from_lon_lat_h(origin)
    return np.array([d @ ecef_from_east_north_up(o) for d, o in zip(ecef, origin, strict=True)])[:, :2]


@pytest.mark.parametrize(("lat_deg", "incidence_deg"), [(75.0, 5.0), (45.0, 30.0), (0.0, 5.0)])
def test_a_shift_of_the_image_is_one_consensus_wherever_the_scene_lies(
    lat_deg: float, incidence_deg: float
) -> None:
    scene = wide_scene(lat_deg, incidence_deg)
    predicted = spread_positions()
    measured = predicted + SHIFT_PX + np.random.default_rng(2).normal(0.0, 0.3, predicted.shape)
    consensus = first_consensus(
        scene, predicted, measured, level_m=LEVEL_M, radius_m=5_000.0, side_m=2_020.0
    )
    assert consensus.inliers.all()
    assert consensus.false_alarms < 1e-12
    ground_m = east_north_m(scene.model, predicted, measured)
    spread_m = np.hypot(*(ground_m - ground_m.mean(axis=0)).T).max()
    if lat_deg == 75.0 or incidence_deg == 30.0:
        assert spread_m > of_three_level_pixels  # East and north would lose points.


def test_a_candidate_of_a_refused_search_is_one_group_over_converging_meridians() -> None:
    scene = wide_scene(75.0, 5.0)
    predicted = spread_positions()
    ground = scene.model.locate(predicted, np.full(len(predicted), 100.0))
    displacement_m = east_north_m(scene.model, predicted, predicted + SHIFT_PX)
    spread_m = np.hypot(*(displacement_m - displacement_m.mean(axis=0)).T).max()
    assert spread_m > of_three_level_pixels, "east and north of each place would split them"
    found = np.arange(len(predicted)) % 4 > 0
    shown = np.where(found[:, None], predicted + SHIFT_PX, np.nan)
    matches = matches_at(shown, np.where(found[:, None], displacement_m, np.nan), 0.1)
    refused = summarise(
        "coarse",
        matches,
        np.zeros(len(found), dtype=bool),
        level_m=LEVEL_M,
        radius_m=5_000.0,
        needed_m=5_000.0,
        voters=Voters(matches.line_sample, 100.0),
        lon_lat_h=ground,
    )
    (one,) = refused.candidates
    assert one.points == found.sum()
    middle = np.array([[LINES / 2.0, LINES / 2.0]])
    expected = east_north_m(scene.model, middle, middle + SHIFT_PX)[0]
    assert np.hypot(one.east_m - expected[0], one.north_m - expected[1]) < of_three_level_pixels


def stage(**changes: object) -> SearchStage:
    base = SearchStage("coarse", 20.0, 300.0, 300.0, 60, 12, 5, 4, 100.0)
    return replace(base, **changes)  # type: ignore[arg-type]


def refusal(of: SearchStage, false_alarms: float = 0.8) -> str:
    scene = wide_scene(0.0, 5.0)
    consensus = Consensus(np.ones(of.inliers, dtype=bool), np.zeros(2), false_alarms)
    reason = np.array(
        ["low_score"] * (of.tried - of.matched - of.at_border) + ["border_peak"] * of.at_border
    )
    with pytest.raises(NoConsensus) as refused:
        check_consensus(of, consensus, reason, replace(scene, sigma_m=100.0), 1e-4)
    message = str(refused.value)
    assert "inf" not in message
    assert "nan" not in message
    return message


def test_a_refusal_counts_and_writes_out_the_next_option() -> None:
    message = refusal(stage())
    assert "60 points tried within 300 m, 12 found, 4 of them within 60 m of each other" in message
    assert "which chance explains (0.8 such groups expected" in message
    assert "--sigma-m 200" in message


@pytest.mark.parametrize("inliers", [0, 1])
def test_points_of_which_no_two_agree_are_refused_in_words(inliers: int) -> None:
    message = refusal(stage(inliers=inliers, displacement_rms_m=float("nan")), 1.0)
    assert "no two of them agree" in message


REFERENCE = "the reference does not agree with the scene on one correction: 60 places tried"
COARSE = "the coarse search does not agree on one correction: 60 points tried"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"at_border": 40, "matched": 10}, ("40 best peaks lie at the border", "try --sigma-m 200")),
        ({"at_border": 31}, ("31 best peaks lie at the border of the search",)),
        ({"at_border": 30}, ("check that the points show the ground", "try --sigma-m 200")),
        ({"name": "reference"}, (REFERENCE,)),
        ({}, (COARSE,)),
        ({"middle_m": 20_000.0}, ("in the middle 20.0 km of the scene only", "with coarser chips")),
        ({"matched": 6, "at_border": 0}, ("next to none of the points is seen",)),
        (
            {"needed_radius_m": 5_000.0, "search_radius_m": 3_300.0},
            ("reached 3300 m of the 5000 m", "try --sigma-m 1100"),
        ),
        # The radius of a search is a few pixels at least, which says more than a small sigma.
        ({"search_radius_m": 606.0, "needed_radius_m": 606.0}, ("try --sigma-m 400",)),
        ({"search_radius_m": 594.0, "needed_radius_m": 594.0}, ("try --sigma-m 200",)),
    ],
)
def test_a_refusal_says_what_was_seen_and_what_to_try(
    changes: dict[str, object], told: tuple[str, ...]
) -> None:
    message = refusal(stage(**changes))
    for words in told:
        assert words in message


@pytest.mark.parametrize(
    ("inliers", "false_alarms", "is_accepted"),
    [(2, 1e-4, True), (1, 1e-4, False), (2, 1.01e-4, False)],
)
def test_two_points_beyond_chance_are_accepted(
    inliers: int, false_alarms: float, is_accepted: bool
) -> None:
    if not is_accepted:
        refusal(stage(inliers=inliers), false_alarms)
        return
    consensus = Consensus(np.ones(inliers, dtype=bool), np.zeros(2), false_alarms)
    check_consensus(stage(inliers=inliers), consensus, np.empty(0), wide_scene(0.0, 5.0), 1e-4)


def flat_scene(pixels_per_m: float, side_m: float = 4_000.0) -> Scene:
    """A square scene north up, of which only the geometry counts."""
    side = round(side_m * pixels_per_m)
    step = np.array([[0.0, 1.0], [-1.0, 0.0]]) / pixels_per_m
    grid = MapGrid("EPSG:32633", np.array([498_000.0, 5.6e6]), step, (side, side))
    blank = ArrayImage(np.broadcast_to(np.float32(0.0), (side, side)))
    return Scene(blank, OrthoModel(grid), Acquisition("flat"), 100.0)


@pytest.mark.parametrize(("pixels_per_m", "radius_m"), [(0.25, 150.0), (2.0, 250.0)])
@pytest.mark.parametrize(("room_m", "cut_m"), [(250.0, 0.0), (0.0, 0.0), (0.0, 140.0)])
@pytest.mark.parametrize("turns", range(4))
def test_chance_is_that_of_displacements_that_a_search_can_find(
    pixels_per_m: float, radius_m: float, room_m: float, cut_m: float, turns: int
) -> None:
    """Of six points two agree, as drawn: in one of so many draws, whatever the size of the pixels.

    Chips of 100 m at one border of the scene, or farther inside, are found as long as they lie in it.
    """
    rng, draws = np.random.default_rng(5), 4000
    scene, level_m, side_m = flat_scene(pixels_per_m), radius_m / 30.0, 4_000.0
    across = np.array([[50.0 + cut_m + room_m, 700.0 + 500.0 * k] for k in range(6)])
    off_m = rng.uniform([-min(room_m, radius_m), -radius_m], radius_m, (draws, 6, 2))
    pairs = np.hypot(*(off_m[:, :, None] - off_m[:, None, :]).transpose(3, 0, 1, 2)) < 3.0 * level_m
    happens = (pairs.sum(axis=(1, 2)) > 6).mean()
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), turns)
    place_m = (across - side_m / 2.0) @ turn.T + side_m / 2.0 - 0.5 / pixels_per_m
    expected = []
    for moved_m in off_m[pairs.sum(axis=(1, 2)) == 8][:25]:
        consensus = first_consensus(
            scene,
            place_m * pixels_per_m,
            (place_m + moved_m @ turn.T) * pixels_per_m,
            level_m=level_m,
            radius_m=radius_m,
            side_m=100.0,
            cut_px=np.full(2, cut_m * pixels_per_m),
        )
        assert consensus.inliers.sum() == 2
        expected.append(consensus.false_alarms)
    # Each of six points is expected to find another one: a pair counts twice.
    assert 0.75 < np.mean(expected) / (2.0 * happens) < 1.4


def test_a_point_still_to_be_found_may_be_as_far_off_as_the_points_found() -> None:
    """The scatter of the points found and the covariance of the correction add as squares."""
    adjustment = register().adjustment
    blank = ArrayImage(np.broadcast_to(np.float32(0.0), SHAPE))
    scene = Scene(blank, FlatModel(), Acquisition("flat"), 10.0)
    points = control_points(20, np.random.default_rng(2))
    middle = np.random.default_rng(3).uniform(100.0, np.array(SHAPE) - 100.0, (20, 2))
    points = replace(points, lon_lat_h=FlatModel().locate(middle, np.zeros(20)))
    rms_px = np.sqrt(np.mean(adjustment.residual_px[adjustment.active] ** 2))
    first_m = predict(scene, points, adjustment).uncertainty_m
    scattered = replace(adjustment, residual_px=2.0 * adjustment.residual_px)
    vague = replace(adjustment, covariance=4.0 * adjustment.covariance)
    expected_m2 = first_m**2 + 3.0 * (rms_px * FLAT_GSD_M) ** 2
    found_m2 = predict(scene, points, scattered).uncertainty_m ** 2
    np.testing.assert_allclose(found_m2, expected_m2, rtol=0.01)
    expected_m2 = 4.0 * first_m**2 - 3.0 * (rms_px * FLAT_GSD_M) ** 2
    found_m2 = predict(scene, points, vague).uncertainty_m ** 2
    np.testing.assert_allclose(found_m2, expected_m2, rtol=0.01)
    for shift in (0, 3):
        # A point is as uncertain as in its worse coordinate.
        covariance = np.zeros((6, 6))
        covariance[shift, shift] = 2.0**2
        of_one = predict(scene, points, replace(adjustment, covariance=covariance)).uncertainty_m
        np.testing.assert_allclose(of_one, np.hypot(2.0, rms_px) * FLAT_GSD_M, rtol=0.01)


@pytest.mark.parametrize("sigmas_m", [(2.0, 2.0), (0.0, 2.0 * np.sqrt(2.0)), (2.0 * np.sqrt(2.0), 0.0)])
def test_points_agree_within_what_they_and_their_matches_are_off_by(
    sigmas_m: tuple[float, float],
) -> None:
    """Four pixels of ground in the mean of both coordinates, and three of a match; no heights."""
    place = np.random.default_rng(3).uniform(100.0, 3900.0, (30, 2))
    covariance_m2 = np.tile(np.diag([*sigmas_m, 50.0]) ** 2, (30, 1, 1))
    points = replace(
        control_points(30, np.random.default_rng(2)),
        lon_lat_h=FlatModel().locate(place, np.zeros(30)),
        covariance_m2=covariance_m2,
    )
    inliers, tolerance_px = select_inliers(FlatModel(), points, matches_at(place, 0.0 * place, 3.0))
    assert inliers.all()
    assert tolerance_px == pytest.approx(0.5 + 3.0 * 5.0)


def test_equal_parts_of_the_work_follow_one_another() -> None:
    told: list[float] = []
    context = replace(
        context_of(small_scene(np.zeros(2), 5.0)), progress=lambda fraction, _: told.append(fraction)
    )
    for part in context.parts(0.2, 0.6, 3):
        part.progress(0.0, "")
        part.progress(1.0, "")
    np.testing.assert_allclose(told, [0.2, 0.4, 0.4, 0.6, 0.6, 0.8])


@pytest.mark.parametrize(("matched", "named"), [(0, True), (3, True), (5, True), (7, False)])
def test_a_search_that_sees_next_to_nothing_may_be_of_another_scene(matched: int, named: bool) -> None:
    """A first search that is precise enough to begin with the finest chips says so, too."""
    of = stage(name="fine", tried=60, matched=matched, at_border=0, inliers=0)
    scene = replace(wide_scene(0.0, 5.0), sigma_m=100.0)
    reason = np.array(["low_score"] * (60 - matched))
    with pytest.raises(NotEnoughPoints) as refused:
        check_inliers(of, 2.0, reason, scene, 8)
    assert ("may be that of another scene than its model" in str(refused.value)) == named
    assert "--sigma-m 200" in str(refused.value)
