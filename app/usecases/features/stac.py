"""Scenes as STAC items: features of the collection `scenes` with their files as assets.

Source: STAC 1.1.0 with the extensions view 1.0.0 and projection 2.0.0.
"""

import json
from pathlib import Path
from typing import Any
from uuid import UUID

from amers.app.db.engine import Connection
from amers.app.db.scene_files import SceneFiles, read_scene_files
from amers.app.usecases.media_types import media_type
from amers.app.usecases.processes import result_name
from amers.app.usecases.registration.deliverables import TITLES

VERSION = "1.1.0"
COLLECTION = "scenes"
EXTENSIONS = (
    "https://stac-extensions.github.io/view/v1.0.0/schema.json",
    "https://stac-extensions.github.io/projection/v2.0.0/schema.json",
)
IMAGE_TYPES = {
    ".tif": "image/tiff; application=geotiff",
    ".tiff": "image/tiff; application=geotiff",
    ".jp2": "image/jp2",
    ".j2k": "image/jp2",
    ".ntf": "application/vnd.nitf",
    ".nitf": "application/vnd.nitf",
}
RESULTS = {
    "report.json": "report",
    "report.html": "report-page",
    "refined_RPC.TXT": "refined-model",
    "correction.json": "correction",
    "control_points.geojson": "control-points",
    "residuals.gpkg": "residuals",
}
"""Asset keys of results; other results have their file name as key."""

Item = dict[str, Any]


def stac_items(connection: Connection, features: bytes, base: str) -> list[Item]:
    """Features of the collection `scenes` as STAC items.

    Args:
        features: GeoJSON, separated by commas; longitude first, all properties.
        base: address of the service, with a slash at its end.
    """
    parsed: list[Item] = json.loads(b"[" + features + b"]")
    files = read_scene_files(connection, [UUID(feature["id"]) for feature in parsed])
    return [_item(feature, files[UUID(feature["id"])], base) for feature in parsed]


def scene_media_type(name: str) -> str:
    """The media type of a file of a scene."""
    return IMAGE_TYPES.get(Path(name).suffix.lower()) or media_type(name)


def _item(feature: Item, files: SceneFiles, base: str) -> Item:
    collection_url = f"{base}collections/{COLLECTION}"
    item_url = f"{collection_url}/items/{feature['id']}"
    box = _bbox(feature["geometry"])
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": EXTENSIONS,
        "id": feature["id"],
        "geometry": feature["geometry"],
        **({} if box is None else {"bbox": box}),
        "properties": _properties(feature["properties"]) | _accuracy(files),
        "collection": COLLECTION,
        "assets": _assets(files, base),
        "links": [
            {"rel": "self", "href": item_url, "type": "application/geo+json"},
            {"rel": "alternate", "href": f"{item_url}?f=html", "type": "text/html"},
            {"rel": "parent", "href": collection_url, "type": "application/json"},
            {"rel": "collection", "href": collection_url, "type": "application/json"},
            {"rel": "root", "href": base, "type": "application/json"},
        ],
    }


def _properties(columns: dict[str, Any]) -> dict[str, Any]:
    """The properties that have values; `proj:code` is null because a scene lies on no map."""
    properties = {name: value for name, value in columns.items() if value is not None}
    shape = [columns["amers:lines"], columns["amers:samples"]]
    return {**properties, "proj:code": None, **({} if None in shape else {"proj:shape": shape})}


def _accuracy(files: SceneFiles) -> dict[str, Any]:
    """The accuracy that the last registration states, as in its report; unknown figures are null.

    `amers:held_area` is the ground for which it is stated, a geometry of GeoJSON.
    """
    stated = {name: value for name, value in (files.accuracy or {}).items() if value is not None}
    polygons = stated.pop("held_polygons", None)
    if polygons is not None:
        stated["held_area"] = {"type": "MultiPolygon", "coordinates": polygons}
    return {f"amers:{name}": value for name, value in stated.items()}


def _bbox(geometry: dict[str, Any] | None) -> list[float] | None:
    """West, south, east, north of an outline; west is greater than east across the antimeridian."""
    if geometry is None:
        return None
    is_single = geometry["type"] == "Polygon"
    polygons = [geometry["coordinates"]] if is_single else geometry["coordinates"]
    lon, lat = zip(*(position for rings in polygons for position in rings[0]), strict=True)
    # A MultiPolygon is an outline that was cut at 180 degrees.
    west = min(lon) if is_single else min(value for value in lon if value > 0.0)
    east = max(lon) if is_single else max(value for value in lon if value < 0.0)
    return [west, min(lat), east, max(lat)]


def _assets(files: SceneFiles, base: str) -> dict[str, dict[str, Any]]:
    scene = f"{base}scenes/{files.scene_id}/files"
    assets: dict[str, dict[str, Any]] = {}
    if files.image is not None:
        kind, title = scene_media_type(files.image), "The image as delivered."
        assets["image"] = _asset(f"{scene}/{files.image}", kind, title, "data")
    for name in files.models:
        title = "A file delivered beside the image."
        assets[name] = _asset(f"{scene}/{name}", scene_media_type(name), title, "metadata")
    for name, stored_key in sorted(files.results.items()):
        title = TITLES.get(name, "The refined model in the format of the delivered one.")
        href = f"{base}jobs/{files.job_id}/results/{result_name(stored_key)}"
        key = RESULTS.get(name, name)
        assets[key if key not in assets else f"refined-{key}"] = _asset(
            href, media_type(name), title, "metadata"
        )
    return assets


def _asset(href: str, kind: str, title: str, role: str) -> dict[str, Any]:
    return {"href": href, "type": kind, "title": title, "roles": [role]}
