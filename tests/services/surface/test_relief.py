"""Heights in colours, under a light from the north-west."""

import numpy as np
import pytest

from amers.services.surface.relief import HEIGHT_COLOURS, colours_of, relief, shown_range
from amers.services.types import Array

LIMITS_M = (0.0, 100.0)
one_step = 1


def rgb(colour: str) -> Array:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])


def test_values_get_the_colours_of_the_ramp_and_none_is_transparent() -> None:
    values = np.array([-5.0, 0.0, 50.0, 100.0, 900.0, np.nan])
    pixels = colours_of(values, LIMITS_M, ("#000000", "#640a32"))
    assert pixels[:5, :3].tolist() == [[0, 0, 0], [0, 0, 0], [50, 5, 25], [100, 10, 50], [100, 10, 50]]
    assert pixels[:, 3].tolist() == [255] * 5 + [0]


def test_flat_ground_keeps_its_colour_and_gaps_cast_no_shade() -> None:
    height_m = np.zeros((5, 6), dtype=np.float32)
    height_m[2, 3] = np.nan
    pixels = relief(height_m, 1.0, LIMITS_M)
    assert (pixels[2, 3, 3], pixels[0, 0, 3]) == (0, 255)
    known = pixels[pixels[:, :, 3] > 0]
    assert (np.abs(known[:, :3] - rgb(HEIGHT_COLOURS[0])) <= one_step).all()


@pytest.mark.parametrize(("faces", "brighter"), [((-1, 1), True), ((1, -1), False)])
def test_slopes_that_face_the_north_west_are_lit(faces: tuple[int, int], brighter: bool) -> None:
    """A slope faces where its heights fall to."""
    north, east = np.mgrid[8.0:0.0:-1.0, 0.0:8.0]
    height_m = (20.0 - 0.5 * (faces[0] * east + faces[1] * north)).astype(np.float32)
    lit = relief(height_m, 1.0, (0.0, 0.0))[3, 3, :3].astype(int).sum()
    flat = relief(np.full((8, 8), 20.0, dtype=np.float32), 1.0, (0.0, 0.0))[3, 3, :3].astype(int).sum()
    assert bool(lit > flat) == brighter


def test_the_range_leaves_out_what_is_rare() -> None:
    values = np.linspace(10.0, 20.0, 1001).astype(np.float32)
    values[:3] = -400.0
    assert shown_range(values) == pytest.approx((10.1, 19.9), abs=0.02)
    assert shown_range(np.full(3, np.nan, dtype=np.float32)) == (0.0, 1.0)
