"""A plan of a region of 10,000 km² from a catalogue alone: its tiles, bytes and hours."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely

from amers.app.errors import InputError
from amers.app.usecases.base import tile_points
from amers.app.usecases.base.making import plan
from amers.app.usecases.base.request import BaseOptions, BaseRequest, area_km2, area_of
from amers.app.usecases.base.search import spacing_m
from amers.app.usecases.base.tile_points import BaseTile, placed_dates
from amers.app.usecases.base.windows import WindowReader
from amers.app.usecases.new_block import BlockIdentity, block_metadata, fewest_views
from amers.services.errors import FormatError
from amers.services.formats.addresses import NoUsableReply
from amers.services.imagery.archives import SENTINEL_2
from amers.services.types import Acquisition, no_progress
from tests.command_line import amers_here
from tests.factories import control_points, metadata

TILE_DEG = 1.0, 1.36
"""Height and width of a tile of 110 km at 43 degrees; tiles overlap by a tenth."""
REGION = 5.05, 43.05, 6.28, 43.95


def item(tile: int, day: int, **more: Any) -> dict[str, Any]:
    row, column = divmod(tile, 3)
    south, west = 42.0 + 0.9 * TILE_DEG[0] * row, 4.0 + 0.9 * TILE_DEG[1] * column
    north, east = south + TILE_DEG[0], west + TILE_DEG[1]
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    year, month = 2022 + day // 36, day // 3 % 12 + 1
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": f"S2A_{tile}_{day}",
        "collection": "sentinel-2-l2a",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": {
            "datetime": f"{year}-{month:02d}-{1 + 10 * (day % 3):02d}T10:30:00Z",
            "platform": "sentinel-2a",
            "eo:cloud_cover": 7.0 * day % 90.0,
            "grid:code": f"MGRS-31T{tile}",
            "sat:relative_orbit": 22 + day % 2,
            "s2:processing_baseline": "05.10",
        },
        "assets": {"red": {"href": "red.tif"}, "scl": {"href": "scl.tif"}},
        "links": [],
        **more,
    }


@pytest.fixture
def catalogue(tmp_path: Path) -> str:
    items = [item(tile, day) for tile in range(9) for day in range(100)]
    terrain = item(4, 0, id="dem", collection="cop-dem-glo-30", assets={"data": {"href": "dem.tif"}})
    path = tmp_path / "items.ndjson"
    path.write_text("\n".join(json.dumps(one) for one in [*items, terrain]))
    return str(path)


def test_ten_thousand_km2_are_hours_and_gigabytes(catalogue: str) -> None:
    planned, candidates = plan(BaseRequest("sentinel-2", (catalogue,), bbox=REGION))
    images = [candidates.images[date.image] for date in planned.dates]
    hours = [(planned.read_s + planned.cpu_s / cores) / 3600.0 for cores in (1, 4)]
    print(
        f"{planned.area_km2:,.0f} km2, {len(planned.tiles)} tiles, {len(images)} images, "
        f"{planned.bytes / 1e9:.2f} GB, {hours[0]:.2f} h on a core, {hours[1]:.2f} h on 4 cores, "
        f"{planned.points} points"
    )
    assert planned.area_km2 == pytest.approx(10_000.0, rel=0.02)
    assert len(planned.tiles) <= 6
    assert all(image.cloud < 0.25 for image in images)
    assert 0.8e9 < planned.bytes < 3e9
    assert 0.3 < hours[0] < 3.0
    assert hours[1] < 0.6 * hours[0]
    assert planned.bytes / planned.area_km2 < 300_000.0
    assert len({image.date for image in images}) <= 12, "tiles share their dates"


def test_a_small_region_takes_a_small_part_of_the_tiles(catalogue: str) -> None:
    planned, _ = plan(BaseRequest("sentinel-2", (catalogue,), bbox=(5.5, 43.3, 5.8, 43.5)))
    share = sum(date.pixels for date in planned.dates) / planned.full_pixels
    print(f"{planned.area_km2:,.0f} km2, {share:.3f} of the pixels of the full tiles")
    assert share < 1.0 / 3.0


def test_the_plan_is_shown_as_it_is_and_more_processes_take_less_time(catalogue: str) -> None:
    words = ["base", "make", "--plan", "--from", "sentinel-2", "--catalogue", catalogue, "-o", "b"]
    shown = {
        jobs: json.loads(
            amers_here([*words, "--bbox", *map(str, REGION), "--jobs", jobs, "--json"], {}).stdout
        )
        for jobs in (1, 5)
    }
    planned, candidates = plan(BaseRequest("sentinel-2", (catalogue,), bbox=REGION))
    images = [candidates.images[date.image] for date in planned.dates]
    for jobs, row in shown.items():
        expected_s = planned.read_s + planned.cpu_s / jobs
        assert 60.0 * row.pop("minutes") == pytest.approx(expected_s, abs=3.1)
        assert row == {
            "area_km2": pytest.approx(planned.area_km2, abs=0.06),
            "tiles": [tile.tile for tile in planned.tiles],
            "dates": sorted({image.date for image in images}),
            "images": [image.id for image in images],
            "points": planned.points,
            "bytes": planned.bytes,
            "size": f"{planned.bytes / 2**30:.1f} GiB",
            "bytes_per_km2": pytest.approx(planned.bytes / planned.area_km2, abs=0.6),
            "share_of_full_tiles": pytest.approx(
                sum(date.pixels for date in planned.dates) / planned.full_pixels, abs=1e-4
            ),
            "items_left_out": 0,
        }


@pytest.mark.parametrize(
    ("side_km", "expected_m"), [(100.0, 1000.0), (4.0, 632.5), (0.5, 250.0), (0.0001, 250.0)]
)
def test_squares_are_a_hundred_pixels_less_in_small_regions_and_a_quarter_of_that_at_least(
    side_km: float, expected_m: float
) -> None:
    found = {
        gsd_m: spacing_m(BaseOptions(), replace(SENTINEL_2, gsd_m=gsd_m), side_km**2)
        for gsd_m in (10.0, 40.0)
    }
    assert found[10.0] == pytest.approx(expected_m, abs=0.1)
    assert 1000.0 <= found[40.0] <= 4000.0
    assert spacing_m(BaseOptions(spacing_m=70.0), SENTINEL_2, side_km**2) == 70.0


def test_the_area_of_a_region_is_that_of_all_its_parts_each_at_its_latitude() -> None:
    boxes = [shapely.box(0.0, 0.0, 1.0, 2.0), shapely.box(10.0, 59.5, 11.0, 60.5)]
    # A degree along the meridian and along the parallel (WGS 84), in kilometres.
    expected = [2.0 * 110.58 * 111.31, 111.41 * 55.80]
    assert [area_km2(box) for box in boxes] == pytest.approx(expected, rel=5e-3)
    assert area_km2(shapely.union_all(boxes)) == pytest.approx(sum(expected), rel=5e-3)


@pytest.mark.parametrize(
    ("box", "said"),
    [
        ((-180.0, -85.0, -179.9, -84.9), ""),
        ((179.9, 84.9, 180.0, 85.0), ""),
        ((-180.1, 0.0, -179.9, 0.1), "within 180"),
        ((0.0, 84.9, 0.1, 85.1), "within 85"),
        ((0.0, -85.1, 0.1, -85.0), "within 85"),
        ((1.0, 0.0, 1.0, 0.1), "W < E"),
        ((0.0, 0.1, 0.1, 0.1), "S < N"),
        ((0.0, 0.0, 4.0, 4.05), ""),
        ((0.0, 0.0, 4.0, 4.1), "up to 200,000 expected"),
    ],
)
def test_the_limits_of_a_region_are_its_own(box: tuple[float, float, float, float], said: str) -> None:
    request = BaseRequest("sentinel-2", ("catalogue",), bbox=box)
    if not said:
        assert area_of(request).bounds == box
        return
    with pytest.raises(InputError, match=said):
        area_of(request)


def test_the_work_stops_at_the_third_image_in_a_row_that_no_server_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was read and what was refused is remembered; what no server gave is asked for again."""
    read = {"pixels": 7, "full_pixels": 100, "clear": 0.75, "valid": 1.0}
    silence, refusal = NoUsableReply("503"), FormatError("no image")
    replies: list[Any] = [silence, silence, read, refusal, read, silence, silence, silence]
    asked, heard = list[int](), list[float]()

    def reply(_: object, tile: Any, number: int) -> dict[str, Any]:
        asked.append(number)
        if isinstance(replies[number], Exception):
            raise replies[number]
        return dict(replies[number])

    monkeypatch.setattr(WindowReader, "_read", reply)
    found: Any = SimpleNamespace(images=[SimpleNamespace(id=f"image {k}") for k in range(9)], items=[])
    tile: Any = None

    def new() -> WindowReader:
        heard.clear()
        return WindowReader(
            tmp_path, SENTINEL_2, found, BaseOptions(), lambda share, _: heard.append(share), 4
        )

    reader, taken = new(), [False, False, True, False, True, False, False]
    assert [reader.take(tile, number) for number in range(7)] == taken
    assert (reader.pixels, reader.full_pixels, heard) == (14, 200, [0.25, 0.5])
    with pytest.raises(InputError, match=r"503\. 3 images in a row were not read"):
        reader.take(tile, 7)
    assert reader.left_out == ["503", "503", "image 3: no image", "503", "503"]
    assert (reader.clear(2), reader.clear_of("image 4")) == (0.75, 0.75)
    asked.clear()
    again = new()
    assert [again.take(tile, number) for number in range(5)] == taken[:5]
    assert (asked, again.pixels, heard) == ([0, 1], 14, [0.25, 0.5])


