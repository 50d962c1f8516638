"""Chips of many points as pages of a GeoTIFF, opened by GDAL."""

import json

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal
from pyproj import Transformer
from rasterio.io import MemoryFile

from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.chips.images import format_chip_tiff
from amers.services.formats.chips.tiff_pages import stream_chips_tiff
from amers.services.types import point_chips
from tests.factories import make_block

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
