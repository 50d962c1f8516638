"""Points of older blocks in new images: found where the images show them, and numbered as known."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.control_ground import ControlGround
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, render_chip
from amers.services.matching.multi_image import stored_chip
from amers.services.production.control import Control, MeasuredPoints, with_control
from amers.services.production.control_points import ControlBlock, find_control
from amers.services.production.marked_control import MarkedGround
from amers.services.production.placed_block import find_in_block, moved_points
from amers.services.simulation.orbit import pushbroom_over
from amers.services.tasks import Work
from amers.services.types import (
    Acquisition,
    Array,
    ControlPoints,
    Frame,
    Observations,
    Views,
    no_progress,
)
from tests.services.production.displaced_details import (
    GSD_M,
    drawn_details,
    east_north_m,
    map_moved,
)
from tests.services.simulated import MemoryChips

SIDE = 3
OWN, OLDER = Frame.from_sigmas(2.2, 1.0), Frame.from_sigmas(1.4, 0.5)
"""Of the new images and of the block."""
a_tenth_of_a_pixel = 0.1


def sees(scene: Scene, off_m: Array) -> Scene:
    """The scene with a model that is off."""
    return replace(scene, model=map_moved(drawn_details(SIDE).model, off_m))


@cache
def images(east_m: float = 6.0, north_m: float = -5.0) -> tuple[Scene, ...]:
    """Three images, the last of which shows no detail."""
    details = drawn_details(SIDE)
    still, off_m = np.zeros((SIDE**2, 2)), np.array([east_m, north_m])
    two = [details.scene(f"image {k}", still, 3.0, noise=0.1 * (k + 1)) for k in range(2)]
    pixels = np.full(details.shape, np.nan, dtype=np.float32)
    return (*(sees(one, off_m) for one in two), replace(sees(two[0], off_m), image=ArrayImage(pixels)))


def older(name: str, rows: list[int], frame: Frame = OLDER) -> ControlBlock:
    """A block of some details, which chips of 2 m and of 8 m show."""
    details = drawn_details(SIDE)
    scene = details.scene("older", np.zeros((SIDE**2, 2)), 1.0)
    n, lon_lat_h = len(rows), details.lon_lat_h[rows]
    gsds_m = np.tile([GSD_M, 4.0 * GSD_M], n)
    chips = [
        stored_chip(render_chip(scene.image, scene.model, ground, gsd_m))
        for ground, gsd_m in zip(np.repeat(lon_lat_h, 2, axis=0), gsds_m, strict=True)
    ]
    points = ControlPoints(
        id=100 + np.array(rows),
        lon_lat_h=lon_lat_h,
        covariance_m2=np.array([np.diag([row + 1.0, row + 2.0, 3.0]) for row in rows]),
        block=np.zeros(n, dtype=np.int64),
        frames=(frame,),
        saliency=np.ones(n),
        health=np.ones(n),
        views=Views(
            start=2 * np.arange(n + 1),
            gsd_m=gsds_m,
            image=np.zeros(2 * n, dtype=np.int64),
            incidence_deg=np.zeros(2 * n),
            azimuth_deg=np.zeros(2 * n),
            health=np.ones(2 * n),
            images=(scene.acquisition,),
        ),
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=2 * np.arange(n),
        chip_files=("chips",),
    )
    return ControlBlock(name, points, MemoryChips(np.array(chips)))


def found_in(
    blocks: list[ControlBlock], first_point: int = 0, scenes: tuple[Scene, ...] | None = None
) -> tuple[Observations, ControlGround]:
    scenes = images() if scenes is None else scenes
    return find_control(scenes, OWN, blocks, first_point=first_point, work=Work(), progress=no_progress)


def rows_of(known: ControlGround) -> list[int]:
    """The details that the names of known points mean."""
    return [int(name.split(":")[1]) - 100 for name in known.names]


def check_positions(observations: Observations, known: ControlGround) -> None:
    """Points are observed where the images show the detail of their name."""
    shown = drawn_details(SIDE).model.project(drawn_details(SIDE).lon_lat_h)
    for number, row in zip(known.point, rows_of(known), strict=True):
        own = observations.point == number
        np.testing.assert_array_equal(observations.image[own], [0, 1])
        expected = np.tile(shown[row], (2, 1))
        np.testing.assert_allclose(observations.line_sample[own], expected, atol=a_tenth_of_a_pixel)


def test_points_are_observed_where_images_show_them_and_known_where_their_blocks_have_them() -> None:
    observations, known = found_in([older("one", [0, 4, 7, 8]), older("two", [2, 4, 5])], 50)
    assert [name[:3] for name in known.names] == ["one"] * 4 + ["two"] * 3
    assert rows_of(known) == [0, 4, 7, 8, 2, 4, 5]
    np.testing.assert_array_equal(known.point, 50 + np.arange(7))
    check_positions(observations, known)
    rows = rows_of(known)
    off_m = east_north_m(drawn_details(SIDE).lon_lat_h[rows], known.lon_lat_h)
    np.testing.assert_allclose(off_m, 0.0, atol=1e-6)
    np.testing.assert_allclose(known.covariance_m2[:, 0, 0], np.array(rows) + 1.0)
    assert (observations.sigma_px > 0.0).all()


def test_every_block_has_the_frame_of_its_own() -> None:
    other = Frame.from_sigmas(1.0, 0.9)
    _, known = found_in([older("one", [0, 4, 7]), older("two", [2, 4, 5], other)])
    sigmas_m = [known.frames[source].sigma_m for source in known.source]
    np.testing.assert_allclose(sigmas_m, [1.4] * 3 + [1.0] * 3)


def test_three_points_place_a_block_and_two_do_not() -> None:
    assert len(found_in([older("one", [0, 4]), older("two", [8])])[1]) == 3
    with pytest.raises(NotEnoughPoints, match="one, two in two images or more"):
        found_in([older("one", [0]), older("two", [8])])


def test_a_point_that_one_image_shows_is_not_found() -> None:
    with pytest.raises(NotEnoughPoints):
        found_in([older("one", [0, 1, 4, 8])], scenes=images()[1:])


def test_an_image_of_other_ground_changes_nothing() -> None:
    """Its number stays with it, before those that show the points or behind them."""
    far = sees(images()[0], np.array([50_000.0, 0.0]))
    block = older("one", [0, 4, 7])
    observations, known = found_in([block], scenes=images()[:2])
    for at in range(3):
        scenes = [*images()[:2]]
        scenes.insert(at, far)
        beside, known_beside = found_in([block], scenes=tuple(scenes))
        np.testing.assert_array_equal(beside.line_sample, observations.line_sample)
        np.testing.assert_array_equal(beside.point, observations.point)
        np.testing.assert_array_equal(beside.image, observations.image + (observations.image >= at))
        assert known_beside.names == known.names


def test_points_are_searched_as_far_as_both_frames_reach_and_no_farther() -> None:
    """Three standard deviations of 2.2 and of 1.4 m are 4 chip pixels, and 4 more are tried: 16 m."""
    block = older("one", [0, 1, 2, 3, 4, 5])
    assert len(found_in([block], scenes=images(0.0, 14.0))[1]) == 6
    with pytest.raises(NotEnoughPoints):
        found_in([block], scenes=images(0.0, 18.0))


def marked(name: str, lon_lat_h: Array, shown: Array) -> MarkedGround:
    """Ground (n, 3) marked in two images at positions (2, n, 2)."""
    count = len(lon_lat_h)
    marks = Observations(
        np.repeat(np.arange(count), 2),
        np.tile([0, 1], count),
        shown.swapaxes(0, 1).reshape(-1, 2),
        np.ones(2 * count),
    )
    sigma_m, frame = np.full((count, 3), 0.5), Frame.from_sigmas(0.1, 0.2)
    return MarkedGround(tuple(f"{name}{row}" for row in range(count)), lon_lat_h, sigma_m, frame, marks)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_three_known_points_are_enough_where_the_rays_of_a_block_meet(count: int) -> None:
    """Marked in images that look from two sides, in a block that lies off; its points are elsewhere."""
    off_m, own = np.array([30.0, -20.0, 12.0]), older("own", [0, 4]).points
    target = own.lon_lat_h[0] + [0.0, 0.0, 50.0]
    models = [
        pushbroom_over(target, (400, 400), 1.0, (25.0, azimuth_deg), (0.0, 300.0))
        for azimuth_deg in (80.0, 250.0)
    ]
    blank = ArrayImage(np.zeros((400, 400), dtype=np.float32))
    scenes = [Scene(blank, model, Acquisition(f"image {k}"), 1.0) for k, model in enumerate(models)]
    at = np.random.default_rng(6).uniform(-60.0, 60.0, (count, 3))
    in_block = move_metres(np.tile(target, (count, 1)), at)
    shown = np.stack([model.project(in_block) for model in models])
    control = Control(
        marked=(marked("mark", move_metres(in_block, -np.tile(off_m, (count, 1))), shown),)
    )
    if count < 3:
        with pytest.raises(NotEnoughPoints):
            find_in_block(scenes, own, control)
        return
    found = find_in_block(scenes, own, control)
    assert found.known.names == tuple(f"mark{row}" for row in range(count))
    np.testing.assert_allclose(east_north_m(in_block, found.lon_lat_h), 0.0, atol=1e-3)
    np.testing.assert_allclose(found.lon_lat_h[:, 2], in_block[:, 2], atol=1e-3)
    assert (np.linalg.eigvalsh(found.covariance_m2) > 0.0).all()
    moved = moved_points(own, off_m)
    np.testing.assert_allclose(east_north_m(own.lon_lat_h, moved.lon_lat_h), [off_m[:2]] * 2, atol=1e-3)
    np.testing.assert_allclose(moved.lon_lat_h[:, 2], own.lon_lat_h[:, 2] + off_m[2])


def test_points_of_a_block_of_its_blocks_and_of_marks_are_numbered_one_after_the_other() -> None:
    details, scenes = drawn_details(SIDE), images()[:2]
    own = details.lon_lat_h[:4] + [0.0, 0.0, 10.0]
    shown = details.model.project(details.lon_lat_h)
    measures = Observations(
        np.repeat(np.arange(4), 2), np.tile([0, 1], 4), np.repeat(shown[:4], 2, axis=0), np.ones(8)
    )

    control = Control(
        blocks=(older("one", [0, 4, 7]), older("two", [2, 5])),
        marked=tuple(
            replace(
                marked("", details.lon_lat_h[rows], np.stack([shown[rows]] * 2)),
                names=tuple(f"{name}:{100 + row}" for row in rows),
            )
            for name, rows in (("red", [1, 6]), ("blue", [3, 8, 0]))
        ),
    )
    observations, known = with_control(
        scenes, MeasuredPoints(own, OWN, GSD_M, measures), control, work=Work(), progress=no_progress
    )
    np.testing.assert_array_equal(known.point, 4 + np.arange(10))
    np.testing.assert_array_equal(np.unique(observations.point), np.arange(14))
    np.testing.assert_array_equal(observations.line_sample[:8], measures.line_sample)
    check_positions(observations, known)
    assert known.by_hand is not None
    np.testing.assert_array_equal(known.by_hand, [False] * 5 + [True] * 5)
