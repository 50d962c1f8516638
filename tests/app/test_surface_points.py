"""`amers surface points`: the cells of a surface as a point cloud that other programs read."""

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasterio.transform import from_origin

from amers.app.errors import InputError
from amers.app.usecases.surface_points import write_surface_points
from amers.services.errors import CoverageError
from amers.services.formats.images.surfaces import BANDS, heights_crs
from amers.services.map_grid import MapGrid
from tests.command_line import amers_here
from tests.geotiffs import write_geotiff

CORNER = (698_000.0, 4_792_000.0)
GSD_M = 0.5
SHAPE = (1100, 40)
a_millimetre = 1e-3


@pytest.fixture(scope="module")
def surface(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plane with a gap, of more than one window."""
    path = tmp_path_factory.mktemp("surface") / "surface.tif"
    lines, samples = np.indices(SHAPE)
    height_m = 100.0 + 0.1 * lines + 0.03 * samples
    height_m[10:20] = np.nan
    bands = np.stack([height_m, 0.2 + 0.01 * samples, lines % 5, np.isnan(height_m) * 5])
    grid = MapGrid("EPSG:32631", np.zeros(2), np.eye(2), SHAPE)
    write_bands(path, bands, heights_crs(grid), BANDS)
    return path


def write_bands(path: Path, bands: np.ndarray, crs: str, names: tuple[str, ...]) -> None:
    place = from_origin(*CORNER, GSD_M, GSD_M)
    write_geotiff(
        path, bands.astype(np.float32), names=names, nodata=float("nan"), crs=crs, transform=place
    )


@pytest.mark.parametrize("name", ["cloud.laz", "cloud.las"])
def test_every_cell_with_a_height_is_a_point_at_its_centre(
    surface: Path, tmp_path: Path, name: str
) -> None:
    done = amers_here(["surface", "points", surface, "-o", tmp_path / name, "--json"], {"PATH": ""})
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    with rasterio.open(surface) as file:
        height_m, sigma_m, views, _ = file.read()
    known = np.isfinite(height_m)
    cloud = laspy.read(tmp_path / name)
    x, y, z = (np.asarray(values) for values in (cloud.x, cloud.y, cloud.z))
    assert record["points"] == len(cloud.points) == known.sum()
    assert record["highest_m"] == pytest.approx(np.nanmax(height_m))
    lines = np.round((CORNER[1] - y) / GSD_M - 0.5).astype(int)
    samples = np.round((x - CORNER[0]) / GSD_M - 0.5).astype(int)
    assert known[lines, samples].all()
    assert len(np.unique(lines * SHAPE[1] + samples)) == len(lines)
    assert np.abs(CORNER[0] + (samples + 0.5) * GSD_M - x).max() < a_millimetre
    assert np.abs(CORNER[1] - (lines + 0.5) * GSD_M - y).max() < a_millimetre
    assert np.abs(z - height_m[lines, samples]).max() < a_millimetre
    np.testing.assert_array_equal(cloud["sigma_m"], sigma_m[lines, samples])
    np.testing.assert_array_equal(cloud["views"], views[lines, samples])
    assert cloud.header.are_points_compressed == name.endswith(".laz")
    assert cloud.header.maxs[2] == pytest.approx(np.nanmax(height_m), abs=a_millimetre)


def test_the_reference_system_says_that_heights_are_above_the_ellipsoid(
    surface: Path, tmp_path: Path
) -> None:
    write_surface_points(surface, tmp_path / "cloud.laz")
    with laspy.open(tmp_path / "cloud.laz") as file:
        text = file.header.vlrs.get("WktCoordinateSystemVlr")[0].string
        assert file.header.global_encoding.wkt
    assert 'VERT_DATUM["WGS 84 ellipsoid",2002]' in text
    crs = CRS.from_user_input(text)
    assert crs.to_2d() == CRS("EPSG:32631")
    assert crs.axis_info[2].name == "Ellipsoidal height"


def test_less_precise_cells_are_left_out(surface: Path, tmp_path: Path) -> None:
    largest_m = float(np.float32(0.2 + 0.01 * 10))
    cloud = write_surface_points(surface, tmp_path / "cloud.laz", max_sigma_m=largest_m)
    assert laspy.read(cloud.path)["sigma_m"].max() == np.float32(largest_m)
    assert cloud.points == (SHAPE[0] - 10) * 11
    older = cloud.path.read_bytes()
    with pytest.raises(
        CoverageError, match=r"no cell has a height with a standard deviation of at most"
    ):
        write_surface_points(surface, cloud.path, max_sigma_m=0.1)
    assert cloud.path.read_bytes() == older
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.laz"]


def test_what_is_no_surface_or_no_cloud_is_refused(surface: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.tif"
    write_bands(other, np.zeros((1, *SHAPE)), "EPSG:32631", ("height",))
    for file, output, said in (
        (other, "cloud.laz", "bands height found, height_m, sigma_m, views, reason on a map expected"),
        (surface, "cloud.xyz", r"a name that ends with \.laz or \.las expected"),
    ):
        with pytest.raises(InputError, match=said):
            write_surface_points(file, tmp_path / output)
    with pytest.raises(InputError, match="would replace the surface"):
        write_surface_points(surface, surface)