def test_images_are_taken_from_the_first_moment_of_the_day_given(tmp_path: Path) -> None:
    items = [item(4, day, collection=kind) for day, kind in ((0, "cop-dem-glo-30"), (1, ""), (2, ""))]
    for one, moment in zip(items[1:], ("2023-04-30T23:59:59Z", "2023-05-01T00:00:00Z"), strict=True):
        one["collection"] = "sentinel-2-l2a"
        one["properties"]["datetime"] = moment
    (tmp_path / "items.json").write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    box = (5.5, 43.3, 5.6, 43.4)
    request = BaseRequest("sentinel-2", (str(tmp_path / "items.json"),), bbox=box, since="2023-05-01")
    _, candidates = plan(request)
    assert [image.id for image in candidates.images] == [items[2]["id"]]


def test_the_shifts_of_every_tile_bring_its_dates_into_one_frame(
    catalogue: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each tile has a date that the other lacks; one image is found in no other."""
    _, candidates = plan(BaseRequest("sentinel-2", (catalogue,), bbox=REGION))
    a, b, c, d = list({image.date: image for image in candidates.images}.values())[:4]
    true_m = {image.date: np.array(error) for image, error in ((a, (3, -2)), (b, (-4, 1)), (c, (2, 5)))}
    area: Any = None
    tiles = [BaseTile(area, [None] * len(of), of) for of in ([a, b], [b, c, d])]  # type: ignore[list-item]

    def tied(tile: BaseTile, *_: object) -> tuple[BaseTile, Any]:
        first = true_m[tile.images[0].date]
        unknown = np.full(2, np.nan)
        return tile, np.array([true_m.get(image.date, unknown) - first for image in tile.images])

    monkeypatch.setattr(tile_points, "_tied", tied)
    nothing: Any = None
    placed = placed_dates(tiles, nothing, 10.0, nothing, no_progress)
    assert placed.left_out == [f"{d.id}: too few of its details are found"]
    assert placed.dates == sorted(true_m)
    placed_m = [true_m[image.date] + placed.move_m(image) for image in (a, b, c)]
    assert np.ptp(placed_m, axis=0).max() < 0.2


def test_a_block_states_its_poorest_point_and_its_latest_image() -> None:
    """Images count once, at however many samplings they show a point."""
    points = control_points(3, np.random.default_rng(1), n_images=3)
    shown = np.delete(np.arange(18), [7, 8, 10, 11])
    columns = ("gsd_m", "image", "incidence_deg", "azimuth_deg", "health")
    fewer = {name: getattr(points.views, name)[shown] for name in columns}
    views = replace(points.views, start=np.array([0, 6, 8, 14]), **fewer)
    assert fewest_views(points) == 3
    assert fewest_views(replace(points, views=views)) == 1
    stated = metadata()
    days = [datetime(year, 7, 2, 12, tzinfo=UTC) for year in (2021, 2025, 2023)]
    made = block_metadata(
        BlockIdentity("valley"),
        [*(Acquisition(f"{day:%Y}", acquired_at=day) for day in days), Acquisition("undated")],
        points,
        description="",
        outline=stated.extent,
        specification=stated.specification,
        options={},
        accuracy=(),
    )
    assert made.epoch == pytest.approx(2025.5, abs=2e-3)
    assert made.provenance.sources == ("2021", "2025", "2023", "undated")
    assert (made.title, made.license) == ("valley", "proprietary")
