"""A plan of a region of 10,000 km² from a catalogue alone: its tiles, bytes and hours."""

import json
from pathlib import Path
from typing import Any

import pytest

from amers.app.usecases.base.making import plan
from amers.app.usecases.base.request import BaseRequest

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
