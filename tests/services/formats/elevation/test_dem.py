"""Terrain from files: heights have a known datum, and voids are not heights."""

import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import from_origin

from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.elevation.filled_voids import FilledVoids
from amers.services.formats.elevation.geoid import geoid_of_grid
from amers.services.imagery.source import ArrayImage, Window
from amers.services.terrain import Terrain

a_millimetre = 1e-3
a_decimetre = 0.1
between_nodes_of_15_arc_minutes_m = 0.5

SHAPE = (60, 80)
HEIGHTS = (500.0 + 3.0 * np.indices(SHAPE)[0] - 2.0 * np.indices(SHAPE)[1]).astype(np.float32)


def write_dem(
    path: Path,
    crs: str = "EPSG:32631",
    heights: np.ndarray = HEIGHTS,
    scale_offset: tuple[float, float] | None = None,
    **options: object,
) -> Path:
    transform = from_origin(7e5, 4.8e6, 30.0, 30.0)
    if crs.startswith(("EPSG:4326", "EPSG:4979")):
        transform = from_origin(5.0, 44.0, 0.001, 0.001)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=heights.shape[0],
        width=heights.shape[1],
        count=1,
        dtype=heights.dtype,
        crs=crs,
        transform=transform,
        **options,
    ) as file:
        if scale_offset is not None:
            file.scales, file.offsets = scale_offset[:1], scale_offset[1:]
        file.write(heights, 1)
    return path


def write_geoid(path: Path, west: float = 0.0, south: float = 40.0, slope: float = 0.5) -> Path:
    """A geoid of 40 m in the south-west that rises to the north and to the east."""
    rows, columns, step = 41, 41, 0.25
    row, column = np.indices((rows, columns))
    values = (40.0 + slope * step * row + 2.0 * slope * step * column).astype(">f4")
    path.write_bytes(struct.pack(">4d2i", south, west, step, step, rows, columns) + values.tobytes())
    return path


def undulation(lon_lat: np.ndarray) -> np.ndarray:
    return 40.0 + 0.5 * (lon_lat[:, 1] - 40.0) + lon_lat[:, 0]


def nodes(terrain: Terrain) -> np.ndarray:
    position = np.random.default_rng(1).integers(1, 59, (20, 2)).astype(np.float64)
    return terrain.grid.lon_lat(position)


def test_heights_above_the_ellipsoid_are_read_unchanged(tmp_path: Path) -> None:
    terrain = read_dem(write_dem(tmp_path / "a.tif"), "ellipsoid")
    position = np.array([[0.0, 0.0], [10.5, 20.25], [59.0, 79.0]])
    expected = 500.0 + 3.0 * position[:, 0] - 2.0 * position[:, 1]
    actual_m = terrain.height_m(terrain.grid.lon_lat(position))
    np.testing.assert_allclose(actual_m, expected, atol=a_millimetre)
    # In GDAL the corner of the first pixel lies half a step before the first node.
    np.testing.assert_allclose(terrain.grid.origin_xy, [7e5 + 15.0, 4.8e6 - 15.0])
    assert terrain.posting_m == pytest.approx(30.0, rel=1e-3)


def test_the_heights_of_a_geoid_are_added_to_heights_above_it(tmp_path: Path) -> None:
    grid = write_geoid(tmp_path / "geoid of a place.gtx")
    terrain = read_dem(write_dem(tmp_path / "a.tif", "EPSG:4326+5773"), geoid=grid)
    above = read_dem(write_dem(tmp_path / "b.tif", "EPSG:4326"), "ellipsoid")
    expected = above.height_m(nodes(above)) + undulation(nodes(above))
    np.testing.assert_allclose(terrain.height_m(nodes(above)), expected, atol=a_millimetre)
    assert terrain.vertical == "EGM96 height by the file, from geoid of a place.gtx"
    low, high = terrain.range_m()
    assert low <= expected.min()
    assert high >= expected.max()


def test_a_geoid_without_its_grid_is_an_error_that_names_it(tmp_path: Path) -> None:
    """Where PROJ has the grid installed, the heights are those with the grid instead."""
    path = write_dem(tmp_path / "a.tif")
    try:
        terrain = read_dem(path, "EGM96")
    except VerticalDatumError as error:
        assert "us_nga_egm96_15.tif" in str(error)  # noqa: PT017 - either is right
    else:
        assert terrain.height_m(nodes(terrain))[0] - HEIGHTS.max() + np.ptp(HEIGHTS) + 1.0 > 40.0


@pytest.mark.parametrize(
    ("crs", "vertical", "grid", "expected"),
    [
        ("EPSG:4979", None, True, "need no geoid"),
        ("EPSG:4326", "ellipsoid", True, "need no geoid"),
        ("EPSG:4326", "mean sea level", False, "expected ellipsoid"),
    ],
)
def test_contradictory_datums_are_refused(
    tmp_path: Path, crs: str, vertical: str | None, grid: bool, expected: str
) -> None:
    geoid = write_geoid(tmp_path / "geoid.gtx") if grid else None
    with pytest.raises(VerticalDatumError, match=expected):
        read_dem(write_dem(tmp_path / "a.tif", crs), vertical, geoid)


