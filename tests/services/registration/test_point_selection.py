"""Points are tried where the scene should show enough of their chips, within the error of its model."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_CENTRE
from amers.services.errors import CoverageError, InputError, OtherGround
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ArrayImage
from amers.services.matching.chip_extent import MIN_VISIBLE_SIDE
from amers.services.registration.chip_selection import fine_gsd_m, has_chip, visibility_probability
from amers.services.registration.context import Prediction
from amers.services.registration.options import CoarseOptions
from amers.services.registration.point_selection import (
    initial_prediction,
    points_expected,
    points_to_try,
    visible_points,
)
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.types import Acquisition, Array, BoolArray, ControlPoints
from tests.factories import affine_model, control_points

CENTRE = np.array([5.4, 43.6])
SIZE_PX = 360
"""Chips of a metre are 101 m wide: a scene of this size shows ten of the points."""
SIGMA_M = 60.0
FEW = 8


def small_scene() -> Scene:
    """A scene of pixels of a metre, which are not read."""
    model = replace(
        affine_model(CENTRE), image_offset=np.full(2, SIZE_PX / 2.0), image_scale=np.full(2, 5000.0)
    )
    blank = ArrayImage(np.zeros((SIZE_PX, SIZE_PX), dtype=np.float32))
    return Scene(blank, model, Acquisition("small"), SIGMA_M)


def points_around() -> ControlPoints:
    """Points of a square kilometre around the scene, with chips of a metre and of four."""
    west, south, east, north = np.concatenate([CENTRE - [0.006, 0.0045], CENTRE + [0.006, 0.0045]])
    return control_points(120, np.random.default_rng(1), (west, south, east, north), gsds_m=(1.0, 4.0))


def scene_of(lines: int, gsd_m: float) -> Scene:
    """A scene of so many lines and samples of a size around the same middle."""
    model = replace(
        small_scene().model, image_offset=np.full(2, lines / 2.0), image_scale=np.full(2, 5000.0 / gsd_m)
    )  # type: ignore[type-var]
    return replace(
        small_scene(), model=model, image=ArrayImage(np.zeros((lines, lines), dtype=np.float32))
    )


def enough_shown(scene: Scene, line_sample: Array) -> BoolArray:
    """Whether the scene shows the middle of a chip of a metre, to a few pixels of its turn."""
    reach_px = MIN_VISIBLE_SIDE * CHIP_CENTRE
    return np.asarray(((line_sample > reach_px) & (line_sample < SIZE_PX - reach_px)).all(axis=1))


def prediction_within(sigma_m: float, scene: Scene, points: ControlPoints) -> Prediction:
    """The delivered model's prediction of points, with a standard deviation."""
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    return Prediction(model, np.full(len(points), sigma_m))


def test_an_accurate_scene_is_tried_on_points_that_it_shows() -> None:
    scene, points = small_scene(), points_around()
    rows = points_to_try(scene, points, prediction_within(0.5, scene, points), FEW)
    assert len(rows) == FEW
    assert (np.diff(rows) > 0).all()
    assert enough_shown(scene, scene.model.project(points.lon_lat_h[rows])).all()


def test_the_better_the_model_the_more_of_the_points_tried_are_shown() -> None:
    scene, points = small_scene(), points_around()
    true_place = scene.model.project
    # The delivered model is 100 m off: it expects other points in the middle.
    shifted = replace(
        points, lon_lat_h=move_metres(points.lon_lat_h, np.tile([90.0, -60.0, 0.0], (len(points), 1)))
    )
    before = points_to_try(scene, shifted, prediction_within(SIGMA_M, scene, shifted), FEW)
    after = points_to_try(scene, points, prediction_within(0.5, scene, points), FEW)
    shown = [enough_shown(scene, true_place(points.lon_lat_h[rows])).sum() for rows in (before, after)]
    assert shown[0] < shown[1] == FEW


def test_where_there_are_few_points_or_all_are_requested_all_are_tried() -> None:
    scene, points = small_scene(), points_around()
    prediction = initial_prediction(scene, points)
    for count in (len(points), 0):
        rows = points_to_try(scene, points, prediction, count)
        np.testing.assert_array_equal(rows, np.arange(len(points)))


