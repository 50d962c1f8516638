"""Chips of many points as pages of a GeoTIFF, opened by GDAL, and as a NumPy archive."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal
from pyproj import Transformer
from rasterio.io import MemoryFile

from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.chips import stacks
from amers.services.formats.chips.images import format_chip_tiff
from amers.services.formats.chips.stacks import chip_runs, stream_chips_npz
from amers.services.formats.chips.tiff_pages import stream_chips_tiff
from amers.services.types import point_chips
from tests.factories import control_points, make_block

a_micrometre = 1e-6


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.long
def test_gdal_reads_each_page_like_the_geotiff_of_the_single_chip(tmp_path, dtype):
    folder = make_block(tmp_path / "block", count=5, dtype=dtype).folder
    points, chips = read_block(folder).points, FolderChips(folder)
    path = tmp_path / "chips.tif"
    path.write_bytes(b"".join(stream_chips_tiff(points, chips)))
    page = 0
    for row, point in enumerate(points.id):
        for view, chip in enumerate(point_chips(points, chips, row)):
            page += 1
            gsd_m = points.views.gsd_m[points.views.start[row] + view]
            alone = format_chip_tiff(chip, points.lon_lat_h[row], float(gsd_m))
            with rasterio.open(f"GTIFF_DIR:{page}:{path}") as page_file, MemoryFile(alone) as memory:
                assert_array_equal(page_file.read(1), chip)
                assert page_file.nodata == 0
                description = json.loads(page_file.tags()["TIFFTAG_IMAGEDESCRIPTION"])
                assert (description["point_id"], description["view"], description["gsd_m"]) == (
                    point,
                    view,
                    gsd_m,
                )
                assert description["image_id"] == f"IMG_{view % 3:02d}"
                with memory.open() as expected:
                    assert_allclose(page_file.transform, expected.transform, rtol=0, atol=a_micrometre)
                    between = Transformer.from_crs(page_file.crs, expected.crs, always_xy=True)
                    assert_allclose(between.transform(25.0, -12.0), (25.0, -12.0), atol=a_micrometre)
    assert page == 30
    with pytest.raises(rasterio.RasterioIOError):
        rasterio.open(f"GTIFF_DIR:{page + 1}:{path}")


def test_unknown_metadata_of_an_image_are_null(tmp_path):
    folder = make_block(tmp_path / "block", count=1).folder
    path = tmp_path / "chips.tif"
    path.write_bytes(b"".join(stream_chips_tiff(read_block(folder).points, FolderChips(folder))))
    with rasterio.open(f"GTIFF_DIR:3:{path}") as third:
        description = json.loads(third.tags()["TIFFTAG_IMAGEDESCRIPTION"])
    assert description["acquired_at"] is None
    assert description["sun_elevation_deg"] is None


class Files:
    """Chips of several files, of which each has its own type and grey values of its own."""

    def __init__(self, **files: np.ndarray) -> None:
        self.files = files
        self.counts: list[int] = []

    def read(self, file: str, row: int, count: int) -> np.ndarray:
        self.counts.append(count)
        return self.files[file][row : row + count]


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (3, 1, 4, 0, 2)])
def test_an_archive_has_the_chips_of_all_files_in_the_type_that_holds_them(order, monkeypatch):
    """Three points of a file of bytes, and two of another one whose values need two bytes."""
    made = control_points(5, np.random.default_rng(2), n_images=2, gsds_m=(0.5, 2.0))
    grey = np.arange(20)
    values = [np.broadcast_to(g[:, None, None], (len(g), 101, 101)) for g in (grey[:12], 300 + grey[:8])]
    chips = Files(first=values[0].astype(np.uint8), second=values[1].astype(np.uint16))
    points = replace(
        made,
        chip_file=np.array([0, 0, 0, 1, 1]),
        chip_row=np.array([0, 4, 8, 0, 4]),
        chip_files=("first", "second"),
    ).take(np.array(order))
    monkeypatch.setattr(stacks, "CHIPS_PER_PIECE", 8)
    assert max(run.count for run in chip_runs(points)) <= 8
    with np.load(io.BytesIO(b"".join(stream_chips_npz(points, chips)))) as archive:
        assert archive["chips"].dtype == np.uint16
        expected = np.concatenate([np.arange(4) + [0, 4, 8, 300, 304][k] for k in order])
        assert_array_equal(archive["chips"][:, 50, 50], expected)
        assert_array_equal(archive["point_id"], np.repeat(made.id[list(order)], 4))
        assert_array_equal(archive["view"], np.tile(np.arange(4), 5))
        assert_array_equal(archive["lon_lat_h"], np.repeat(made.lon_lat_h[list(order)], 4, axis=0))
        assert_array_equal(archive["gsd_m"], points.views.gsd_m)
        assert_array_equal(
            archive["image_id"], [points.views.images[k].image_id for k in points.views.image]
        )
