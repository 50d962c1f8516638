"""The media types of files that registrations and other jobs make."""

from pathlib import Path

MEDIA_TYPES = {
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".gcp": "text/plain",
    ".points": "text/plain",
    ".pts": "text/plain",
    ".gpkg": "application/geopackage+sqlite3",
    ".html": "text/html",
    ".txt": "text/plain",
    ".rpb": "text/plain",
    ".geom": "text/plain",
    ".xml": "application/xml",
    ".tif": "image/tiff",
    ".tiff": "image/tiff",
    ".zip": "application/zip",
}


def media_type(name: str) -> str:
    """The media type of an output."""
    return MEDIA_TYPES.get(Path(name).suffix.lower(), "application/octet-stream")
