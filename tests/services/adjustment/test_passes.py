"""Images of a pass share a part of the errors of their shifts, and a covariance covers two others."""

import numpy as np
import pytest

from amers.services.adjustment.block_accuracy import positive_part
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.parameters import block_priors, image_parameters, own_part, shared_part
from tests.services.conftest import SHAPE, FlatModel
from tests.services.simulated import ring_of_geometries
from tests.services.ties import make_ties

SIGMAS_PX = 3.0, 5.0, 2.0
IMAGES = [
    image_parameters(f"image {k}", FlatModel(), SHAPE, shift_px=sigma_px, slope_px=1.0)
    for k, sigma_px in enumerate(SIGMAS_PX)
]
PASS = np.array([True, False, True])


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_shifts_of_a_pass_have_a_share_of_their_variances_in_common(share: float) -> None:
    """An error on the ground moves images of one view by as much, in units of their sigmas."""
    every = np.eye(4)
    covariance = own_part(IMAGES, PASS, every) + share * shared_part(IMAGES, PASS, every)
    between = share * SIGMAS_PX[0] * SIGMAS_PX[2] * np.eye(2)
    own = [sigma_px**2 * np.eye(2) for sigma_px in (SIGMAS_PX[0], SIGMAS_PX[2])]
    np.testing.assert_allclose(covariance, np.block([[own[0], between], [between, own[1]]]), atol=1e-9)


def test_the_priors_of_a_pass_are_those_of_images_that_share_half_and_of_others_alone() -> None:
    priors = block_priors(IMAGES, [PASS])
    tells = np.concatenate([image.locating for image in IMAGES])
    covariance = np.linalg.inv(priors.locating.toarray()[np.ix_(tells, tells)])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.repeat(SIGMAS_PX, 2))
    correlation = covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    same_axis = correlation[0::2, 0::2]
    np.testing.assert_allclose(same_axis, [[1.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]], atol=1e-9)


def test_drifts_that_are_found_twice_as_large_have_four_times_the_variance() -> None:
    priors = block_priors(IMAGES, [])
    twice = priors.with_slopes(2.0)
    slopes = priors.estimated
    np.testing.assert_allclose(1.0 / twice.shape[slopes], 4.0 / priors.shape[slopes])
    np.testing.assert_array_equal(twice.shape[~slopes], priors.shape[~slopes])


def test_a_covariance_with_the_positive_part_of_a_difference_covers_both() -> None:
    rng = np.random.default_rng(81)
    for _ in range(20):
        one, other = (root @ root.T for root in rng.normal(size=(2, 4, 4)))
        covered = one + positive_part(other - one)
        for part in (one, other):
            assert np.linalg.eigvalsh(covered - part).min() > -1e-9
        np.testing.assert_allclose(positive_part(one), one, atol=1e-9)
        np.testing.assert_allclose(positive_part(-one), 0.0, atol=1e-9)


def test_the_frame_of_a_block_of_one_pass_is_no_better_than_that_of_an_image() -> None:
    """Nobody states how much images of a pass share: all of it, at worst, so that none averages out."""
    geometries = ring_of_geometries(5)
    observations = make_ties(geometries, np.random.default_rng(82), 60, 0.2).observations
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=4.0, order="shift")
        for g in geometries
    ]
    apart, together = (
        adjust_block(images, observations, passes=passes).frames[0].sigma_m
        for passes in ((), (np.ones(5, dtype=np.bool_),))
    )
    assert 0.85 * np.sqrt(5.0) < together / apart < 1.15 * np.sqrt(5.0)
