"""Reference images of the installation, and the places on them that scenes were found by."""

from dataclasses import asdict, dataclass
from datetime import datetime

import numpy as np
import shapely
from sqlalchemy import JSON, Numeric, bindparam, cast, delete, func, insert, or_, select, update
from sqlalchemy.dialects import postgresql

from amers.app.db.engine import Connection
from amers.app.db.features.antimeridian import TURNS_DEG, on_the_map
from amers.app.db.rows import columns_of, every, first
from amers.app.db.schema import reference_image, reference_point
from amers.app.db.statements import named
from amers.app.db.stored_files import NamedFile
from amers.services.types import Array, BoolArray, IntArray

FEW_ATTEMPTS = 3
"""A place with so many attempts, fewer than half of them successful, is left out."""

PLACES_INSIDE = named("references.sql", "places_inside")
COUNT_PLACES = named("references.sql", "count_places")


@dataclass(frozen=True)
class NewReferenceImage:
    """The columns of a new reference image, as in `ReferenceRow`.

    Attributes:
        checksums: path of each of its files to the SHA-256 of the file.
    """

    name: str
    image: str
    dem: str | None
    vertical: str | None
    geoid: str | None
    sigma_m: float | None
    sigma_up_m: float | None
    gsd_m: float
    checksums: dict[str, str]


@dataclass(frozen=True)
class ReferenceRow:
    """A reference image; paths are below AMERS_REFERENCE_FOLDER.

    Attributes:
        name: unique, for people.
        image: the ortho-image.
        dem: heights of the same place; None: only ortho-images can be registered on it.
        vertical, geoid: vertical datum of the heights, when their file does not name it.
        sigma_m: absolute accuracy of the whole image, one standard deviation per coordinate; None when
            unknown.
        sigma_up_m: the same of its heights.
        gsd_m: its ground sampling.
        footprint: GeoJSON.
    """

    id: int
    name: str
    image: str
    dem: str | None
    vertical: str | None
    geoid: str | None
    sigma_m: float | None
    sigma_up_m: float | None
    gsd_m: float
    created_at: datetime
    footprint: dict[str, object]


@dataclass(frozen=True)
class ReferencePlaces:
    """n places of a reference image where scenes were matched.

    Attributes:
        id: (n,) int64.
        lon_lat_h: (n, 3).
    """

    id: IntArray
    lon_lat_h: Array


COLUMNS = columns_of(
    ReferenceRow,
    reference_image,
    footprint=cast(func.ST_AsGeoJSON(reference_image.c.footprint, 7), JSON),
)


def insert_reference(
    connection: Connection, new: NewReferenceImage, outline: Array
) -> ReferenceRow | None:
    """A new reference; None when there is one of that name.

    Args:
        outline: (m, 2) lon, lat, not closed.
    """
    statement = (
        postgresql.insert(reference_image)
        .values(**asdict(new), footprint=func.ST_GeomFromWKB(_wkb(outline), 4326))
        .on_conflict_do_nothing(index_elements=[reference_image.c.name])
        .returning(*COLUMNS)
    )
    return first(ReferenceRow, connection.execute(statement))


def list_references(connection: Connection) -> list[ReferenceRow]:
    """All references, by name."""
    statement = select(*COLUMNS).order_by(reference_image.c.name)
    return every(ReferenceRow, connection.execute(statement))


def find_reference(connection: Connection, name: str) -> ReferenceRow | None:
    """The reference of a name; None without one."""
    statement = select(*COLUMNS).where(reference_image.c.name == name)
    return first(ReferenceRow, connection.execute(statement))


def read_reference_files(connection: Connection) -> list[NamedFile]:
    """The files of all references, each once; the size is not recorded."""
    checksums: dict[str, str | None] = {}
    columns = reference_image.c
    statement = select(columns.image, columns.dem, columns.geoid, columns.checksums).order_by(columns.id)
    for row in connection.execute(statement):
        for path in (row.image, row.dem, row.geoid):
            if path is not None:
                checksums[path] = (row.checksums or {}).get(path) or checksums.get(path)
    return [NamedFile(path, "reference", None, sha256) for path, sha256 in sorted(checksums.items())]


