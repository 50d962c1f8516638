"""Typed points: they place a block as precisely as they state, and blunders leave by name."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.production.control import Control
from amers.services.production.image_production import Production
from amers.services.production.marked_control import MarkedGround
from amers.services.simulation.view import SimulatedView
from amers.services.types import Frame, Observations
from tests.services.production.simulated_control import CHI2_3, frame_error_m, free, placed, views

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SEEDS = (12, 22, 23)
POINT_SIGMA_M = np.array([0.2, 0.2, 0.3])
FRAME = Frame.from_sigmas(0.3, 0.4)
MARK_SIGMA_PX = 0.5


def typed(
    seen: tuple[SimulatedView, ...], seed: int, images: int = 3, count: int = 8, height: bool = True
) -> MarkedGround:
    """Points as a survey knows them, marked by hand in the first images of three."""
    rng = np.random.default_rng([seed, 5])
    models = [view.geometry.true_model for view in seen]
    pixels = rng.uniform(0.2, 0.8, (count, 2)) * seen[0].pixels.shape
    truth = models[0].locate(pixels, rng.uniform(*seen[0].geometry.rpc.height_range_m, count))
    error_m = rng.normal(0.0, POINT_SIGMA_M, (count, 3))
    error_m += rng.multivariate_normal(np.zeros(3), FRAME.covariance_m2)
    lon_lat_h = move_metres(truth, error_m)
    if not height:
        lon_lat_h[:, 2] = np.nan
    marks = np.stack([model.project(truth) for model in models[:images]], axis=1)
    marks += rng.normal(0.0, MARK_SIGMA_PX, marks.shape)
    return MarkedGround(
        names=tuple(f"survey.csv:{k + 1}" for k in range(count)),
        lon_lat_h=lon_lat_h,
        sigma_m=np.tile(POINT_SIGMA_M, (count, 1)),
        frame=FRAME,
        marks=Observations(
            np.repeat(np.arange(count), images),
            np.tile(np.arange(images), count),
            marks.reshape(-1, 2),
            np.full(count * images, MARK_SIGMA_PX),
        ),
    )


@cache
def placed_by(seed: int, images: int) -> Production:
    return placed(seed, Control(marked=(typed(views(seed), seed, images),)))


@pytest.mark.parametrize("images", [3, pytest.param(1, marks=pytest.mark.endurance)])
def test_typed_points_place_the_block_as_precisely_as_it_declares(images: int) -> None:
    normalised = []
    for seed in SEEDS:
        made = placed_by(seed, images)
        assert made.adjustment.control_active.all()
        error_m, frame_m2 = frame_error_m(made, views(seed)), made.points.frames[0].covariance_m2
        sigma_m = np.sqrt(np.diag(frame_m2))
        print(f"{images} images, seed {seed}: {error_m.round(2)} m of {sigma_m.round(2)}")
        normalised.append(error_m @ np.linalg.solve(frame_m2, error_m) / 3.0)
    # Chi-squared of nine coordinates: 5 % lie below 0.37, 5 % above 1.88.
    assert max(normalised) < CHI2_3 / 3.0
    assert 0.2 < np.mean(normalised) < 1.9


def test_points_in_one_image_alone_place_the_position_and_not_the_height() -> None:
    without = free(12).points.frames[0]
    one, three = (placed_by(12, images).points.frames[0] for images in (1, 3))
    assert three.sigma_m < 0.5
    assert three.sigma_up_m < 1.0
    assert one.sigma_m < 0.5 * without.sigma_m
    assert one.sigma_up_m > 5.0 * three.sigma_up_m


def test_points_without_heights_place_the_position() -> None:
    seen = views(22)
    made = placed(22, Control(marked=(typed(seen, 22, height=False),)))
    frame_m2, error_m = made.points.frames[0].covariance_m2, frame_error_m(made, seen)
    assert made.points.frames[0].sigma_m < 0.6
    assert error_m @ np.linalg.solve(frame_m2, error_m) < CHI2_3
    assert np.isnan(made.adjustment.control_misfit_m[:, 2]).all()


@pytest.mark.parametrize("images", [3, 1])
def test_wrong_typed_points_are_thrown_out_by_name(images: int) -> None:
    seen = views(23)
    marked = typed(seen, 23, images, count=10)
    lon_lat_h, marks = marked.lon_lat_h.copy(), marked.marks.line_sample.copy()
    lon_lat_h[3] = move_metres(lon_lat_h[3:4], np.array([[8.0, 6.0, 0.0]]))[0]
    marks[7 * images] += [12.0, -9.0]
    wrong = replace(marked, lon_lat_h=lon_lat_h, marks=replace(marked.marks, line_sample=marks))
    made = placed(23, Control(marked=(wrong,)))
    names = np.array(made.control.names)
    assert "survey.csv:4" in names[~made.adjustment.control_active]
    # Of a point with three marks the wrong mark leaves, of one with a single mark the point.
    left_out = {"survey.csv:4"} if images == 3 else {"survey.csv:4", "survey.csv:8"}
    assert set(names[~made.adjustment.control_active]) == left_out
    error_m, frame_m2 = frame_error_m(made, seen), made.points.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(frame_m2, error_m) < CHI2_3
