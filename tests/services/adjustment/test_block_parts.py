"""A block in parts is the block of one solve: parameters, covariances, what leaves, also interrupted."""

from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amers.services.adjustment import block_parts, dissection, reduced_system
from amers.services.adjustment.block_parts import Parts
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.parameters import ImageParameters
from amers.services.errors import DisconnectedBlock
from amers.services.geodesy import move_metres
from amers.services.tasks import Arrays, Here, Work
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations
from benchmarks.block_adjustment import large_block
from tests.services.adjustment.grounds import ground_of

N_IMAGES, PER_IMAGE = 64, 60
of_a_sigma = 0.01
of_a_variance = 0.02
"""How far parts may be off one solve: sigmas of parameters, and covariances."""
rounding = 1e-7


InParts = Callable[..., set[int]]


@pytest.fixture(scope="module")
def block() -> tuple[Array, list[ImageParameters], Observations, list[BoolArray]]:
    return large_block(N_IMAGES, PER_IMAGE, seed=3, blunders=0.05)


@pytest.fixture
def in_parts(monkeypatch: pytest.MonkeyPatch) -> InParts:
    """Makes parts of a block that is small, and groups of its parameters; tells the sizes of levels."""
    level, sizes = dissection._level, set()

    def told(of: Any, matrix: Any, *others: Any) -> Any:
        sizes.add(matrix.shape[0])
        return level(of, matrix, *others)

    def make(observations: int = 700) -> set[int]:
        monkeypatch.setattr(dissection, "_level", told)
        monkeypatch.setattr(block_parts, "PART_OBSERVATIONS", observations)
        monkeypatch.setattr(dissection, "GROUP_ROWS", 60)
        monkeypatch.setattr(dissection, "DIRECT_ROWS", 120)
        monkeypatch.setattr(dissection, "_MOST_SEPARATING", 0.8)
        monkeypatch.setattr(reduced_system, "DENSE_ROWS", 60)
        monkeypatch.setattr(reduced_system, "_AT_ONCE", 50)
        return sizes

    return make


def control_of(truth: Array, point: IntArray) -> ControlGround:
    """Known points in two frames; the first point is 15 m off, the second has no known height."""
    rng = np.random.default_rng(4)
    frame_m = rng.normal(0.0, 0.8, (2, 3))
    error_m = rng.normal(0.0, 0.3, (len(point), 3)) + frame_m[np.arange(len(point)) % 2]
    error_m[0] += 15.0
    frames = (Frame.from_sigmas(0.8, 0.8), Frame.from_sigmas(0.8, 0.8))
    known = ground_of(point, move_metres(truth[point], error_m), np.eye(3) * 0.09, *frames)
    known.covariance_m2[1, 2, 2] = np.inf
    return known


