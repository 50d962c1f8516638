"""Points keep their places and views, and gain those that registered scenes are fine enough for."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.new_points import NewPoints
from amers.services.production.renewed_views import (
    RenewedViews,
    SeeingScene,
    with_new_points,
    with_new_views,
)
from amers.services.types import Acquisition, ControlPoints, Frame, SurfaceHeights
from tests.factories import affine_model, control_points
from tests.services.simulated import MemoryChips

CENTRE = np.array([5.25, 43.25])
NEAR = (5.2499, 43.2499, 5.2501, 43.2501)
GSDS_M = 0.5, 1.0
SIDE_PX = 700
OLD, FINE, COARSE = 100, 3000, 4000
"""Grey values: of the first old chip of a point, and of the scenes."""


def scene(name: str, gsd_m: float, grey: int) -> Scene:
    """A scene of one grey value, with the points in its middle."""
    model = affine_model(CENTRE)
    scale = model.image_scale * 0.5 / gsd_m
    centred = replace(model, image_offset=np.full(2, SIDE_PX / 2.0), image_scale=scale)
    pixels = np.full((SIDE_PX, SIDE_PX), grey, dtype=np.float32)
    return Scene(ArrayImage(pixels), centred, Acquisition(name), 5.0)


def old_points(count: int, surface: SurfaceHeights | None = None) -> tuple[ControlPoints, MemoryChips]:
    """Points of two images; the chips of each have the grey values 100, 101, 102 and 103."""
    points = control_points(count, np.random.default_rng(1), NEAR, n_images=2, gsds_m=GSDS_M)
    views = 2 * len(GSDS_M)
    grey = OLD + np.tile(np.arange(views), count)
    chips = np.broadcast_to(grey[:, None, None], (len(grey), CHIP_SIZE, CHIP_SIZE)).astype(np.uint16)
    placed = replace(
        points,
        lon_lat_h=np.column_stack([points.lon_lat_h[:, :2], np.full(count, 200.0)]),
        chip_row=np.arange(count) * views,
        chip_files=("old",),
        frames=(Frame(np.eye(3), np.diag([1.0, 4.0, 9.0])),),
        surface=surface,
    )
    return placed, MemoryChips(chips)


def renewed() -> RenewedViews:
    """Four points; a scene of 0.5 m shows three of them, and one of 1.1 m shows two."""
    points, chips = old_points(4)
    fine = SeeingScene(scene("fine", 0.5, FINE), np.array([0, 2, 3]))
    coarse = SeeingScene(scene("coarse", 1.1, COARSE), np.array([1, 2]))
    return with_new_views(points, chips, [fine, coarse])


def shown(of: RenewedViews, row: int) -> list[tuple[float, str, int]]:
    """Ground sampling, image and grey value of the views of a point."""
    views, chips = of.points.views, of.chips(row)
    rows = range(views.start[row], views.start[row + 1])
    assert len(chips) == len(rows)
    return [
        (float(views.gsd_m[k]), views.images[views.image[k]].image_id, int(np.median(chip)))
        for k, chip in zip(rows, chips, strict=True)
    ]


OLD_FINE = [(0.5, "IMG_00", OLD), (0.5, "IMG_01", OLD + 1)]
OLD_COARSE = [(1.0, "IMG_00", OLD + 2), (1.0, "IMG_01", OLD + 3)]
FINE_VIEWS = [(0.5, "fine", FINE)], [(1.0, "fine", FINE)]
COARSE_VIEW = [(1.0, "coarse", COARSE)]


def test_new_views_follow_the_old_ones_at_each_sampling_that_a_scene_is_fine_enough_for() -> None:
    made = renewed()
    of_fine = OLD_FINE + FINE_VIEWS[0] + OLD_COARSE + FINE_VIEWS[1]
    assert shown(made, 0) == shown(made, 3) == of_fine
    assert shown(made, 1) == OLD_FINE + OLD_COARSE + COARSE_VIEW
    assert shown(made, 2) == of_fine + COARSE_VIEW
    assert [rows.tolist() for rows in made.gained] == [[0, 2, 3], [1, 2]]


def test_a_scene_that_shows_a_chip_in_part_adds_none() -> None:
    points, chips = old_points(2)
    pixels = np.full((SIDE_PX, SIDE_PX), FINE, dtype=np.float32)
    whole = scene("cut", 0.5, FINE)
    pixels[: SIDE_PX // 2] = np.nan
    cut = replace(whole, image=ArrayImage(pixels))
    made = with_new_views(points, chips, [SeeingScene(cut, np.array([0, 1]))])
    assert shown(made, 0) == OLD_FINE + OLD_COARSE
    assert made.gained[0].size == 0


@pytest.mark.parametrize("known", [True, False])
def test_new_points_follow_with_views_of_the_same_scenes_and_unknown_surfaces(known: bool) -> None:
    """The scenes are named in another order; what the new points share is more along one axis."""
    first = renewed()
    surface = SurfaceHeights(np.arange(4.0), np.ones(4)) if known else None
    first = replace(first, points=replace(first.points, surface=surface))
    images = first.points.views.images
    points = control_points(3, np.random.default_rng(2), NEAR, n_images=2, gsds_m=GSDS_M)
    views = replace(points.views, images=(images[3], images[2]))
    frame = Frame(np.eye(3), np.diag([2.0, 1.0, 9.0]))
    points = replace(points, views=views, frames=(frame,))
    grey = np.full((4, CHIP_SIZE, CHIP_SIZE), 7, dtype=np.uint16)
    both = with_new_points(first, NewPoints(points, (), lambda row: grey + np.uint16(row)))
    assert [shown(both, row) for row in range(4)] == [shown(first, row) for row in range(4)]
    names = ["coarse", "fine", "coarse", "fine"]
    for row in range(3):
        found = shown(both, 4 + row)
        assert [name for _, name, _ in found] == names
        assert [value for _, _, value in found] == [7 + row] * 4
    np.testing.assert_array_equal(both.points.lon_lat_h[4:], points.lon_lat_h)
    np.testing.assert_allclose(both.points.frames[0].shared_m2, np.diag([2.0, 4.0, 9.0]))
    if known:
        assert both.points.surface is not None
        np.testing.assert_array_equal(both.points.surface.height_m, [0.0, 1.0, 2.0, 3.0, *[np.nan] * 3])
    else:
        assert both.points.surface is None
