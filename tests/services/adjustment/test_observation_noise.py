"""The noise that residuals show beside what is stated: a factor of the stated, and a part of its own."""

import numpy as np
import pytest

from amers.services.adjustment.observation_noise import found_noise
from tests.services.simulated import ring_of_geometries
from tests.services.ties import make_ties


@pytest.mark.parametrize(("times", "own_px"), [(1.5, 0.1), (1.0, 0.0), (2.0, 0.0), (1.0, 0.2)])
def test_noise_that_is_stated_in_part_is_found_for_sharp_and_for_dull_measures(
    times: float, own_px: float
) -> None:
    views = ring_of_geometries(4)
    rng = np.random.default_rng(12)
    ties = make_ties(views, rng, 1500, 0.0)
    sigma_px = rng.choice([0.03, 0.2], len(ties.observations))
    observations = ties.observations.take(np.arange(len(sigma_px)))
    observations.sigma_px[:] = sigma_px
    noise_px = rng.normal(0.0, np.hypot(times * sigma_px, own_px)[:, None], (len(sigma_px), 2))
    found = found_noise(observations, [view.rpc for view in views], ties.lon_lat_h, noise_px)
    for stated_px in (0.03, 0.2):
        rows = sigma_px == stated_px
        assert (noise_px[rows] / found.applied(sigma_px[rows])[:, None]).std() == pytest.approx(
            1.0, abs=0.06
        )
    assert np.sqrt(found.scale2) == pytest.approx(times, abs=0.12)
    assert np.sqrt(found.own2_px2) == pytest.approx(own_px, abs=0.02)


def test_each_ray_of_a_pair_counts_with_its_own_sigma_in_both_coordinates() -> None:
    """Rays of an image that measures well, and of one that does so here and there."""
    views, rng = ring_of_geometries(2), np.random.default_rng(13)
    ties = make_ties(views, rng, 1500, 0.0)
    image, sigma_px = ties.observations.image, ties.observations.sigma_px
    sigma_px[:] = np.where(image == 0, 0.03, rng.choice([0.03, 0.1, 0.3], len(image)))
    noise_px = sigma_px[:, None] * rng.normal(size=(len(image), 2))
    found = found_noise(ties.observations, [view.rpc for view in views], ties.lon_lat_h, noise_px)
    assert np.sqrt(found.scale2) == pytest.approx(1.0, abs=0.06)
    assert np.sqrt(found.own2_px2) < 0.02