def agree(parts: BlockAdjustment, whole: BlockAdjustment) -> None:
    """Within the tolerances that were asked for, and in fact within rounding."""
    np.testing.assert_array_equal(parts.active, whole.active)
    np.testing.assert_array_equal(parts.control_active, whole.control_active)
    np.testing.assert_array_equal(parts.group, whole.group)
    assert parts.iterations == whole.iterations
    sigma = np.sqrt(whole.accuracy.variance())[: whole.values.size].reshape(whole.values.shape)
    off = np.abs(parts.values - whole.values) / np.where(sigma > 0.0, sigma, 1.0)
    assert off.max() < min(of_a_sigma, rounding)
    own = np.sqrt(np.diagonal(whole.point_covariance_m2, 0, 1, 2))
    for one, other in (
        (parts.point_covariance_m2, whole.point_covariance_m2),
        (parts.point_shared_m2, whole.point_shared_m2),
    ):
        off = np.abs(one - other) / (own[:, :, None] * own[:, None, :])
        np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
        assert np.nanmax(off) < min(of_a_variance, rounding)
    np.testing.assert_allclose(parts.accuracy.variance(), whole.accuracy.variance(), rtol=rounding)
    pairs = whole.accuracy.pairs
    np.testing.assert_array_equal(parts.accuracy.pairs.other, pairs.other)
    sigma = np.sqrt(np.diagonal(whole.accuracy.relative[pairs.start[:-1]], 0, 1, 2))
    first = np.repeat(np.arange(len(sigma)), np.diff(pairs.start))
    scale = sigma[first][:, :, None] * sigma[pairs.other][:, None, :]
    off = np.abs(parts.accuracy.relative - whole.accuracy.relative)
    assert (off <= rounding * scale).all()
    for mine, its in zip(parts.frames, whole.frames, strict=True):
        np.testing.assert_allclose(mine.covariance_m2, its.covariance_m2, rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(mine.shared_m2, its.shared_m2, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("with_control", [False, True])
def test_parts_give_the_block_of_one_solve(block: Any, in_parts: InParts, with_control: bool) -> None:
    truth, images, observations, passes = block
    point = np.unique(observations.point)[:: len(truth) // 12].astype(np.int64)
    control = control_of(truth, point) if with_control else NO_CONTROL
    whole = adjust_block(images, observations, control=control, passes=passes)
    levels, work = in_parts(), Work()
    parts = adjust_block(images, observations, control=control, passes=passes, work=work)
    assert len(levels) > 1, "groups, and groups of what separates them"
    assert work.effort["adjust"].tasks > 4 * N_IMAGES
    if with_control:
        assert not parts.control_active[0]
        assert parts.control_active[2:].all()
    agree(parts, whole)


def test_a_pass_of_all_images_does_not_join_the_parts(block: Any, in_parts: InParts) -> None:
    """Images whose time is unknown may all be of one pass."""
    _, images, observations, _ = block
    passes = [np.ones(len(images), dtype=np.bool_)]
    whole = adjust_block(images, observations, passes=passes)
    in_parts()
    agree(adjust_block(images, observations, passes=passes), whole)


def test_an_image_without_neighbours_stays_as_delivered(block: Any, in_parts: InParts) -> None:
    _, images, observations, passes = block
    alone = replace(images[0], name="alone")
    passes = [np.append(mask, False) for mask in passes]
    whole = adjust_block([*images, alone], observations, passes=passes)
    in_parts()
    parts = adjust_block([*images, alone], observations, passes=passes)
    assert parts.group[-1] == -1
    np.testing.assert_array_equal(parts.values[-1], 0.0)
    agree(parts, whole)


def cut(observations: Observations) -> Observations:
    """The observations of points that images of one half alone see."""
    half = observations.image < N_IMAGES // 2
    number = int(observations.point.max()) + 1
    both = np.bincount(observations.point, half, number), np.bincount(observations.point, ~half, number)
    apart = (both[0] == 0) | (both[1] == 0)
    own = observations.take(apart[observations.point])
    kept, point = np.unique(own.point, return_inverse=True)
    assert len(kept) > N_IMAGES
    return replace(own, point=point.astype(np.int64))


def test_groups_that_nothing_connects_need_control_of_each(block: Any, in_parts: InParts) -> None:
    _, images, observations, passes = block
    apart = cut(observations)
    problem = BlockProblem(images, apart, NO_CONTROL, BlockOptions(), int(apart.point[-1]) + 1, 6)
    point = np.unique(apart.point)[:: len(np.unique(apart.point)) // 20].astype(np.int64)
    ground = control_of(problem.start(), point)
    # One frame for each half, as their points are only known in their own.
    first = np.unique(apart.point, return_index=True)[1]
    of_half = (
        apart.image[first[np.searchsorted(np.unique(apart.point), point)]] >= N_IMAGES // 2
    ).astype(np.int64)
    control = replace(
        ground,
        source=of_half,
        covariance_m2=np.tile(np.eye(3) * 900.0, (len(point), 1, 1)),
        frames=(Frame.from_sigmas(5.0, 5.0), Frame.from_sigmas(5.0, 5.0)),
    )
    whole = adjust_block(images, apart, control=control, passes=passes)
    in_parts()
    with pytest.raises(DisconnectedBlock, match="2 groups"):
        adjust_block(images, apart, passes=passes)
    parts = adjust_block(images, apart, control=control, passes=passes)
    assert set(parts.group) == {0, 1}
    agree(parts, whole)


def test_a_block_in_parts_is_tied_to_a_neighbour(block: Any, in_parts: InParts) -> None:
    _, images, observations, _ = block
    before = np.flatnonzero(np.arange(N_IMAGES) < 40)
    own = observations.take(observations.image < 40)
    own = own.take(np.bincount(own.point)[own.point] >= 2)
    neighbour = adjust_block([images[i] for i in before], own).known
    later = observations.take(observations.image >= 25)
    later = later.take(np.bincount(later.point)[later.point] >= 2)
    later = replace(later, image=later.image - 25)
    whole = adjust_block(images[25:], later, neighbour=neighbour)
    in_parts()
    agree(adjust_block(images[25:], later, neighbour=neighbour), whole)


class Killed(Exception):
    """A worker that is lost."""


class Dying(Executor):
    """Computes so many tasks, then is lost."""

    def __init__(self, tasks: int) -> None:
        self.left, self.here = tasks, Here()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.left -= 1
        if self.left < 0:
            raise Killed
        return self.here.submit(fn, *args, **kwargs)


def test_an_interrupted_adjustment_goes_on_bit_for_bit(block: Any, in_parts: InParts) -> None:
    """In the robust start, and in the rounds of least squares."""
    _, images, observations, passes = block
    in_parts(2000)
    complete = Work()
    whole = adjust_block(images, observations, passes=passes, work=complete)
    for share in (0.3, 0.8):
        kept: dict[str, Arrays] = {}
        tasks = int(share * complete.effort["adjust"].tasks)
        with pytest.raises(Killed):
            adjust_block(images, observations, passes=passes, work=Work(Dying(tasks), kept))
        rest = Work(kept=kept)
        again = adjust_block(images, observations, passes=passes, work=rest)
        assert rest.effort["adjust"].tasks < complete.effort["adjust"].tasks - tasks // 2
        same_bits(again, whole)


def same_bits(one: BlockAdjustment, other: BlockAdjustment) -> None:
    for name in ("values", "lon_lat_h", "point_covariance_m2", "residual_px", "active", "determined"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.sigma_px == other.sigma_px


@pytest.mark.long
def test_other_processes_make_the_same_block_bit_for_bit(block: Any, in_parts: InParts) -> None:
    _, images, observations, passes = block
    in_parts(2000)
    whole = adjust_block(images, observations, passes=passes)
    with ProcessPoolExecutor(2) as executor:
        work = Work(executor, ahead=3)
        same_bits(adjust_block(images, observations, passes=passes, work=work), whole)


def test_every_observation_is_in_one_part_of_at_most_its_share(block: Any, in_parts: InParts) -> None:
    _, images, observations, _ = block
    in_parts()
    problem = BlockProblem(
        images, observations, NO_CONTROL, BlockOptions(), int(observations.point[-1]) + 1, 6
    )
    parts: Parts = block_parts.block_parts(problem)
    assert len(parts) > 5
    rows = np.concatenate(parts.observations)
    np.testing.assert_array_equal(np.sort(rows), np.arange(len(observations)))
    # Points belong to the group of their first image, so that sizes differ by what lies across.
    assert max(map(len, parts.observations)) < 1.5 * 700
    # A part does not see all images.
    assert np.mean([len(blocks) for blocks in parts.blocks]) < N_IMAGES / 2
