"""The format of a reply, which the parameter `f` decides or else the header Accept; media types."""

from collections.abc import Mapping
from typing import Any

from fastapi import Request, Response
from fastapi.responses import JSONResponse

from amers.app.api.models.base import Reply
from amers.app.errors import InvalidParameter

GEOJSON = "application/geo+json"
JSON = "application/json"
HTML = "text/html"
SCHEMA_JSON = "application/schema+json"
OPENAPI_JSON = "application/vnd.oai.openapi+json;version=3.1"
OPENAPI_30_JSON = "application/vnd.oai.openapi+json;version=3.0"
PROBLEM_JSON = "application/problem+json"
TIFF = "image/tiff; application=geotiff"
NPZ = "application/x-npz"
MVT = "application/vnd.mapbox-vector-tile"

NEGOTIATED = "amers.negotiated"
"""In the scope of a request whose header Accept has decided: caches need to know that."""

DOCUMENTS = {"json": JSON, "html": HTML}
FEATURES = {
    "json": GEOJSON,
    "html": HTML,
    "csv": "text/csv",
    "fgb": "application/flatgeobuf",
    "parquet": "application/vnd.apache.parquet",
    "gpkg": "application/geopackage+sqlite3",
}


class GeoJsonResponse(JSONResponse):
    """A reply in GeoJSON."""

    media_type = GEOJSON


class SchemaResponse(JSONResponse):
    """A JSON Schema."""

    media_type = SCHEMA_JSON


def json_reply(document: Reply, media_type: str = JSON) -> Response:
    """A document as JSON, for endpoints that have other formats too."""
    return Response(document.model_dump_json(by_alias=True), media_type=media_type)


def described(
    model: type[Reply], *others: str, headers: Mapping[str, Any] | None = None
) -> dict[int | str, dict[str, Any]]:
    """The description of a reply that an endpoint makes itself: its model, media types, headers."""
    text = (model.__doc__ or model.__name__).partition("\n")[0]
    content: dict[str, Any] = {other: {} for other in others}
    ok = {"description": text, "model": model, "content": content}
    return {200: ok | ({"headers": headers} if headers else {})}


def header(description: str) -> dict[str, Any]:
    """The description of a header of a reply."""
    return {"description": description, "schema": {"type": "string"}}


CRS_HEADER = {"Content-Crs": header("URI of the coordinate reference system of the reply.")}
TAG_HEADER = {"ETag": header("Tag of the content, for `If-None-Match`.")}
FILE_HEADER = {"Content-Disposition": header("Name of the file, for formats that are files.")}


def chosen_format(request: Request, formats: Mapping[str, str], f: str | None) -> str:
    """The name of the format of a reply; the first of `formats` by default.

    Args:
        formats: names and media types.
        f: the parameter of that name.

    Raises:
        InvalidParameter: `f` is none of the names.
    """
    if f is not None:
        if f not in formats:
            raise InvalidParameter(f"f: {f!r:.40} found, one of {', '.join(formats)} expected")
        return f
    request.scope[NEGOTIATED] = True
    accepted = []
    for rank, part in enumerate(request.headers.get("accept", "").split(",")):
        kind, *parameters = (word.strip().lower() for word in part.split(";"))
        weights = [word[2:] for word in parameters if word.startswith("q=")]
        try:
            weight = float(weights[0]) if weights else 1.0
        except ValueError:
            weight = 0.0
        versions = [word for word in parameters if word.startswith("version=")]
        name = _name_of(formats, kind, versions)
        if name is not None and weight > 0.0:
            accepted.append((-weight, rank, name))
    return min(accepted)[2] if accepted else next(iter(formats))


def _name_of(formats: Mapping[str, str], kind: str, versions: list[str]) -> str | None:
    """The name of the format of a media type; plain JSON stands for the format that is named so."""
    for name, offered in formats.items():
        if offered.partition(";")[0] == kind and all(word in offered for word in versions):
            return name
    return "json" if kind == JSON else None


def refuse_unknown(request: Request, parameters: set[str]) -> None:
    """Refuse parameters that the endpoint does not have, as OGC API requires.

    Raises:
        InvalidParameter: there are some; the message names them.
    """
    unknown = sorted(set(request.query_params) - parameters)
    if unknown:
        raise InvalidParameter(
            f"{', '.join(unknown)[:200]}: no such parameter; there are {', '.join(sorted(parameters))}"
        )
