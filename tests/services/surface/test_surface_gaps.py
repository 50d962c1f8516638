"""Where images are saturated, have no data, or show water, no height is made up, and why is said."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.surface.match import Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.surface import make_surface, surface_tiles
from amers.services.types import Array, BoolArray
from tests.services.surface.worlds import Compared, compared_scenes, grid, scene, town

UNFILLED = SurfaceOptions(fill_cells=0)
LOOKS = ("left", "right", "down")
HALF_PX, INNER_CELLS = 40, 30
three_sigma = 3.0


def place() -> Array:
    """A place (3,) on open ground, 30 m south and west of the middle."""
    centre = np.append(town().centre_lon_lat, 0.0)[None, :]
    ground = move_metres(centre, np.array([[-30.0, -30.0, 0.0]]))
    return np.append(ground[0, :2], town().surface_m(ground[:, :2]))


def spoiled(look: str, value: float) -> Scene:
    """A view with a square of 40 m around the place that has one value."""
    view = scene(look)
    pixels = view.image.read(Window(0, 0, *view.image.shape)).copy()
    line, sample = np.rint(view.model.project(place()[None, :])[0]).astype(int)
    pixels[line - HALF_PX : line + HALF_PX, sample - HALF_PX : sample + HALF_PX] = value
    return replace(view, image=ArrayImage(pixels))


def views(count: int, *without: int, value: float = np.inf) -> Compared:
    """The surface of some views, some of which show nothing around the place."""
    looks = enumerate(LOOKS[:count])
    scenes = [spoiled(look, value) if k in without else scene(look) for k, look in looks]
    return compared_scenes(scenes, UNFILLED)


def inside() -> tuple[slice, slice]:
    """The cells around the place that are inside the square in all views."""
    line, sample = np.rint(grid().line_sample(place()[None, :2])[0]).astype(int)
    return (
        slice(line - INNER_CELLS, line + INNER_CELLS),
        slice(sample - INNER_CELLS, sample + INNER_CELLS),
    )


@pytest.mark.parametrize("value", [np.inf, np.nan])
@pytest.mark.parametrize("without", [(0,), (1,), (0, 1)])
def test_a_pair_tells_nothing_of_what_one_of_both_does_not_show(
    without: tuple[int, ...], value: float
) -> None:
    found = views(2, *without, value=value)
    reason = Reason.SATURATED if np.isposinf(value) else Reason.NO_DATA
    assert np.isnan(found.height_m[inside()]).all()
    assert (found.reason[inside()] == reason).all()
    other = Reason.NO_DATA if np.isposinf(value) else Reason.SATURATED
    assert (found.reason != other).all()
    assert (found.reason[np.isfinite(found.height_m)] == Reason.FOUND).all()


def test_other_views_tell_what_one_does_not_show() -> None:
    found = views(3, 0)
    error_m, sigma_m = found.error_m[inside()], found.sigma_m[inside()]
    assert np.isfinite(error_m).all()
    assert (np.abs(error_m) > three_sigma * sigma_m).mean() < 0.01
    assert np.quantile(np.abs(error_m), 0.95) < 1.0


def test_what_no_view_shows_is_saturated() -> None:
    found = views(3, 0, 1, 2)
    assert (found.reason[inside()] == Reason.SATURATED).all()


def test_empty_cells_on_stated_water_say_so_and_others_do_not() -> None:
    west_lon = place()[0]

    def water(lon_lat: Array) -> BoolArray:
        return np.asarray(lon_lat[:, 0] < west_lon)

    surface = make_surface([spoiled("left", np.inf), scene("right")], UNFILLED, grid=grid())
    plain, stated = (
        np.concatenate([tile.reason.ravel() for tile in surface_tiles(surface, water=mask)])
        for mask in (None, water)
    )
    assert len(list(surface_tiles(surface))) == 1
    cells = np.indices(grid().shape).reshape(2, -1).T.astype(np.float64)
    wet = water(grid().lon_lat(cells)) & (plain != Reason.FOUND)
    assert wet.any()
    np.testing.assert_array_equal(stated, np.where(wet, Reason.WATER, plain))
