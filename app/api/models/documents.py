"""Models of the documents of OGC API: landing page, conformance, collections, schemas, tile sets.

Sources: OGC 19-072 (Common), OGC 17-069r4 (Features), OGC 20-057 (Tiles), STAC 1.1.0.
"""

from typing import Literal

from pydantic import Field

from amers.app.api.models.base import JsonObject, Link, Missing, Reply

Box = list[float]


class Health(Reply):
    """The state of the service."""

    status: str


class PartReadiness(Reply):
    """The state of one part of the service; `degraded` affects uploads and jobs, not reading."""

    status: Literal["ok", "degraded", "failed"]
    reason: str | None = Missing


class ReadinessReport(Reply):
    """The state of the service by part: database, schema, storage, worker, disk."""

    status: Literal["ready", "degraded", "not ready"]
    parts: dict[str, PartReadiness]


class Conformance(Reply):
    """The conformance classes of the service."""

    conforms_to: tuple[str, ...] = Field(serialization_alias="conformsTo")


class Landing(Conformance):
    """The landing page, which is also a STAC catalog."""

    type: Literal["Catalog"]
    stac_version: str
    id: str
    title: str
    description: str
    links: list[Link]


class SpatialExtent(Reply):
    """The box of a collection."""

    bbox: list[Box]
    crs: str


class TemporalExtent(Reply):
    """The period of a collection; null is an open end."""

    interval: list[list[str | None]]


class Extent(Reply):
    """Where and when the features of a collection are."""

    spatial: SpatialExtent
    temporal: TemporalExtent


class CollectionDescription(Reply):
    """A collection of OGC API - Features and of STAC."""

    id: str
    title: str
    description: str
    item_type: Literal["feature"] = Field(serialization_alias="itemType")
    crs: list[str]
    storage_crs: str = Field(serialization_alias="storageCrs")
    type: Literal["Collection"]
    stac_version: str
    license: str
    extent: Extent
    links: list[Link]


class Collections(Reply):
    """The collections that the caller may read."""

    links: list[Link]
    collections: list[CollectionDescription]


class JsonSchema(Reply):
    """A JSON Schema of the properties of a collection."""

    schema_uri: str = Field(serialization_alias="$schema")
    id: str = Field(serialization_alias="$id")
    type: Literal["object"]
    title: str
    properties: JsonObject
    required: list[str] | None = Missing
    additional_properties: bool = Field(serialization_alias="additionalProperties")


class TileMatrixSetItem(Reply):
    """A tile matrix set in a list."""

    id: str
    uri: str
    links: list[Link]


class TileMatrixSets(Reply):
    """The tile matrix sets of the service."""

    tile_matrix_sets: list[TileMatrixSetItem] = Field(serialization_alias="tileMatrixSets")


class TileMatrix(Reply):
    """The grid of tiles of one zoom."""

    id: str
    scale_denominator: float = Field(serialization_alias="scaleDenominator")
    cell_size: float = Field(serialization_alias="cellSize")
    corner_of_origin: Literal["topLeft"] = Field(serialization_alias="cornerOfOrigin")
    point_of_origin: list[float] = Field(serialization_alias="pointOfOrigin")
    tile_width: int = Field(serialization_alias="tileWidth")
    tile_height: int = Field(serialization_alias="tileHeight")
    matrix_width: int = Field(serialization_alias="matrixWidth")
    matrix_height: int = Field(serialization_alias="matrixHeight")


class TileMatrixSet(Reply):
    """Grids of tiles, one for each zoom."""

    id: str
    uri: str
    crs: str
    ordered_axes: list[str] = Field(serialization_alias="orderedAxes")
    tile_matrices: list[TileMatrix] = Field(serialization_alias="tileMatrices")


class TileLayer(Reply):
    """A layer of vector tiles."""

    id: str
    data_type: Literal["vector"] = Field(serialization_alias="dataType")
    geometry_dimension: int = Field(serialization_alias="geometryDimension")


class TileSet(Reply):
    """The vector tiles of a collection."""

    title: str
    data_type: Literal["vector"] = Field(serialization_alias="dataType")
    crs: str
    tile_matrix_set_uri: str = Field(serialization_alias="tileMatrixSetURI")
    links: list[Link]
    layers: list[TileLayer] | None = Missing


class TileSets(Reply):
    """The tile sets of a collection."""

    links: list[Link]
    tilesets: list[TileSet]
