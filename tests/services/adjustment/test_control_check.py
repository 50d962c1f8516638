"""A known point is judged by what all others predict of it, whether it takes part or not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from amers.services.adjustment.block_accuracy import block_accuracy
from amers.services.adjustment.block_parts import Weights, block_parts
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.block_solution import checked_gauge, least_squares, normals
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_check import agreeing_control
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import AdjustableImage, block_priors, image_parameters
from amers.services.adjustment.robust_start import active_observations, robust_start
from amers.services.adjustment.settled_block import judged
from amers.services.geodesy import move_metres
from amers.services.types import Array, BoolArray, Frame, Observations
from tests.services.adjustment.grounds import ground_of
from tests.services.simulated import ring_of_geometries
from tests.services.ties import difference_m, make_ties

STAYS = 0.9999
"""Probability with which a control point as good as stated stays."""
OWN_SIGMA_M = np.array([0.3, 0.4, 0.6])
KNOWN = 4
"""Few points place the block: each has drawn it towards itself."""
ALL = np.ones(KNOWN, dtype=np.bool_)
ALL_BUT_THE_FIRST = np.arange(KNOWN) > 0
EVERYTHING, PLACE, HEIGHT = [0, 1, 2], [0, 1], [2]
"""Coordinates of a point that are known."""
EXACT_FRAME = Frame.from_sigmas(0.001, 0.001)


@dataclass(frozen=True)
class Block:
    """Images whose place is known to some metres, and points that are known where they are."""

    images: Sequence[AdjustableImage]
    observations: Observations
    control: ControlGround

    def moved(self, off_m: Array) -> "Block":
        """The block whose first known point is stated elsewhere."""
        lon_lat_h = self.control.lon_lat_h.copy()
        lon_lat_h[:1] = move_metres(lon_lat_h[:1], off_m[None])
        return replace(self, control=replace(self.control, lon_lat_h=lon_lat_h))

    def with_the_first_known(self, axes: list[int]) -> "Block":
        """The block of whose first known point only some coordinates are known."""
        covariance_m2 = self.control.covariance_m2.copy()
        unknown = np.setdiff1d(EVERYTHING, axes)
        covariance_m2[0, unknown, unknown] = np.inf
        return replace(self, control=replace(self.control, covariance_m2=covariance_m2))

    def without_the_first(self) -> ControlGround:
        """The other known points."""
        return self.control.take(np.arange(1, len(self.control)))

    def judged(self, active: BoolArray) -> BoolArray:
        """The known points that agree after a solution in which some take part."""
        priors = block_priors(self.images, [], self.control.frame_covariances())
        n_points = int(self.observations.point[-1]) + 1
        problem = BlockProblem(
            self.images, self.observations, self.control, BlockOptions(), n_points, priors.size
        )
        parts = block_parts(problem)
        state = robust_start(parts, priors)[0]
        weights = Weights(np.ones(len(self.observations)), active.astype(np.float64))
        first = normals(parts, state.place, weights)
        gauge = checked_gauge(parts, first)
        solved = least_squares(parts, priors, gauge, first)
        of_images = len(self.images) * priors.size
        accuracy = block_accuracy(solved.system, parts.pairs, gauge, of_images)
        told = judged(parts, solved, accuracy)[2]
        return agreeing_control(self.control.known_coordinates(), told, active)


@pytest.fixture(scope="module")
def block() -> Block:
    geometries = ring_of_geometries(3)
    ties = make_ties(geometries, np.random.default_rng(5), 30, 0.2)
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=8.0, order="shift")
        for g in geometries
    ]
    own_m2 = np.diag(OWN_SIGMA_M**2)
    control = ground_of(np.arange(KNOWN), ties.lon_lat_h[:KNOWN], own_m2, EXACT_FRAME)
    return Block(images, ties.observations, control)


def largest_m(block: Block, axis: int, known: list[int]) -> float:
    """How far off the first point may be along a known axis: by the block of the others alone."""
    others = adjust_block(block.images, block.observations, control=block.without_the_first())
    predicted_m2 = others.point_covariance_m2[0] + others.frames[0].covariance_m2
    spread_m2 = predicted_m2 + block.control.covariance_m2[0]
    inverse = np.linalg.inv(spread_m2[np.ix_(known, known)])
    towards = np.eye(3)[axis, known]
    misfit_m = difference_m(block.control.lon_lat_h[:1], others.lon_lat_h[:1])[0, known]
    # (misfit + s towards)^2 = limit, for the larger s.
    a, b = towards @ inverse @ towards, towards @ inverse @ misfit_m
    c = misfit_m @ inverse @ misfit_m - chi2.ppf(STAYS, len(known))
    return float((-b + np.sqrt(b**2 - a * c)) / a)


@pytest.mark.parametrize(
    ("axis", "known", "shared_m"),
    [
        (0, EVERYTHING, 5.0),
        (1, EVERYTHING, 0.001),
        (2, EVERYTHING, 5.0),
        (1, PLACE, 5.0),
        (2, HEIGHT, 0.001),
    ],
)
def test_a_known_point_leaves_and_comes_back_where_the_others_predict_it(
    block: Block, axis: int, known: list[int], shared_m: float
) -> None:
    """What all known points share contradicts none of them."""
    block = block.with_the_first_known(known)
    limit_m = largest_m(block, axis, known)
    frames = (Frame.from_sigmas(shared_m, shared_m),)
    shared = replace(block, control=replace(block.control, frames=frames))
    for share, agrees in ((0.95, True), (1.05, False)):
        moved = shared.moved(share * limit_m * np.eye(3)[axis])
        expected = ALL if agrees else ALL_BUT_THE_FIRST
        assert moved.judged(ALL).tolist() == expected.tolist()
        assert moved.judged(ALL_BUT_THE_FIRST).tolist() == expected.tolist()


def test_a_wrong_point_leaves_alone_although_it_draws_the_block_from_the_others(block: Block) -> None:
    moved = block.moved(np.array([15.0, 0.0, 0.0]))
    assert moved.judged(ALL).tolist() == ALL_BUT_THE_FIRST.tolist()


def test_of_points_that_took_no_part_the_best_comes_back_first(block: Block) -> None:
    of_two = np.array([False, False, True, True])
    moved = block.moved(np.array([0.9, 0.0, 0.0]))
    assert moved.judged(of_two).tolist() == ALL_BUT_THE_FIRST.tolist()
    assert moved.judged(ALL_BUT_THE_FIRST).tolist() == ALL.tolist()


@pytest.mark.parametrize("agrees", [True, False])
@pytest.mark.parametrize("known", [(True, True, True), (True, True, False), (False, False, True)])
def test_a_single_ray_holds_a_point_whose_position_is_known_and_agrees(
    block: Block, known: tuple[bool, ...], agrees: bool
) -> None:
    """A height alone checks no ray, and other points need two."""
    variance = np.where(np.diag(known), block.control.covariance_m2, 0.0)
    unknown = np.diag(np.where(known, 0.0, np.inf))
    control = replace(block.control, covariance_m2=np.where(unknown > 0.0, np.inf, variance))
    priors = block_priors(block.images, [], control.frame_covariances())
    seen = block.observations
    n_points = int(seen.point[-1]) + 1
    problem = BlockProblem(block.images, seen, control, BlockOptions(), n_points, priors.size)
    of_known, of_other = 0, KNOWN + 3
    first = np.concatenate([[True], np.diff(seen.point) > 0])
    far = np.isin(seen.point, [of_known, of_other]) & ~first
    square = np.where(far, 1e6, 1.0)
    left = active_observations(
        problem, square, np.ones(len(seen), dtype=np.bool_), 1.0, np.full(KNOWN, agrees)
    )
    checked = agrees and known[0]
    expected = ~np.isin(seen.point, [of_known, of_other])
    expected |= first & (seen.point == of_known) & checked
    assert left.tolist() == expected.tolist()
