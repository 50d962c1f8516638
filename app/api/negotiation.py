"""Which format a reply has: `f=` decides, then the header Accept."""

from collections.abc import Mapping

from fastapi import Request

from app.errors import InvalidParameter

GEOJSON = "application/geo+json"
JSON = "application/json"
HTML = "text/html"
SCHEMA_JSON = "application/schema+json"
OPENAPI_JSON = "application/vnd.oai.openapi+json;version=3.1"
PROBLEM_JSON = "application/problem+json"
TIFF = "image/tiff; application=geotiff"
NPZ = "application/x-npz"
MVT = "application/vnd.mapbox-vector-tile"

DOCUMENTS = {"json": JSON, "html": HTML}
FEATURES = {
    "json": GEOJSON,
    "html": HTML,
    "csv": "text/csv",
    "fgb": "application/flatgeobuf",
    "parquet": "application/vnd.apache.parquet",
    "gpkg": "application/geopackage+sqlite3",
}


def chosen_format(request: Request, formats: Mapping[str, str], asked: str | None) -> str:
    """The name of the format of a reply, the first of `formats` when nothing speaks for another.

    Raises:
        InvalidParameter: `f` names none of them.
    """
    if asked is not None:
        if asked not in formats:
            raise InvalidParameter(f"f: {asked!r:.40} found, one of {', '.join(formats)} expected")
        return asked
    by_type = {kind.split(";")[0]: name for name, kind in formats.items()}
    by_type.setdefault(JSON, "json")
    wanted = []
    for rank, part in enumerate(request.headers.get("accept", "").split(",")):
        kind, *parameters = (word.strip().lower() for word in part.split(";"))
        weights = [word[2:] for word in parameters if word.startswith("q=")]
        try:
            weight = float(weights[0]) if weights else 1.0
        except ValueError:
            weight = 0.0
        name = by_type.get(kind)
        versions = [word for word in parameters if word.startswith("version=")]
        if name is not None and weight > 0.0 and all(word in formats[name] for word in versions):
            wanted.append((-weight, rank, name))
    return min(wanted)[2] if wanted else next(iter(formats))


def refuse_unknown(request: Request, known: set[str]) -> None:
    """Refuse parameters that nobody knows, as OGC API calls for.

    Raises:
        InvalidParameter: naming them.
    """
    unknown = sorted(set(request.query_params) - known)
    if unknown:
        raise InvalidParameter(
            f"{', '.join(unknown)[:200]}: no such parameter; there are {', '.join(sorted(known))}"
        )
