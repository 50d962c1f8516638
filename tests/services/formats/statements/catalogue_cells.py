"""Items of STAC catalogues: identity, masks, accuracy, reference systems."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from rasterio.transform import from_origin

from amers.services.formats.reader_rows import Outcome
from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.formats.stac.scenes import READER, read_item_scene
from amers.services.statements import Subject
from tests.services.formats.statements.cell import cell

SQUARE = {"type": "Polygon", "coordinates": [[[15, 0], [16, 0], [16, 1], [15, 1], [15, 0]]]}
Change = Callable[[dict[str, Any]], None]


def written_item(folder: Path, change: Change) -> dict[str, Any]:
    """An item with an ortho-image in UTM zone 33 north, changed, with the image beside it."""
    image = folder / "image.tif"
    with rasterio.open(
        image,
        "w",
        driver="GTiff",
        width=40,
        height=30,
        count=1,
        dtype="uint8",
        crs="EPSG:32633",
        transform=from_origin(500_000.0, 60_000.0, 10.0, 10.0),
    ) as file:
        file.write(np.full((30, 40), 7, dtype=np.uint8), 1)
    item: dict[str, Any] = {
        "type": "Feature",
        "stac_version": "1.1.0",
        "id": "one",
        "geometry": SQUARE,
        "properties": {
            "datetime": "2024-05-01T10:00:00Z",
            "platform": "sentinel-2a",
            "eo:cloud_cover": 12.5,
            "eo:snow_cover": 3.5,
            "view:incidence_angle": 8.0,
            "view:azimuth": 101.0,
            "view:sun_elevation": 41.0,
            "view:sun_azimuth": 152.0,
        },
        "assets": {"image": {"href": str(image), "type": "image/tiff", "roles": ["data"]}},
        "links": [],
    }
    change(item)
    return item


def add(
    subject: Subject,
    outcome: Outcome,
    shows: str,
    change: Change,
    hidden: shapely.Geometry | None = None,
) -> None:
    """A cell of a changed item, of which the scene is read."""

    def read(folder: Path) -> Any:
        return read_item_scene(written_item(folder, change), "items.json", hidden, sigma_m=5.0)

    cell(READER.name, subject, outcome, shows)(read)


def add_catalogue(subject: Subject, shows: str, *changes: Change) -> None:
    """A cell of a catalogue of changed items that is refused."""

    def read(folder: Path) -> Any:
        items = [written_item(folder, change) for change in changes]
        path = folder / "items.json"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": items}))
        found = read_catalogue(str(path))
        if found.bad:
            read_item_scene(items[-1], "items.json", sigma_m=5.0)
        return found

    cell(READER.name, subject, "refused", shows)(read)


def with_property(name: str, value: Any) -> Change:
    """A change of one property."""
    return lambda item: item["properties"].update({name: value})


def with_asset(name: str, **asset: Any) -> Change:
    """A change that adds an asset."""
    return lambda item: item["assets"].update({name: asset})


def without_roles(item: dict[str, Any]) -> None:
    """Two images, of which none has a role."""
    image = dict(item["assets"]["image"], roles=[])
    item["assets"] = {"image": image, "other": image}


def with_mask(folder: Path, document: dict[str, Any]) -> Any:
    """The catalogue of an item with a mask in GeoJSON."""
    mask = folder / "mask.json"
    mask.write_text(json.dumps(document))
    asset = with_asset("m", href=str(mask), type="application/geo+json", roles=["cloud"])
    path = folder / "items.json"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [written_item(folder, asset)]}))
    return read_catalogue(str(path))


def unchanged(item: dict[str, Any]) -> None:
    """No change."""


add(Subject.IDENTITY, "used", "sentinel-2a", unchanged)
add(Subject.IDENTITY, "used", "one", lambda item: item["properties"].pop("platform"))
add_catalogue(Subject.IDENTITY, "id", lambda item: item.update(id=""))
add(Subject.VALIDITY, "used", "masks in GeoJSON", unchanged, shapely.Point(15.0, 0.5).buffer(0.001))
for kind in ("image/tiff", "application/geopackage+sqlite3", "image/jp2"):
    add(
        Subject.VALIDITY,
        "named",
        "1 masks",
        with_asset("cloud", href="cloud.bin", type=kind, roles=["cloud"]),
    )
add(Subject.BANDS, "refused", "one GeoTIFF, JPEG 2000 or NITF expected", without_roles)
for system in ({"proj:code": "EPSG:32634"}, {"proj:epsg": 4326}, {"proj:code": "IAU:30100"}):
    for key, value in system.items():
        add(Subject.HORIZONTAL_DATUM, "named", str(value), with_property(key, value))
for key, value in (("accuracy:geometric_rmse", 3.2), ("accuracy:geometric_x_bias", 0.4)):
    add(Subject.ACCURACY, "named", f"{key} {value}", with_property(key, value))
add_catalogue(
    Subject.ORDER,
    "longitude and latitude",
    lambda item: item.update(
        geometry={"type": "Polygon", "coordinates": [[[0, 150], [1, 150], [1, 151], [0, 150]]]}
    ),
)
for key, value in (("eo:cloud_cover", 250.0), ("view:sun_elevation", 3.1e3)):
    add_catalogue(Subject.UNIT, key, with_property(key, value))


@cell(READER.name, Subject.HORIZONTAL_DATUM, "refused", "32633")
def a_mask_of_another_system(folder: Path) -> Any:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    return with_mask(folder, {"type": "FeatureCollection", "crs": crs, "features": [SQUARE]})
