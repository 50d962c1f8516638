"""Choice of dates: clear, over seasons and orbits, all ground, one product of an acquisition."""

from collections import Counter
from datetime import UTC, datetime, timedelta
from itertools import permutations

import pytest
import shapely

from amers.services.imagery.archives import SENTINEL_2, ArchiveImage
from amers.services.production.date_choice import choose_dates, places_in, tile_areas

OLD, NEW = SENTINEL_2.accuracy
AREA = shapely.box(6.1, 43.1, 6.4, 43.4)


def image(number: int, **more: object) -> ArchiveImage:
    """An image of every 30th day, orbits in turn."""
    given: dict[str, object] = {
        "id": f"image-{number:02d}",
        "acquired": datetime(2022, 1, 15, 10, tzinfo=UTC) + timedelta(days=30 * number),
        "platform": "sentinel-2a",
        "orbit": str(22 + number % 2),
        "tile": "32TLP",
        "baseline": "05.10",
        "footprint": shapely.box(6.0, 43.0, 7.0, 44.0),
        "cloud": 0.0,
        "sun_deg": (50.0, 160.0),
        "snow": 0.0,
        "offset": -1000.0,
        "accuracy": NEW,
    }
    return ArchiveImage(**(given | more))  # type: ignore[arg-type]


def chosen(images: list[ArchiveImage], dates: int = 8, refused: tuple[int, ...] = ()) -> list[int]:
    (tile,) = tile_areas(images, AREA, 0.01)
    return choose_dates(tile, images, dates, lambda number: number not in refused)


def test_dates_are_spread_over_seasons_and_orbits() -> None:
    images = [image(number) for number in range(24)]
    taken = [images[number] for number in chosen(images)]
    assert len(taken) == 8
    assert set(Counter(one.season for one in taken).values()) == {2}
    assert set(Counter(one.orbit for one in taken).values()) == {4}


def test_cloudy_snowy_and_less_accurate_dates_come_last() -> None:
    images = [image(n, cloud=0.5 if n < 4 else 0.0, snow=0.6 if 4 <= n < 8 else 0.0) for n in range(16)]
    assert min(chosen(images)) >= 8
    images = [image(n, accuracy=OLD if n % 4 else NEW) for n in range(24)]
    assert sum(images[n].accuracy is NEW for n in chosen(images, 5)) >= 4


def test_a_refused_image_is_replaced_by_the_next_one() -> None:
    images = [image(number) for number in range(24)]
    first = chosen(images)
    again = chosen(images, refused=tuple(first[:3]))
    assert len(again) == 8
    assert not set(first[:3]) & set(again)


def test_ground_that_a_swath_cuts_off_gets_its_dates_too() -> None:
    half = shapely.box(6.0, 43.0, 6.25, 44.0)
    images = [
        image(n, footprint=half if n % 2 else shapely.box(6.0, 43.0, 7.0, 44.0)) for n in range(40)
    ]
    taken = [images[number] for number in chosen(images, 6)]
    assert sum(one.footprint.area > 0.5 for one in taken) >= 6
    assert len(taken) <= 9


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_of_one_acquisition_the_latest_baseline_counts_wherever_it_is_listed(
    order: tuple[int, ...],
) -> None:
    older = image(0, id="older", baseline="02.14", accuracy=OLD)
    images = [image(0), older, image(0, id="oldest", baseline="02.04"), image(1)]
    listed = [images[k] for k in order]
    assert {listed[k].id for k in chosen(listed, 3)} == {"image-00", "image-01"}


def test_the_fewest_tiles_are_taken_each_with_its_part() -> None:
    west, east = shapely.box(5.0, 43.0, 6.2, 44.0), shapely.box(6.0, 43.0, 7.0, 44.0)
    within = shapely.box(6.0, 43.2, 6.3, 43.3)
    images = [
        image(0, tile="31TGJ", footprint=west),
        image(1, footprint=east),
        image(2, tile="32TLQ", footprint=within),
    ]
    (only,) = tile_areas(images, shapely.box(6.3, 43.1, 6.6, 43.4), 0.005)
    assert only.tile == "32TLP"
    area = shapely.box(5.7, 43.1, 6.9, 43.4)
    tiles = tile_areas(images, area, 0.005)
    assert [tile.tile for tile in tiles] == ["32TLP", "31TGJ"]
    assert sum(tile.polygon.area for tile in tiles) == pytest.approx(area.area, rel=1e-3)
    assert tiles[0].polygon.intersection(tiles[1].polygon).area < 1e-6


def test_a_region_smaller_than_the_grid_has_a_place() -> None:
    assert len(places_in(shapely.Point(6.0, 43.0).buffer(1e-5))) >= 1