@pytest.mark.parametrize("worse", ["saliency", "health", "covariance_m2"])
def test_of_two_points_at_one_place_the_better_one_is_tried(worse: str) -> None:
    """The more salient, the one that failed less often, or the more precise, if hardly less salient."""
    scene, points = small_scene(), points_around()
    every_second = np.arange(2 * len(points)) % 2 == 1
    points = points.take(np.repeat(np.arange(len(points)), 2))
    alike = {
        "saliency": np.ones(len(points)),
        "health": np.ones(len(points)),
        "covariance_m2": np.tile(np.eye(3), (len(points), 1, 1)),
    }
    times = np.where(every_second, 1.0, 9.0 if worse == "covariance_m2" else 0.5)
    alike[worse] = (alike[worse].T * times).T
    if worse == "covariance_m2":
        alike["saliency"][every_second] = 0.9
    better = replace(points, **alike)  # type: ignore[arg-type]
    rows = points_to_try(scene, better, prediction_within(0.5, scene, better), FEW)
    taken = set(rows.tolist())
    assert every_second[rows].sum() >= FEW - 2
    assert all(row + 1 in taken for row in taken if not every_second[row])


def test_points_are_visible_as_far_as_the_scene_may_be_off() -> None:
    """Three standard deviations of the model around the image, on each side, and no farther."""
    scene, points = small_scene(), points_around()
    points = points.take(np.zeros(8, dtype=np.int64))
    margin_px = 3.0 * scene.sigma_m / scene_gsd_m(scene)
    middle, beyond = SIZE_PX / 2.0, SIZE_PX + margin_px
    places = np.array(
        [
            [side, middle] if is_line else [middle, side]
            for is_line in (True, False)
            for side in (2.0 - margin_px, -2.0 - margin_px, beyond - 2.0, beyond + 2.0)
        ]
    )
    ground = scene.model.locate(places, points.lon_lat_h[:, 2])
    visible = visible_points(scene, replace(points, lon_lat_h=ground))
    assert visible.tolist() == [0, 2, 4, 6]


def test_a_scene_beside_all_points_is_refused() -> None:
    scene, points = small_scene(), points_around()
    elsewhere = replace(points, lon_lat_h=points.lon_lat_h + [0.5, 0.0, 0.0])
    with pytest.raises(OtherGround, match=r"at 43\.60 N, 5\.40 E, the nearest point at .* \d\d km away"):
        visible_points(scene, elsewhere)
    near = replace(points, lon_lat_h=points.lon_lat_h + [0.02, 0.0, 0.0])
    with pytest.raises(
        CoverageError, match=r"accurate to 60 m: the nearest is \d+ m from its middle"
    ) as told:
        visible_points(scene, near)
    assert not isinstance(told.value, OtherGround)
    with pytest.raises(CoverageError, match="no control point"):
        visible_points(scene, points.take(np.arange(0)))


def test_of_the_best_points_so_many_are_taken_that_the_scene_is_expected_to_show_a_number() -> None:
    """Of those with chips of a metre: the sum of their probabilities reaches the number, and no more."""
    scene, points = small_scene(), points_around()
    rng, n, gsd_m = np.random.default_rng(4), len(points), points.views.gsd_m.copy()
    gsd_m[: points.views.start[5]] = 4.0
    points = replace(
        points,
        saliency=rng.uniform(0.3, 1.0, n),
        health=rng.uniform(0.3, 1.0, n),
        views=replace(points.views, gsd_m=gsd_m),
    )
    prediction = prediction_within(SIGMA_M, scene, points)
    probability = visibility_probability(scene, points, prediction, 1.0)
    assert probability[:5].max() > 0.1
    probability[:5] = 0.0
    merit = points.saliency * points.health * probability
    for count in (3, 6):
        rows = points_expected(scene, points, prediction, 1.0, count=count)
        assert count <= probability[rows].sum() < count + 1.0
        assert merit[rows].min() >= np.delete(merit, rows).max()


def test_a_point_is_as_uncertain_as_the_model_and_its_worse_coordinate_together() -> None:
    scene, points = small_scene(), points_around()
    for sigmas_m in ((80.0, 20.0, 500.0), (20.0, 80.0, 500.0)):
        wrong = replace(points, covariance_m2=np.tile(np.diag(sigmas_m) ** 2, (len(points), 1, 1)))
        stated_m = initial_prediction(scene, wrong).uncertainty_m
        np.testing.assert_allclose(stated_m, np.hypot(SIGMA_M, 80.0))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_scene_shows_a_chip_where_it_has_its_corners_also_with_pixels_that_are_no_squares(
    axis: int,
) -> None:
    """Pixels that are twice as long along one axis, of which the image has half as many."""
    square, times = small_scene(), np.where(np.arange(2) == axis, 0.5, 1.0)
    lines, samples = (int(size) for size in SIZE_PX * times)
    frame = no_correction((lines, samples))
    slopes = np.diag((times - 1.0) * frame.half_size)
    parameters = np.column_stack([(times - 1.0) * frame.centre, slopes])
    longer = replace(
        square,
        image=ArrayImage(np.zeros((lines, samples), dtype=np.float32)),
        model=CorrectedModel(square.model, replace(frame, parameters=parameters)),
    )
    lattice = np.stack(np.meshgrid(*[np.arange(3.0, SIZE_PX, 9.0)] * 2), axis=-1).reshape(-1, 2)
    points = points_around().take(np.zeros(len(lattice), dtype=np.int64))
    points = replace(points, lon_lat_h=square.model.locate(lattice, points.lon_lat_h[:, 2]))
    inside_px = np.full(len(lattice), np.inf)
    for corner in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
        step = np.tile([*(CHIP_CENTRE * np.array(corner)), 0.0], (len(lattice), 1))
        at = longer.model.project(move_metres(points.lon_lat_h, step))
        inside_px = np.minimum(inside_px, np.minimum(at, [lines - 1, samples - 1] - at).min(axis=1))
    clear = np.abs(inside_px) > 1.0
    shown = visibility_probability(longer, points, prediction_within(1e-6, longer, points), 1.0)
    np.testing.assert_allclose(shown[clear], inside_px[clear] > 0.0, atol=1e-6)
    assert 100 < (inside_px > 0.0).sum() < 0.9 * len(lattice)


