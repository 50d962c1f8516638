"""Items of archives as catalogues have them, and files that describe an archive."""

from pathlib import Path
from typing import Any

import pytest

from amers.services.errors import FormatError
from amers.services.formats.archive_file import read_archive
from amers.services.formats.stac.archive_items import archive_image
from amers.services.imagery.archives import LANDSAT, SENTINEL_2

SQUARE = {"type": "Polygon", "coordinates": [[[6, 43], [7, 43], [7, 44], [6, 44], [6, 43]]]}


def item(name: str = "S2A_32TLP_20220501_0_L2A", **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "id": name,
        "collection": "sentinel-2-l2a",
        "geometry": SQUARE,
        "properties": {"datetime": "2022-05-01T10:30:00Z", **properties},
        "assets": {"red": {"href": "https://images.example/red.tif"}},
    }


@pytest.mark.parametrize(
    ("properties", "tile", "orbit", "baseline"),
    [
        (
            {"grid:code": "MGRS-32TLP", "sat:relative_orbit": 22, "s2:processing_baseline": "05.10"},
            "32TLP",
            "22",
            "05.10",
        ),
        (
            {
                "s2:mgrs_tile": "32TLP",
                "s2:product_uri": "S2A_MSIL2A_20220501T103021_N0400_R108_T32TLP_20220501T140000.SAFE",
            },
            "32TLP",
            "108",
            "04.00",
        ),
        (
            {"mgrs:utm_zone": 32, "mgrs:latitude_band": "T", "mgrs:grid_square": "LP"},
            "32TLP",
            "",
            "",
        ),
        ({"proj:epsg": 32632, "processing:version": "05.09"}, "32632_6.5_43.5", "", "05.09"),
    ],
)
def test_names_that_catalogues_use_are_read(
    properties: dict[str, Any], tile: str, orbit: str, baseline: str
) -> None:
    image = archive_image(item(**properties), SENTINEL_2, "test")
    assert (image.tile, image.orbit, image.baseline) == (tile, orbit, baseline)


def test_clouds_snow_and_the_sun_are_those_that_the_item_states_each_under_its_name() -> None:
    stated = {"eo:cloud_cover": 20.0, "eo:snow_cover": 5.0}
    stated |= {"view:sun_elevation": 41.0, "view:sun_azimuth": 152.0}
    image = archive_image(item(**stated), SENTINEL_2, "test")
    assert (image.cloud, image.snow, image.sun_deg) == (0.2, 0.05, (41.0, 152.0))
    bare = archive_image(item(), SENTINEL_2, "test")
    assert (bare.cloud, bare.snow) == (0.0, 0.0)
    # An hour before noon: declination 15.2, hour angle -15.3 degrees, by spherical trigonometry.
    assert bare.sun_deg == pytest.approx((58.8, 150.7), abs=0.5)


def test_the_offset_and_the_accuracy_follow_the_baseline() -> None:
    stated = {"s2:processing_baseline": "05.10"}
    new = archive_image(item(**stated), SENTINEL_2, "test")
    assert (new.offset, new.accuracy.common_m > 2.0) == (-1000.0, True)
    applied = {**stated, "earthsearch:boa_offset_applied": True}
    assert archive_image(item(**applied), SENTINEL_2, "test").offset == 0.0
    for baseline in ("02.14", "3.01", "N0301"):
        old = archive_image(item(**{"s2:processing_baseline": baseline}), SENTINEL_2, "test")
        assert (old.offset, old.accuracy.own_m) == (0.0, pytest.approx(8.17, abs=0.01))
    unknown = archive_image(item(), SENTINEL_2, "test")
    assert (unknown.offset, unknown.accuracy) == (0.0, SENTINEL_2.accuracy[0])


def test_a_row_of_landsat_is_a_tile() -> None:
    scene = item("LC08_L2SP_195030", **{"landsat:wrs_path": "195", "landsat:wrs_row": "030"})
    image = archive_image({**scene, "collection": "landsat-c2-l2"}, LANDSAT, "test")
    assert (image.tile, image.orbit) == ("195-030", "195")
    scene["properties"]["landsat:collection_category"] = "T2"
    with pytest.raises(FormatError, match="collection_category: 'T2' found, T1 expected"):
        archive_image({**scene, "collection": "landsat-c2-l2"}, LANDSAT, "test")


def test_items_of_others_and_without_the_asset_are_refused() -> None:
    with pytest.raises(FormatError, match="collection naip found, sentinel-2-l2a"):
        archive_image({**item(), "collection": "naip"}, SENTINEL_2, "test")
    with pytest.raises(FormatError, match=r"assets: B04 found, red expected.*--from FILE\.toml"):
        archive_image({**item(), "assets": {"B04": {"href": "x"}}}, SENTINEL_2, "test")


DESCRIBED = """
name = "aerial"
collections = ["aerial-2024"]
image = "rgb"
gsd_m = 1
hidden_classes = [0, 3]

[[accuracy]]
own_m = 0.5
common_m = 0.2
"""


def test_a_file_describes_an_archive(tmp_path: Path) -> None:
    file = tmp_path / "aerial.toml"
    file.write_text(DESCRIBED)
    archive = read_archive(file)
    assert (archive.name, archive.collections, archive.gsd_m) == ("aerial", ("aerial-2024",), 1)
    assert archive.hidden_classes == (0, 3)
    assert archive.stated("").total_m == pytest.approx(0.5385, abs=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "aerial"', "", "name: nothing found"),
        ("gsd_m = 1", 'gsd_m = "1"', "gsd_m: '1' found, float expected"),
        ("gsd_m = 1", "gsd = 1", "gsd: unknown, one of name"),
        ("[0, 3]", '["cloud"]', "hidden_classes: .* a list expected"),
        ("[[accuracy]]", "[accuracies]", "accuracy: None found"),
        ("own_m = 0.5", "", "accuracy: own_m: nothing found"),
        ("image =", "image", "TOML expected"),
    ],
)
def test_what_a_file_lacks_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    file = tmp_path / "aerial.toml"
    file.write_text(DESCRIBED.replace(old, new))
    with pytest.raises(FormatError, match=message):
        read_archive(file)