@pytest.mark.thorough
@settings(max_examples=40)
@given(cut=st.integers(0, 6700), start=st.integers(0, 60), noise=st.binary(min_size=1, max_size=40))
def test_a_damaged_geoid_is_refused_or_still_a_geoid(
    tmp_path_factory: pytest.TempPathFactory, cut: int, start: int, noise: bytes
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    whole = write_geoid(folder / "geoid.gtx").read_bytes()
    for name, data in (
        ("cut.gtx", whole[:cut]),
        ("bad.gtx", whole[:start] + noise + whole[start + len(noise) :]),
    ):
        (folder / name).write_bytes(data)
        try:
            geoid = geoid_of_grid(folder / name)
        except VerticalDatumError:
            continue
        heights = geoid(np.array([[2.0, 41.0], [9.0, 49.0]]))
        assert heights.shape == (2,)


def test_an_image_without_a_map_grid_is_refused_as_terrain(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with rasterio.open(path, "w", driver="GTiff", height=9, width=9, count=1, dtype="int16") as file:
        file.write(np.ones((9, 9), np.int16), 1)
    with pytest.raises(FormatError, match="no reference system"):
        read_dem(path, "ellipsoid")


def test_heights_that_no_ground_has_are_voids(tmp_path: Path) -> None:
    heights = HEIGHTS.copy()
    stated_m = [-11_101.0, -11_099.0, 8_999.0, 9_001.0]
    heights[[10, 20, 30, 40], 10] = stated_m
    terrain = read_dem(write_dem(tmp_path / "a.tif", heights=heights), "ellipsoid")
    found_m = terrain.nodes()[[10, 20, 30, 40], 10]
    np.testing.assert_array_equal(found_m, [np.nan, *stated_m[1:3], np.nan])


def test_scale_and_offset_of_a_file_are_in_its_unit(tmp_path: Path) -> None:
    grid, scale_offset = write_geoid(tmp_path / "geoid.gtx"), (0.5, 400.0)
    in_feet = write_dem(tmp_path / "feet.tif", "EPSG:4326+8228", scale_offset=scale_offset)
    in_metres = write_dem(tmp_path / "metres.tif", "EPSG:4326", scale_offset=scale_offset)
    feet, metres = read_dem(in_feet, geoid=grid), read_dem(in_metres, "ellipsoid")
    expected = 0.3048 * metres.height_m(nodes(metres)) + undulation(nodes(metres))
    np.testing.assert_allclose(feet.height_m(nodes(metres)), expected, atol=a_millimetre)


def test_a_void_gets_the_heights_around_it_by_the_inverse_square_of_their_distance() -> None:
    heights = np.full((9, 9), np.nan, dtype=np.float32)
    heights[4, 5], heights[4, 2] = 10.0, 20.0
    filled = FilledVoids(ArrayImage(heights), 3).read(Window(4, 4, 1, 1))
    assert filled[0, 0] == pytest.approx((10.0 + 20.0 / 4.0) / (1.0 + 1.0 / 4.0), abs=a_millimetre)


def test_filled_voids_do_not_depend_on_the_window() -> None:
    rng = np.random.default_rng(3)
    heights = HEIGHTS.copy()
    heights[rng.random(SHAPE) < 0.2] = np.nan
    heights[20:45, 30:60] = np.nan
    filled = FilledVoids(ArrayImage(heights), 5)
    whole = filled.read(Window(0, 0, *SHAPE))
    valid = np.isfinite(heights)
    np.testing.assert_array_equal(whole[valid], heights[valid])
    part = filled.read(Window(15, 25, 20, 30))
    np.testing.assert_allclose(part, whole[15:35, 25:55], atol=a_millimetre)
    assert np.isnan(whole[30:35, 40:50]).all()
    assert np.isfinite(whole[:15]).all()
    # The void is filled from nodes within 5 nodes, of a plane that rises by 3.6 m per node.
    assert np.nanmax(np.abs(whole - HEIGHTS)) < 5 * 3.61
    assert np.isnan(filled.read(Window(-3, -3, 3, 3))).all()


@pytest.mark.real_data
def test_the_egm96_grid_gives_the_published_test_values(real_data: Path) -> None:
    """Source: NGA, test values of EGM96 for its program F477."""
    published = np.array(
        [
            [-90.2208450, 38.6281550, -31.628],
            [-54.9788860, -14.6212170, -2.969],
            [102.4487290, 46.8743190, -43.575],
            [133.8747120, -23.6174460, 15.871],
            [-0.0005000, 38.6254730, 50.066],
            [0.0023000, -0.4667440, 17.329],
        ]
    )
    actual_m = geoid_of_grid(real_data / "geoid" / "egm96_15.gtx")(published[:, :2])
    np.testing.assert_allclose(actual_m, published[:, 2], atol=between_nodes_of_15_arc_minutes_m)


@pytest.mark.real_data
def test_srtm_heights_of_the_ventoux_include_its_geoid_height(real_data: Path) -> None:
    path = real_data / "phr_ventoux_pair" / "dem" / "N44E005_UTM.tif"
    summit = np.array([[5.2786, 44.1741]])
    above_geoid = read_dem(path, "ellipsoid").height_m(summit)
    terrain = read_dem(path, "EGM96", real_data / "geoid" / "egm96_15.gtx")
    assert 1850.0 < above_geoid[0] < 1920.0
    assert terrain.height_m(summit)[0] - above_geoid[0] == pytest.approx(51.0, abs=1.0)
