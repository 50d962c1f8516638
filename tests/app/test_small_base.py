"""A base of two tiles and a few dates, whose errors are known: where its points are, and its update."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import shapely
from rasterio.transform import Affine
from scipy.ndimage import gaussian_filter, map_coordinates

from amers import open_block
from amers.app.errors import InputError
from amers.app.usecases.base.made import MadeBase, report_folder
from amers.app.usecases.base.making import _accuracy, make_base
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.base.updating import update_base
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.block.reader import read_document
from amers.services.imagery.archives import COPERNICUS_DEM, SENTINEL_2
from amers.services.map_grid import lon_lat_of_xy, xy_of_lon_lat
from amers.services.types import Array
from tests.open_archive import GEOID_M, write_cog, write_geoid

pytestmark = pytest.mark.long

UTM = "EPSG:32631"
GSD_M = 10.0
WEST, NORTH = 700_000.0, 4_832_000.0
SHAPE = (420, 520)
"""Lines and samples of a tile."""
LEFT = {"31TGJ": 0, "31TGK": 300}
"""Tiles by the sample of the ground at which they begin."""
REGION_M = (2_800.0, 1_200.0, 6_200.0, 2_600.0)
"""From WEST and NORTH: to the east, and down; both tiles show a part of it."""
ERRORS_M = {
    "2022-03-04": (9.0, -7.0),
    "2022-07-06": (-8.0, 5.0),
    "2023-04-05": (3.0, 9.0),
    "2023-08-09": (-6.0, -4.0),
}
"""Errors of the dates, east and north; the first two have the base, the others its update."""
ORBITS = {"2022-03-04": 22, "2022-07-06": 65, "2023-04-05": 22, "2023-08-09": 65}
HIDDEN = {"2022-07-06": 0.2, "2023-04-05": 0.1}
"""Shares of the region under clouds."""
CLOUDY = "2022-05-06"
OPTIONS = BaseOptions(dates=2, spacing_m=400.0, min_clear=60.0)


class Ground:
    """What is there: smooth noise, and heights on a slope."""

    def __init__(self) -> None:
        size = SHAPE[0] + 40, SHAPE[1] + LEFT["31TGK"] + 40
        noise = gaussian_filter(np.random.default_rng(3).normal(size=size), 1.3)
        self.picture = 3000.0 + 600.0 * noise / noise.std()

    def at(self, xy: Array) -> Array:
        """Its light at places (…, 2) of the map."""
        column, row = np.moveaxis((xy - [WEST - 200.0, NORTH + 200.0]) / [GSD_M, -GSD_M] - 0.5, -1, 0)
        return np.asarray(map_coordinates(self.picture, [row, column], order=3))


GROUND = Ground()


def height_m(lon_lat: Array) -> Array:
    return 300.0 + 2000.0 * (lon_lat[..., 0] - 5.5) - 1000.0 * (lon_lat[..., 1] - 43.6)


def box(west: float, top: float, east: float, bottom: float) -> tuple[float, ...]:
    """The bounds in degrees of a part of the ground, metres from its corner."""
    corners = np.array([[x, y] for x in (west, east) for y in (top, bottom)]) * [1.0, -1.0]
    lon_lat = lon_lat_of_xy(UTM, corners + [WEST, NORTH])
    return (*lon_lat.min(axis=0).tolist(), *lon_lat.max(axis=0).tolist())


def item(folder: Path, tile: str, day: str, hidden: float) -> dict[str, object]:
    """A granule: its files, and what the catalogue states of it."""
    left = WEST + LEFT[tile] * GSD_M
    transform = Affine(GSD_M, 0.0, left, 0.0, -GSD_M, NORTH)
    at = np.stack(np.meshgrid(*(np.arange(size) + 0.5 for size in SHAPE[::-1])), axis=-1)
    seen = GROUND.at(at * [GSD_M, -GSD_M] + [left, NORTH] - np.array(ERRORS_M.get(day, (0.0, 0.0))))
    classes = np.full(SHAPE, 4, dtype=np.uint8)
    west, top, east, bottom = REGION_M
    classes[int(top / GSD_M) : int((top + hidden * (bottom - top)) / GSD_M)] = 9
    noise = np.random.default_rng(LEFT[tile] + int(day[5:7])).normal(0.0, 15.0, SHAPE)
    name = f"S2A_{tile}_{day.replace('-', '')}_0_L2A"
    write_cog(folder / f"{name}_red.tif", np.rint(seen + noise).astype(np.uint16), UTM, transform)
    write_cog(folder / f"{name}_scl.tif", classes, UTM, transform)
    west, south, east, north = box(
        LEFT[tile] * GSD_M, 0.0, (LEFT[tile] + SHAPE[1]) * GSD_M, SHAPE[0] * GSD_M
    )
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": name,
        "collection": "sentinel-2-l2a",
        "geometry": shapely.geometry.mapping(shapely.box(west, south, east, north)),
        "properties": {
            "datetime": f"{day}T10:30:00Z",
            "platform": "sentinel-2a",
            "eo:cloud_cover": 0.0,
            "grid:code": f"MGRS-{tile}",
            "sat:relative_orbit": ORBITS.get(day, 22),
            "s2:processing_baseline": "05.10",
        },
        "assets": {kind: {"href": f"{name}_{kind}.tif"} for kind in ("red", "scl")},
        "links": [],
    }


def heights(folder: Path) -> dict[str, object]:
    """The terrain above the geoid."""
    west, south, east, north = box(-3_000.0, -3_000.0, 12_000.0, 8_000.0)
    step = 1.0 / 3600.0
    lon_lat = np.stack(np.meshgrid(np.arange(west, east, step), np.arange(north, south, -step)), -1)
    transform = Affine(step, 0.0, west - step / 2.0, 0.0, -step, north + step / 2.0)
    above = (height_m(lon_lat) - GEOID_M).astype(np.float32)
    write_cog(folder / "dem.tif", above, "EPSG:4326", transform, nodata=-32767.0)
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": "dem",
        "collection": "cop-dem-glo-30",
        "geometry": shapely.geometry.mapping(shapely.box(west, south, east, north)),
        "properties": {"datetime": "2021-04-22T00:00:00Z"},
        "assets": {"data": {"href": "dem.tif"}},
        "links": [],
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two catalogues: of the first year, and of both."""
    folder = tmp_path_factory.mktemp("small")
    write_geoid(folder / "geoid.gtx", (5.5, 43.6))
    clouds = {CLOUDY: 0.45, **dict.fromkeys(ERRORS_M, 0.0), **HIDDEN}
    items = [item(folder, tile, day, share) for tile in LEFT for day, share in sorted(clouds.items())]
    for name, until in (("first", "2022"), ("all", "2023")):
        chosen = [one for one in items if one["properties"]["datetime"][:4] <= until]  # type: ignore[index]
        document = {"type": "FeatureCollection", "features": [*chosen, heights(folder)]}
        (folder / f"{name}.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def base(folder: Path) -> MadeBase:
    request = BaseRequest(
        "sentinel-2", (str(folder / "first.json"),), bbox=box(*REGION_M), geoid=folder / "geoid.gtx"
    )
    place = WorkPlace(folder / "work")
    return make_base(request, folder / "base", BlockIdentity("small"), OPTIONS, place=place)


@pytest.fixture(scope="module")
def updated(base: MadeBase, folder: Path) -> MadeBase:
    return update_base(folder / "work", folder / "next", catalogues=(str(folder / "all.json"),))


@pytest.fixture(params=["base", "next"])
def made(request: pytest.FixtureRequest) -> tuple[MadeBase, str]:
    """A base and the folder of its block: the first version, and the next one."""
    name = {"base": "base", "next": "updated"}[request.param]
    return request.getfixturevalue(name), request.param


def days(made: MadeBase) -> list[str]:
    return [date[:10] for date in made.placed.dates]


def off_m(made: MadeBase) -> Array:
    """By what the base is off for each of its dates: east and north."""
    true_m = np.array([ERRORS_M[day] for day in days(made)])
    return np.asarray(true_m - made.placed.frames.error_m)


def test_all_dates_are_in_one_frame(made: tuple[MadeBase, str]) -> None:
    base, _ = made
    assert np.ptp(off_m(base), axis=0).max() < 0.1 * GSD_M
    apart_m = [np.subtract(ERRORS_M[a], ERRORS_M[b]) for a in days(base) for b in days(base)]
    assert base.placed.frames.apart_m == pytest.approx(np.hypot(*np.transpose(apart_m)).max(), abs=1.0)
    assert [len(tile.images) for tile in base.placed.tiles] == [len(days(base))] * 2
    assert base.placed.frames.orbits == 2


def test_points_of_both_tiles_lie_where_the_base_shows_their_ground(
    made: tuple[MadeBase, str], folder: Path
) -> None:
    base, name = made
    block, common_m = open_block(folder / name), off_m(base).mean(axis=0)
    xy = xy_of_lon_lat(UTM, block.points.lon_lat_h[:, :2])
    place = (xy - [WEST, NORTH]) * [1.0, -1.0]
    west, top, east, bottom = REGION_M
    assert ((place > [west - 150.0, top - 150.0]) & (place < [east + 150.0, bottom + 150.0])).all()
    assert set(np.digitize(place[:, 0], [west + 1_000.0, east - 1_000.0])) == {0, 1, 2}
    above_m = block.points.lon_lat_h[:, 2] - height_m(block.points.lon_lat_h)
    np.testing.assert_allclose(above_m, 0.0, atol=0.5)
    step = np.arange(-7, 8) * GSD_M
    around = np.stack(np.meshgrid(step, -step), axis=-1)
    for row, (first, last) in enumerate(pairwise(block.points.views.start)):
        chips = block.chips_of(row)[block.points.views.gsd_m[first:last] == GSD_M, 43:58, 43:58]
        assert len(chips) >= 2
        moves = [(0.0, 0.0), (8.0, 0.0), (-8.0, 0.0), (0.0, 8.0), (0.0, -8.0)]
        expected = [GROUND.at(xy[row] - common_m + move + around) for move in moves]
        for chip in chips:
            likeness = [np.corrcoef(chip.ravel(), one.ravel())[0, 1] for one in expected]
            assert likeness[0] == max(likeness) > 0.9


def test_clouds_of_the_mask_leave_images_out_and_are_stated(base: MadeBase) -> None:
    assert base.left_out
    for words in base.left_out:
        assert re.fullmatch(
            rf"S2A_31TG[JK]_{CLOUDY.replace('-', '')}_0_L2A: 5\d % of the region is clear", words
        )
    for name, clear in base.clear.items():
        day = f"{name[10:14]}-{name[14:16]}-{name[16:18]}"
        assert clear == pytest.approx(1.0 - HIDDEN.get(day, 0.0), abs=0.06), name


def test_the_report_and_the_block_state_what_was_made(made: tuple[MadeBase, str], folder: Path) -> None:
    base, name = made
    report = json.loads((report_folder(folder / name) / "report.json").read_text())
    points, images = base.points, {one["name"]: one for one in report["images"]}
    of_view = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    for number, image in enumerate(points.views.images):
        shown = images.pop(image.image_id)
        assert shown["points"] == len(set(of_view[points.views.image == number]))
        assert shown["clear_percent"] == pytest.approx(100.0 * base.clear[image.image_id])
        day = days(base).index(shown["date"][:10])
        assert shown["error_m"] == pytest.approx(base.placed.frames.error_m[day])
    assert images == {}
    metadata = read_document(folder / name).metadata
    assert (metadata.id, metadata.version) == ("small", {"base": "1", "next": "2"}[name])
    assert metadata.specification.points_per_km2 == pytest.approx(1000.0**2 / 400.0**2)
    assert metadata.specification.gsds_m == (GSD_M, 4.0 * GSD_M)
    years = {"base": "2022", "next": "2022-2023"}[name]
    assert f"Copernicus Sentinel data {years}" in metadata.description
    assert (metadata.frame.sigma_m, metadata.frame.sigma_up_m) == pytest.approx(
        (base.placed.frames.sigma_m, COPERNICUS_DEM.accuracy[0].common_m)
    )
    stated = {figure.name: figure for figure in metadata.accuracy}
    assert stated["frame_sigma_m"].value == pytest.approx(base.placed.frames.sigma_m)
    # The dates are further apart than their producer states.
    assert base.placed.frames.sigma_m > base.placed.frames.stated_m
    assert stated["frame_sigma_m"].against == f"the disagreement of {len(days(base))} dates of 2 orbits"


def test_an_update_keeps_half_as_many_dates_again_and_lets_the_oldest_go(
    base: MadeBase, updated: MadeBase, folder: Path, tmp_path: Path
) -> None:
    assert days(base) == sorted(ERRORS_M)[:2]
    assert days(updated) == sorted(ERRORS_M)[1:]
    with pytest.raises(InputError, match=r"no image of|no newer image"):
        update_base(folder / "work", tmp_path / "again")


@pytest.mark.parametrize("more_m", [0.0, 0.1])
def test_the_dates_tell_the_accuracy_only_where_they_are_worse_than_the_producer_states(
    base: MadeBase, more_m: float
) -> None:
    frames = replace(base.placed.frames, sigma_m=base.placed.frames.stated_m + more_m, orbits=0)
    figures = _accuracy(replace(base, placed=replace(base.placed, frames=frames)), SENTINEL_2)
    assert figures[0].value == frames.sigma_m
    expected = "the disagreement of 2 dates of 1 orbits" if more_m else "the statement of the producer"
    assert figures[0].against.startswith(expected)
    assert [one.name for one in figures] == ["frame_sigma_m", "dates_apart_m", "local_sigma_m"]
    unknown = _accuracy(replace(base, local_sigma_m=float("nan")), SENTINEL_2)
    assert [one.name for one in unknown] == ["frame_sigma_m", "dates_apart_m"]
