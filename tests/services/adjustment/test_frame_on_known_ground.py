"""A block goes onto known ground as far as normal laws say, conditioned densely."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2

from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.frame_fit import fit_frame
from amers.services.geodesy import move_metres
from amers.services.types import Array, Frame, IntArray
from tests.services.adjustment.grounds import ground_of

STAYS = 0.9999
COUNT = 5
SOURCE = np.array([0, 0, 1, 1, 1])
BLOCK = Frame(np.diag([9.0, 16.0, 25.0]) + 2.0, np.diag([0.5, 0.2, 0.1]))
SOURCES = (
    Frame(np.diag([1.0, 2.0, 3.0]), np.diag([0.3, 0.3, 0.3])),
    Frame(np.diag([4.0, 0.5, 1.0]), np.diag([0.1, 0.2, 0.6])),
)
PLACE = np.array([5.0, 43.0, 100.0]) + np.random.default_rng(1).uniform(-0.1, 0.1, (COUNT, 3))


def covariances(rng: np.random.Generator, size: float) -> Array:
    root = size * (0.3 * rng.normal(size=(COUNT, 3, 3)) + np.eye(3))
    return np.asarray(root @ root.transpose(0, 2, 1))


OF_KNOWN, OF_FOUND = (covariances(np.random.default_rng(k), size) for k, size in ((2, 0.4), (3, 0.3)))


def known_ground(off_m: Array) -> ControlGround:
    """Known ground that lies so far (n, 3) from where the block has it."""
    known = ground_of(np.arange(COUNT), move_metres(PLACE, off_m), OF_KNOWN, *SOURCES)
    return replace(known, source=SOURCE)


def drawn(seed: int) -> Array:
    """Misfits (n, 3) by errors of the block, the sources and the points."""
    rng = np.random.default_rng([4, seed])
    shared = np.array([rng.multivariate_normal(np.zeros(3), one.covariance_m2) for one in SOURCES])
    own = [rng.multivariate_normal(np.zeros(3), one) for one in OF_KNOWN + OF_FOUND]
    of_block = rng.multivariate_normal(np.zeros(3), BLOCK.covariance_m2)
    return np.asarray(of_block + shared[SOURCE] + np.array(own))


def joint(rows: IntArray) -> Array:
    """Covariance (3 n, 3 n) of the misfits of some rows."""
    spread = block_diag(*(OF_KNOWN + OF_FOUND)[rows])
    for s, frame in enumerate(SOURCES):
        same = np.kron(SOURCE[rows] == s, np.ones(3))
        spread += np.outer(same, same) * np.tile(frame.covariance_m2 + frame.shared_m2, (len(rows),) * 2)
    return np.asarray(spread + np.tile(BLOCK.covariance_m2, (len(rows), len(rows))))


def conditioned(off_m: Array) -> tuple[Array, Array]:
    """Translation (3,) and its covariance (3, 3), by all known ground."""
    shared = np.tile(BLOCK.covariance_m2, (1, COUNT))
    gain = np.linalg.solve(joint(np.arange(COUNT)), shared.T).T
    return gain @ off_m.ravel(), BLOCK.covariance_m2 - gain @ shared.T


@pytest.mark.parametrize("seed", range(4))
def test_the_translation_is_the_conditional_law_of_the_frame(seed: int) -> None:
    off_m = drawn(seed)
    fitted = fit_frame(BLOCK, known_ground(off_m), PLACE, OF_FOUND)
    assert fitted.active.all()
    translation_m, covariance_m2 = conditioned(off_m)
    np.testing.assert_allclose(fitted.translation_m, translation_m, atol=1e-4)
    # Known ground shows half of what neighbouring points of the block are off by together.
    np.testing.assert_allclose(
        fitted.frame.covariance_m2, covariance_m2 + 0.5 * BLOCK.shared_m2, rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(fitted.frame.shared_m2, BLOCK.shared_m2)
    np.testing.assert_allclose(fitted.misfit_m, off_m - fitted.translation_m, atol=1e-4)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("row", [0, 4])
def test_known_ground_stays_as_far_off_as_the_others_predict_of_it(row: int, axis: int) -> None:
    everything = joint(np.arange(COUNT))
    own = np.arange(3 * row, 3 * row + 3)
    rest = np.setdiff1d(np.arange(3 * COUNT), own)
    weight = np.linalg.solve(everything[np.ix_(rest, rest)], everything[np.ix_(rest, own)])
    left = everything[np.ix_(own, own)] - everything[np.ix_(own, rest)] @ weight
    limit_m = float(np.sqrt(chi2.ppf(STAYS, 3) / np.linalg.inv(left)[axis, axis]))
    for share, stays in ((0.95, True), (1.05, False)):
        off_m = np.zeros((COUNT, 3))
        off_m[row, axis] = share * limit_m
        active = fit_frame(BLOCK, known_ground(off_m), PLACE, OF_FOUND).active
        assert active[row] == stays
        assert np.delete(active, row).all()


@pytest.mark.parametrize("row", [0, 1, 2])
def test_a_wrong_point_takes_no_other_of_its_source_with_it(row: int) -> None:
    """What leaves at first comes back. Of two points alone, nothing says which of both is wrong."""
    for axis in range(3):
        for size_m in np.arange(4.0, 12.0, 0.5).tolist():
            off_m = np.zeros((COUNT, 3))
            off_m[row, axis] = size_m
            active = fit_frame(BLOCK, known_ground(off_m), PLACE, OF_FOUND).active
            assert active.sum() >= COUNT - 1
            assert active[2:].all() or row >= 2


def test_a_coordinate_that_nobody_knows_counts_nothing() -> None:
    off_m = drawn(7)
    known = known_ground(off_m)
    covariance_m2 = known.covariance_m2.copy()
    covariance_m2[:, :, 2] = covariance_m2[:, 2, :] = 0.0
    covariance_m2[:, 2, 2] = np.inf
    flat = replace(known, covariance_m2=covariance_m2)
    higher = replace(flat, lon_lat_h=flat.lon_lat_h + [0.0, 0.0, 50.0])
    one, other = (fit_frame(BLOCK, each, PLACE, OF_FOUND) for each in (flat, higher))
    np.testing.assert_allclose(one.translation_m, other.translation_m)
    assert np.isnan(one.misfit_m[:, 2]).all()
