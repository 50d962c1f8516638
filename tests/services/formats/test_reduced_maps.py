"""Maps in files, read with fewer cells."""

from pathlib import Path

import numpy as np
import pytest

from amers.services.errors import FormatError
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.surfaces import read_reduced
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoWindow

ORIGIN_XY = np.array([698_000.0, 4_792_000.0])
SHAPE = (700, 1300)


def test_cells_of_a_reduced_map_lie_where_their_values_are(tmp_path: Path) -> None:
    grid = MapGrid("EPSG:32631", ORIGIN_XY, np.array([[0.0, 0.5], [-0.5, 0.0]]), SHAPE)
    cells = np.indices(SHAPE).reshape(2, -1).T.astype(np.float64)
    offset = (grid.xy(cells) - ORIGIN_XY).T.reshape(2, *SHAPE).astype(np.float32)
    path = tmp_path / "map.tif"
    form = BandForm(2, "float32", float("nan"), names=("x", "y"), overviews="NEAREST")
    write_cog(path, grid, [OrthoWindow(Window(0, 0, *SHAPE), offset, 0.0)], form)
    bands, reduced = read_reduced(path, 100)
    assert bands.shape == (2, 54, 100)
    assert reduced.shape == (54, 100)
    at = np.indices(reduced.shape).reshape(2, -1).T.astype(np.float64)
    off = bands.reshape(2, -1).T - (reduced.xy(at) - ORIGIN_XY)
    assert np.abs(off).max() < reduced.step_xy.max()  # the nearest of the cells inside of it
    whole, same = read_reduced(path, 2000)
    assert np.array_equal(whole, offset)
    assert same.step_xy == pytest.approx(grid.step_xy)
    assert same.origin_xy == pytest.approx(grid.origin_xy)


def test_an_image_without_a_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.tif"
    write_raster(path, np.ones((20, 20), dtype=np.uint16), None)
    with pytest.raises(FormatError, match="no reference system found"):
        read_reduced(path, 100)