def test_points_for_which_the_model_has_no_position_change_nothing_for_the_others() -> None:
    """Wherever they stand among them, also in the middle, or alone."""
    scene, points = small_scene(), points_around()
    away = replace(points, lon_lat_h=points.lon_lat_h + [40.0, 0.0, 0.0])
    assert np.isnan(scene.model.project(away.lon_lat_h)).all()
    lost = 3 * np.arange(len(points)) // len(points) == 1
    mixed = replace(points, lon_lat_h=np.where(lost[:, None], away.lon_lat_h, points.lon_lat_h))
    known, some, none = (
        visibility_probability(scene, of, prediction_within(SIGMA_M, scene, of), 1.0)
        for of in (points, mixed, away)
    )
    assert known[~lost].max() > 0.1
    np.testing.assert_allclose(some, np.where(lost, 0.0, known), atol=2e-3)
    assert not none.any()


def test_the_probability_of_being_shown_is_that_of_many_draws() -> None:
    points, scene, sigma_m = points_around(), small_scene(), 40.0
    line_sample = scene.model.project(points.lon_lat_h)
    prediction = prediction_within(sigma_m, scene, points)
    probability = visibility_probability(scene, points, prediction, 1.0)
    derivative = np.abs(scene.model.project_derivative(points.lon_lat_h[:1])[0, :, :2])
    reach_px = CHIP_CENTRE * derivative.sum(axis=1)
    sigma_px = sigma_m / scene_gsd_m(scene)
    drawn = np.random.default_rng(1).normal(0.0, sigma_px, (5000, 1, 2)) + line_sample
    last_px = SIZE_PX - 1.0 - reach_px
    shown = ((drawn >= reach_px) & (drawn <= last_px)).all(axis=2).mean(axis=0)
    np.testing.assert_allclose(probability, shown, atol=0.02)
    assert probability.max() > 0.8


@pytest.mark.parametrize(
    ("lines", "gsd_m", "expected_m"),
    [(2800, 1.0, 1.0), (700, 4.0, 4.0), (150, 4.0, 1.0), (700, 3.1, 1.0), (700, 3.4, 4.0)],
    ids=["fine scene", "coarse", "smaller than two chips", "between the chips", "nearly as coarse"],
)
def test_chips_are_as_coarse_as_the_scene_where_it_shows_them(
    lines: int, gsd_m: float, expected_m: float
) -> None:
    points, scene = points_around(), scene_of(lines, gsd_m)
    assert fine_gsd_m(scene, points, prediction_within(5.0, scene, points)) == expected_m


@pytest.mark.parametrize(("share", "expected_m"), [(0.7, 1.0), (0.9, 4.0)])
def test_coarse_chips_of_few_points_are_left_for_the_finer_ones_of_all(
    share: float, expected_m: float
) -> None:
    """Four of five points that the scene shows are enough."""
    points, scene = points_around(), scene_of(700, 4.0)
    few, owner = int(share * len(points)), np.repeat(np.arange(len(points)), 6)
    gsd_m = np.where(owner < few, points.views.gsd_m, 1.0)
    mixed = replace(points, views=replace(points.views, gsd_m=gsd_m))
    assert has_chip(mixed, 4.0).sum() == few
    assert fine_gsd_m(scene, mixed, prediction_within(5.0, scene, mixed)) == expected_m


@pytest.mark.parametrize("name", ["points", "max_search_px", "max_reduction"])
def test_options_no_search_can_be_made_with_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: 0 given, 1 or more expected"):
        CoarseOptions(**{name: 0})
