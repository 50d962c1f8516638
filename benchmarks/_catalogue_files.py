"""A simulated catalogue as files: lines of STAC items, and a GeoJSON mask beside them for each."""

import json
import math
from pathlib import Path
from typing import Any

import shapely

from amers.services.imagery.catalogue import ImageCatalogue


def write_catalogue(catalogue: ImageCatalogue, folder: Path) -> Path:
    """Write items and masks into a folder; returns the file of the items."""
    (folder / "masks").mkdir(parents=True, exist_ok=True)
    path = folder / "items.ndjson"
    with path.open("w", encoding="utf-8") as out:
        for row in range(len(catalogue)):
            out.write(json.dumps(_item(catalogue, row)) + "\n")
            if catalogue.mask[row] is not None:
                document = {
                    "type": "Feature",
                    "properties": {},
                    "geometry": _geojson(catalogue.mask[row]),
                }
                (folder / _mask_name(catalogue, row)).write_text(json.dumps(document), encoding="utf-8")
    return path


def _item(catalogue: ImageCatalogue, row: int) -> dict[str, Any]:
    numbers = {
        "eo:cloud_cover": catalogue.cloud_percent[row],
        "eo:snow_cover": catalogue.snow_percent[row],
        "view:incidence_angle": catalogue.incidence_deg[row],
        "view:azimuth": (catalogue.azimuth_deg[row] + 180.0) % 360.0,
        "view:sun_elevation": catalogue.sun_elevation_deg[row],
        "view:sun_azimuth": catalogue.sun_azimuth_deg[row],
    }
    assets: dict[str, Any] = {"image": {"href": f"images/{catalogue.id[row]}.tif", "roles": ["data"]}}
    if catalogue.mask[row] is not None:
        assets["clouds"] = {
            "href": _mask_name(catalogue, row),
            "type": "application/geo+json",
            "roles": ["cloud"],
        }
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "id": str(catalogue.id[row]),
        "geometry": _geojson(catalogue.footprint[row]),
        "properties": {
            "datetime": f"{catalogue.acquired[row]}Z",
            "platform": str(catalogue.platform[row]),
            "sat:absolute_orbit": int(catalogue.orbit[row]),
            **{name: float(value) for name, value in numbers.items() if not math.isnan(value)},
        },
        "assets": assets,
        "links": [],
    }


def _geojson(shape: shapely.Geometry) -> Any:
    return json.loads(shapely.to_geojson(shape))


def _mask_name(catalogue: ImageCatalogue, row: int) -> str:
    return f"masks/{catalogue.id[row]}.geojson"
