"""`amers surface difference`: surfaces that do not lie on each other, and what changed between them."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from amers.app.errors import InputError
from amers.app.usecases.surface_difference import DIFFERENCE_BANDS, write_surface_difference
from amers.services.errors import CoverageError
from amers.services.formats.images.surfaces import BANDS, heights_crs
from amers.services.map_grid import MapGrid, lon_lat_of_xy, xy_of_lon_lat
from amers.services.types import Array
from tests.command_line import amers_here
from tests.geotiffs import write_geotiff

UTM, NEXT_UTM = "EPSG:32631", "EPSG:32632"
CORNER = (698_000.0, 4_792_000.0)
GSD_M, SHAPE = 0.5, (600, 700)
SIGMA_M = 0.2
SHIFT_M = (1.3, -0.8, 4.5)
"""By which the later surface has to be moved."""
BUILT_M = 6.0
a_tenth_of_a_cell = 0.1 * GSD_M
two_centimetres = 0.02


def ground_m(xy: Array) -> Array:
    """Hills, and a street."""
    east, north = (xy - CORNER).T
    hills = 100.0 + 6.0 * np.sin(east / 17.0) + 5.0 * np.cos(north / 23.0 + east / 40.0)
    return np.asarray(hills - 2.0 * (np.abs(east - 150.0) < 4.0))


def built(xy: Array) -> Array:
    """Where a house was built."""
    east, north = (xy - CORNER).T
    return np.asarray((np.abs(east - 100.0) < 10.0) & (np.abs(north + 100.0) < 10.0))


def write_surface(
    path: Path,
    *,
    later: bool = False,
    crs: str = UTM,
    gsd_m: float = GSD_M,
    flat: bool = False,
    corner: tuple[float, float] = CORNER,
) -> Path:
    """Write a surface with noise; the later one is off, and has a house."""
    rng = np.random.default_rng(int(later))
    shape = tuple(round(n * GSD_M / gsd_m) for n in SHAPE)
    centre = np.array([[corner[0] + 150.0, corner[1] - 150.0]])
    place = xy_of_lon_lat(crs, lon_lat_of_xy(UTM, centre))[0] + [-150.0, 150.0]
    grid = MapGrid(crs, place, np.array([[0.0, gsd_m], [-gsd_m, 0.0]]), shape)
    cells = np.indices(shape).reshape(2, -1).T.astype(np.float64)
    xy = xy_of_lon_lat(UTM, grid.lon_lat(cells))
    true_xy = xy + np.array(SHIFT_M[:2]) * later
    height_m = (np.full(len(xy), 100.0) if flat else ground_m(true_xy)) - SHIFT_M[2] * later
    height_m = height_m + BUILT_M * (built(true_xy) & later) + rng.normal(0.0, SIGMA_M, len(xy))
    image = height_m.reshape(shape)
    image[300:320, 40:80] = np.nan
    bands = np.stack([image, np.full(shape, SIGMA_M), np.full(shape, 2), np.isnan(image) * 7])
    corner_of_pixel = grid.origin_xy + [-gsd_m / 2.0, gsd_m / 2.0]
    profile = {"nodata": float("nan"), "crs": heights_crs(grid)}
    transform = from_origin(*corner_of_pixel, gsd_m, gsd_m)
    write_geotiff(path, bands.astype(np.float32), names=BANDS, transform=transform, **profile)
    return path


def test_the_shift_is_found_and_the_house_is_what_changed(tmp_path: Path) -> None:
    earlier = write_surface(tmp_path / "earlier.tif")
    later = write_surface(tmp_path / "later.tif", later=True)
    words = ["surface", "difference", earlier, later, "-o", tmp_path / "d.tif", "--json"]
    done = amers_here(words, {"PATH": ""})
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["moved_horizontally"]
    assert found["shift_m"][:2] == pytest.approx(SHIFT_M[:2], abs=a_tenth_of_a_cell)
    assert found["shift_m"][2] == pytest.approx(SHIFT_M[2], abs=two_centimetres)
    off_m = np.array(found["shift_m"]) - SHIFT_M
    assert (np.abs(off_m) < 3.5 * np.array(found["shift_sigma_m"])).all()
    assert max(found["shift_sigma_m"]) < a_tenth_of_a_cell
    assert found["median_m"] == pytest.approx(0.0, abs=two_centimetres)
    # Bilinear interpolation makes the noise of one of them smaller.
    assert SIGMA_M < found["nmad_m"] <= 2.0**0.5 * SIGMA_M * 1.02
    assert 0.7 < found["spread"] < 1.05
    page = (tmp_path / "d.html").read_text(encoding="utf-8")
    assert found["report"] == str(tmp_path / "d.html")
    assert "later.tif less earlier.tif" in page
    for shift_m, sigma_m in zip(found["shift_m"], found["shift_sigma_m"], strict=True):
        assert f"<td>{shift_m:.3f}</td><td>{sigma_m:.3f}</td>" in page
    assert page.count("<svg viewBox") == 2
    with rasterio.open(tmp_path / "d.tif") as file:
        assert file.descriptions == DIFFERENCE_BANDS
        difference_m, sigma_m, significance = file.read()
        cells = np.indices(file.shape).reshape(2, -1)
        xy = np.column_stack(file.xy(*cells, offset="center")).reshape(*file.shape, 2)
    inside = built(xy.reshape(-1, 2)).reshape(file.shape)
    known = np.isfinite(difference_m)
    assert np.median(difference_m[inside]) == pytest.approx(BUILT_M, abs=2 * two_centimetres)
    assert sigma_m[known] == pytest.approx(2.0**0.5 * SIGMA_M, abs=1e-4)
    assert significance[inside].mean() == pytest.approx(BUILT_M / sigma_m[inside].mean(), rel=0.1)
    assert (np.abs(significance[known & ~inside]) > 3.0).mean() < 0.015  # edges of house and street
    assert found["changed"] == pytest.approx((np.abs(significance[known]) > 3.0).mean(), abs=1e-6)
    assert found["known"] == pytest.approx(known.mean(), abs=1e-6)
    assert not known[305:315, 50:70].any()


def test_surfaces_of_other_maps_and_cells_are_compared_on_the_coarser_cells(tmp_path: Path) -> None:
    earlier = write_surface(tmp_path / "earlier.tif", crs=NEXT_UTM, gsd_m=1.0)
    later = write_surface(tmp_path / "later.tif", later=True)
    found = write_surface_difference(earlier, later, tmp_path / "d.tif")
    assert found.gsd_m == pytest.approx(1.0)
    assert "zone 32N" in found.crs
    # The axes of both maps are turned against each other by 4 degrees.
    assert np.hypot(*found.shift_m[:2]) == pytest.approx(np.hypot(*SHIFT_M[:2]), abs=0.1)
    assert found.shift_m[2] == pytest.approx(SHIFT_M[2], abs=two_centimetres)
    assert found.known > 0.8


def test_without_alignment_all_of_a_shift_is_a_difference(tmp_path: Path) -> None:
    earlier = write_surface(tmp_path / "earlier.tif")
    later = write_surface(tmp_path / "later.tif", later=True)
    found = write_surface_difference(earlier, later, tmp_path / "d.tif", align=False)
    assert (found.shift_m, found.aligned_cells) == ((0.0, 0.0, 0.0), 0)
    assert found.median_m == pytest.approx(-SHIFT_M[2], abs=0.2)
    assert "was not moved (--no-align)" in found.report.read_text(encoding="utf-8")


def test_flat_ground_tells_no_position(tmp_path: Path) -> None:
    earlier = write_surface(tmp_path / "earlier.tif", flat=True)
    later = write_surface(tmp_path / "later.tif", later=True, flat=True)
    found = write_surface_difference(earlier, later, tmp_path / "d.tif")
    assert not found.moved_horizontally
    assert found.shift_m[:2] == (0.0, 0.0)
    assert found.shift_m[2] == pytest.approx(SHIFT_M[2], abs=two_centimetres)
    assert "too flat to tell a shift east and north" in found.report.read_text(encoding="utf-8")


def test_surfaces_apart_and_outputs_over_inputs_are_refused(tmp_path: Path) -> None:
    earlier = write_surface(tmp_path / "earlier.tif")
    apart = write_surface(tmp_path / "apart.tif", corner=(CORNER[0] + 5000.0, CORNER[1]))
    for align in (True, False):
        with pytest.raises(CoverageError, match="do not show the same ground"):
            write_surface_difference(earlier, apart, tmp_path / "d.tif", align=align)
    with pytest.raises(InputError, match="would replace a surface"):
        write_surface_difference(earlier, apart, apart)
    assert not (tmp_path / "d.tif").exists()
