"""Rays meet where the point is, with the covariance that many trials show."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.intersection import intersect, residuals_and_derivatives
from amers.services.geodesy import move_metres
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Observations
from tests.services.simulated import ring_of_geometries
from tests.services.ties import difference_m, make_ties, whitened_square

a_millimetre = 1e-3
a_centimetre = 0.01
a_hundredth_of_a_pixel = 0.01
a_tenth_of_a_degree = 0.1
NOISE_PX = 0.2


@pytest.fixture(scope="module")
def three() -> list[ViewGeometry]:
    return ring_of_geometries(3)


def test_exact_rays_of_an_rpc_meet_in_the_point(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(0), noise_px=0.0)
    exact = replace(ties.observations, sigma_px=np.full(len(ties.observations), NOISE_PX))
    found = intersect([g.rpc for g in three], exact, 300)
    assert np.abs(difference_m(found.lon_lat_h, ties.lon_lat_h)).max() < a_millimetre
    assert np.abs(found.residual_px).max() < a_millimetre
    assert (found.rays == 3).all()


def test_rays_of_a_pushbroom_and_of_rpcs_meet_in_the_point(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(0), noise_px=0.0)
    exact = replace(ties.observations, sigma_px=np.full(len(ties.observations), NOISE_PX))
    found = intersect([three[0].true_model, three[1].rpc, three[2].rpc], exact, 300)
    # The RPCs follow the sensor to a hundredth of a pixel of a metre.
    assert np.abs(difference_m(found.lon_lat_h, ties.lon_lat_h)).max() < 10.0 * a_centimetre
    assert np.abs(found.residual_px).max() < a_hundredth_of_a_pixel


@pytest.mark.parametrize("count", [2, 3, 6])
def test_errors_are_what_the_covariance_says(count: int) -> None:
    geometries = ring_of_geometries(count)
    ties = make_ties(geometries, np.random.default_rng(1), 2000, NOISE_PX)
    found = intersect([g.rpc for g in geometries], ties.observations, 2000)
    error_m = difference_m(found.lon_lat_h, ties.lon_lat_h)
    assert whitened_square(error_m, found.covariance_m2).mean() == pytest.approx(1.0, abs=0.05)
    standard_error = error_m.std(axis=0) / np.sqrt(2000)
    assert (np.abs(error_m.mean(axis=0)) < 4.0 * standard_error).all()


def test_residuals_are_the_noise_less_what_the_points_took(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(3), 2000, NOISE_PX)
    found = intersect([g.rpc for g in three], ties.observations, 2000)
    chi2 = (found.residual_px**2).sum() / NOISE_PX**2
    assert chi2 / (2000 * (2 * 3 - 3)) == pytest.approx(1.0, abs=0.05)


def test_the_angle_is_that_between_the_flights() -> None:
    pair = ring_of_geometries(2, incidence_deg=15.0)
    ties = make_ties(pair, np.random.default_rng(0), 50, 0.0)
    exact = replace(ties.observations, sigma_px=np.full(len(ties.observations), NOISE_PX))
    found = intersect([g.rpc for g in pair], exact, 50)
    assert np.abs(found.angle_deg - 30.0).max() < 2.0 * a_tenth_of_a_degree


def test_the_covariance_of_a_point_of_three_rays_is_that_of_trials(three: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(2)
    one = make_ties(three, rng, 1, 0.0)
    trials = 4000
    sigma_px = np.tile([0.2, 0.5, 1.0], trials)
    line_sample = np.tile(one.observations.line_sample, (trials, 1))
    line_sample += rng.normal(0.0, 1.0, line_sample.shape) * sigma_px[:, None]
    observations = Observations(
        np.repeat(np.arange(trials), 3), np.tile(np.arange(3), trials), line_sample, sigma_px
    )
    found = intersect([g.rpc for g in three], observations, trials)
    truth = np.tile(one.lon_lat_h, (trials, 1))
    seen = np.cov(difference_m(found.lon_lat_h, truth).T)
    stated = found.covariance_m2.mean(axis=0)
    np.testing.assert_allclose(np.sqrt(np.diag(seen)), np.sqrt(np.diag(stated)), rtol=0.05)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    np.testing.assert_allclose(seen / scale, stated / scale, atol=0.08)


def test_the_angle_of_many_rays_is_that_of_the_two_farthest_apart_in_any_order() -> None:
    wide, narrow = ring_of_geometries(2, incidence_deg=15.0), ring_of_geometries(2, incidence_deg=3.0)
    for views in (wide + narrow, narrow + wide, [wide[0], *narrow, wide[1]]):
        ties = make_ties(views, np.random.default_rng(0), 20, NOISE_PX)
        found = intersect([view.rpc for view in views], ties.observations, 20)
        assert (found.rays == 4).any()
        np.testing.assert_allclose(
            found.angle_deg[found.rays == 4], 30.0, atol=2.0 * a_tenth_of_a_degree
        )


def test_height_is_less_precise_at_a_narrower_angle() -> None:
    std = []
    for incidence in (3.0, 15.0, 30.0):
        pair = ring_of_geometries(2, incidence)
        ties = make_ties(pair, np.random.default_rng(0), 20, NOISE_PX)
        found = intersect([g.rpc for g in pair], ties.observations, 20)
        std.append(np.sqrt(found.covariance_m2[:, 2, 2]).mean())
        # Two opposite rays of incidence i: the height is the parallax over 2 tan i.
        assert std[-1] == pytest.approx(
            NOISE_PX / np.sqrt(2.0) / np.tan(np.radians(incidence)), rel=0.15
        )
    assert std[0] > std[1] > std[2]


def test_a_single_ray_and_two_parallel_ones_meet_nowhere(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(0), 3, NOISE_PX)
    line_sample = ties.observations.line_sample
    observations = Observations(
        np.array([0, 1, 1, 2, 2, 2]),
        np.array([0, 1, 1, 0, 1, 2]),
        line_sample[[0, 4, 4, 6, 7, 8]],
        np.full(6, NOISE_PX),
    )
    found = intersect([g.rpc for g in three], observations, 4)
    np.testing.assert_array_equal(found.rays, [1, 2, 3, 0])
    np.testing.assert_array_equal(np.isfinite(found.lon_lat_h[:, 0]), [False, False, True, False])
    assert np.isnan(found.covariance_m2[[0, 1, 3]]).all()


def test_an_observation_outside_its_model_is_left_out(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(0), 5, NOISE_PX)
    line_sample = ties.observations.line_sample.copy()
    line_sample[4] = np.nan
    found = intersect([g.rpc for g in three], replace(ties.observations, line_sample=line_sample), 5)
    np.testing.assert_array_equal(found.rays, [3, 2, 3, 3, 3])
    assert np.isfinite(found.lon_lat_h).all()
    assert np.isnan(found.residual_px[4]).all()
    assert np.abs(difference_m(found.lon_lat_h, ties.lon_lat_h)).max() < 10.0 * NOISE_PX
    others = np.array([0, 2, 3, 4])
    assert found.covariance_m2[1, 2, 2] > found.covariance_m2[others, 2, 2].max()


def test_derivatives_are_what_small_moves_of_the_ground_show(three: list[ViewGeometry]) -> None:
    ties = make_ties(three, np.random.default_rng(0), 50, 0.0)
    models = [g.rpc for g in three]
    residual, derivative = residuals_and_derivatives(models, ties.observations, ties.lon_lat_h)
    assert np.abs(residual).max() < a_millimetre
    for axis in range(3):
        step_m = np.zeros((50, 3))
        step_m[:, axis] = 1.0
        ahead, _ = residuals_and_derivatives(
            models, ties.observations, move_metres(ties.lon_lat_h, step_m)
        )
        np.testing.assert_allclose(residual - ahead, derivative[:, :, axis], atol=1e-3)


def test_rays_of_nearly_one_view_meet_yet() -> None:
    pair = ring_of_geometries(2, incidence_deg=0.05)
    ties = make_ties(pair, np.random.default_rng(0), 20, 0.01)
    found = intersect([g.rpc for g in pair], ties.observations, 20)
    assert (np.isfinite(found.lon_lat_h[:, 0]) & (found.angle_deg < 0.2)).all()