def record_checksum(connection: Connection, path: str, sha256: str) -> None:
    """Record the SHA-256 of a file in the rows of the references that name the file."""
    columns = reference_image.c
    checksum = cast({path: sha256}, postgresql.JSONB)
    others = func.coalesce(columns.checksums, cast({}, postgresql.JSONB))
    connection.execute(
        update(reference_image)
        .where(or_(columns.image == path, columns.dem == path, columns.geoid == path))
        .values(checksums=others.op("||")(checksum))
    )


def delete_reference(connection: Connection, name: str) -> bool:
    """Delete a reference and its places; False when there is none of that name."""
    deleted = connection.execute(delete(reference_image).where(reference_image.c.name == name))
    return deleted.rowcount == 1


def best_reference(
    connection: Connection, outline: Array, *, has_heights: bool = False
) -> ReferenceRow | None:
    """The reference that covers most of an outline (m, 2); of equal ones, the finest.

    Args:
        connection: to the store.
        outline: (m, 2) lon, lat, not closed.
        has_heights: consider only those with a terrain.
    """
    footprint = reference_image.c.footprint
    area = func.ST_GeomFromWKB(bindparam("area", _wkb_all_round(outline)), 4326)
    covered = func.ST_Area(func.ST_Intersection(footprint, area)) / shapely.Polygon(outline).area
    having = [reference_image.c.dem.is_not(None)] if has_heights else []
    statement = (
        select(*COLUMNS)
        .where(func.ST_Intersects(footprint, area), *having)
        .order_by(
            func.round(cast(covered, Numeric), 2).desc(),
            reference_image.c.gsd_m,
            reference_image.c.id.desc(),
        )
        .limit(1)
    )
    return first(ReferenceRow, connection.execute(statement))


def places_inside(
    connection: Connection, reference_id: int, outline: Array, worthwhile: bool
) -> ReferencePlaces:
    """The places of a reference inside an outline (m, 2), the most successful first.

    Args:
        worthwhile: without those where scenes are not matched any more.
    """
    area = on_the_map(shapely.Polygon(outline))
    rows = connection.execute(
        PLACES_INSIDE,
        {
            "reference_id": reference_id,
            "area": shapely.to_wkb(area),
            "worthwhile": worthwhile,
            "few_attempts": FEW_ATTEMPTS,
        },
    ).all()
    return ReferencePlaces(
        np.array([row.id for row in rows], dtype=np.int64),
        np.array([(row.lon, row.lat, row.h) for row in rows], dtype=np.float64).reshape(-1, 3),
    )


def count_places(connection: Connection, ids: IntArray, successes: BoolArray) -> None:
    """Count an attempt at each of some places (n,), and where the scene was matched a success."""
    connection.execute(COUNT_PLACES, {"ids": ids.tolist(), "successes": successes.tolist()})


def insert_places(connection: Connection, reference_id: int, lon_lat_h: Array) -> None:
    """Store new places (n, 3) where a scene was matched."""
    if len(lon_lat_h) == 0:
        return
    place = func.ST_MakePoint(bindparam("lon"), bindparam("lat"), bindparam("h"))
    statement = insert(reference_point).values(
        reference_id=reference_id,
        geom=func.ST_SetSRID(place, 4979),
        attempts=1,
        successes=1,
        last_success_at=func.now(),
    )
    connection.execute(
        statement, [dict(zip(("lon", "lat", "h"), row, strict=True)) for row in lon_lat_h.tolist()]
    )


def lock_reference(connection: Connection, reference_id: int) -> bool:
    """Let one registration after the other store its places; False when the reference was deleted."""
    statement = (
        select(reference_image.c.id)
        .where(reference_image.c.id == reference_id)
        .with_for_update(key_share=True)
    )
    return connection.scalar(statement) is not None


def _wkb(outline: Array) -> bytes:
    return bytes(shapely.to_wkb(shapely.Polygon(outline)))


def _wkb_all_round(outline: Array) -> bytes:
    """An outline moved 360 degrees to the west, as it is, and moved to the east.

    A footprint that crosses 180 degrees has longitudes beyond it, on one side or the other.
    """
    around = [shapely.Polygon(outline + [turn, 0.0]) for turn in TURNS_DEG]
    return bytes(shapely.to_wkb(shapely.MultiPolygon(around)))
