"""A hole in a block of the small simulated continent, with jitter and clouds, filled by other images."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import box_around, east_north_up
from amers.services.imagery.scene import Scene
from amers.services.production.image_production import ProductionOptions, produce_points
from amers.services.production.new_points import points_where_short, registered_scene, short_ground
from amers.services.registration.on_points import register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.types import Array, ControlPoints
from benchmarks._continent import Continent
from benchmarks._continent_points import common_error_m, errors_m, true_places
from tests.services.simulated import MemoryChips
from tests.services.ties import whitened_square

pytestmark = pytest.mark.endurance

HOLE_M = 400.0
SPACING_M = 200.0
OF_BLOCK, LATER = (0, 1, 3, 6), (2, 4, 7)
"""Numbers of the images by name; each set has some of all three passes."""


def scenes(continent: Continent, numbers: tuple[int, ...]) -> list[Scene]:
    names = sorted(continent.views)
    folder = continent.folder / "archive" / "images"
    return [read_scene(folder / f"{names[number]}.tif", sigma_m=5.0) for number in numbers]


def judged(
    continent: Continent, points: ControlPoints, chips: MemoryChips, common_m: Array | None = None
) -> tuple[Array, float]:
    """The error (3,) that points share, and the mean square of what is left over what is declared."""
    error_m = errors_m(points, true_places(continent, points, chips))
    known = np.isfinite(error_m).all(axis=1)
    assert known.mean() > 0.8
    error_m, covariance_m2 = error_m[known], points.covariance_m2[known]
    if common_m is None:
        common_m = common_error_m(error_m, covariance_m2, points.frames[0])
    return common_m, float(whitened_square(error_m - common_m, covariance_m2).mean())


def test_new_points_are_as_precise_as_those_of_the_block(small_continent: Continent) -> None:
    options = ProductionOptions(fine_gsd_m=2.5, coarse_gsd_m=10.0, spacing_m=SPACING_M, surface_pairs=0)
    made = produce_points(scenes(small_continent, OF_BLOCK), options)
    chips = MemoryChips(np.concatenate([made.chips(row) for row in range(len(made.points))]))
    outline = box_around(made.points.lon_lat_h)
    centre = np.array([*outline.mean(axis=0), made.points.lon_lat_h[:, 2].mean()])
    off_m = np.abs(east_north_up(made.points.lon_lat_h, centre)[:, :2]).max(axis=1)
    block = made.points.take(np.flatnonzero(off_m > HOLE_M))
    later = []
    for scene in scenes(small_continent, LATER):
        registered = register_scene(scene, block, chips, RegistrationOptions(max_points=0))
        later.append(registered_scene(scene, registered.model, registered.adjustment))
    ground = short_ground(block, outline, 1e6 / SPACING_M**2)
    new = points_where_short(later, block, ground, min_views=2)
    in_hole = np.abs(east_north_up(new.points.lon_lat_h, centre)[:, :2]).max(axis=1) < HOLE_M
    assert in_hole.sum() >= 9  # At least three squares by three lie wholly in the hole.

    n = len(new.points)
    own_chips = MemoryChips(np.concatenate([new.chips(row) for row in range(n)]))
    row = new.points.views.start[:-1]
    points = replace(new.points, chip_file=np.zeros(n, np.int64), chip_row=row, chip_files=("chips",))
    common_m, own = judged(small_continent, block, chips)
    _, of_new = judged(small_continent, points, own_chips, common_m)
    print(f"normalised {of_new:.2f} ({n} points), of the block's own {own:.2f} ({len(block)})")
    assert of_new < 1.25 * max(own, 1.0)
