"""Reference images of the installation, and the places on them that scenes were found by."""

from dataclasses import dataclass
from datetime import datetime

import numpy as np
import shapely
from psycopg.rows import class_row

from app.db.engine import Connection
from app.db.features.antimeridian import TURNS_DEG, on_the_map
from services.types import Array, BoolArray, IntArray

COLUMNS = """id, name, image, dem, vertical, geoid, sigma_m, gsd_m, created_at,
    st_asgeojson(footprint, 7)::json as footprint"""

FEW_TRIES = 3
"""A place that was looked for so often and found in less than half of the scenes is left out."""


@dataclass(frozen=True)
class ReferenceRow:
    """A reference image; paths are below AMERS_REFERENCE_FOLDER.

    Attributes:
        name: for people, of one reference.
        image: the ortho-image.
        dem: heights of the same place; None: only ortho-images can be registered on it.
        vertical, geoid: what the heights are counted from, when their file does not say.
        sigma_m: how well it lies on the Earth as a whole, one standard deviation a coordinate; None
            when unknown.
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
    gsd_m: float
    created_at: datetime
    footprint: dict[str, object]


@dataclass(frozen=True)
class HomologousPlaces:
    """n places of a reference that scenes were looked for at.

    Attributes:
        id: (n,) int64.
        lon_lat_h: (n, 3).
    """

    id: IntArray
    lon_lat_h: Array


def insert_reference(
    connection: Connection,
    *,
    name: str,
    image: str,
    dem: str | None,
    vertical: str | None,
    geoid: str | None,
    sigma_m: float | None,
    gsd_m: float,
    outline: Array,
) -> ReferenceRow | None:
    """A new reference; None when there is one of that name.

    Args:
        outline: (m, 2) lon, lat, not closed.
    """
    with connection.cursor(row_factory=class_row(ReferenceRow)) as cursor:
        return cursor.execute(
            f"""insert into reference_image
                    (name, image, dem, vertical, geoid, sigma_m, gsd_m, footprint)
                values (%s, %s, %s, %s, %s, %s, %s, st_geomfromwkb(%s, 4326))
                on conflict (name) do nothing returning {COLUMNS}""",
            [name, image, dem, vertical, geoid, sigma_m, gsd_m, _wkb(outline)],
        ).fetchone()


def list_references(connection: Connection) -> list[ReferenceRow]:
    """All references, by name."""
    with connection.cursor(row_factory=class_row(ReferenceRow)) as cursor:
        return cursor.execute(f"select {COLUMNS} from reference_image order by name").fetchall()


def delete_reference(connection: Connection, name: str) -> bool:
    """Forget a reference and the places on it; False when there is none of that name."""
    done = connection.execute("delete from reference_image where name = %s", [name])
    return done.rowcount == 1


def best_reference(connection: Connection, outline: Array) -> ReferenceRow | None:
    """The reference that shows most of an outline (m, 2); of those that show as much, the finest."""
    with connection.cursor(row_factory=class_row(ReferenceRow)) as cursor:
        return cursor.execute(
            f"""with asked as (select st_geomfromwkb(%s, 4326) as area, %s::float as area_deg2)
                select {COLUMNS} from reference_image, asked
                where st_intersects(footprint, area)
                order by round((st_area(st_intersection(footprint, area)) / area_deg2)::numeric, 2)
                    desc, gsd_m, id desc limit 1""",
            [_wkb_all_round(outline), shapely.Polygon(outline).area],
        ).fetchone()


def places_inside(
    connection: Connection, reference_id: int, outline: Array, worthwhile: bool
) -> HomologousPlaces:
    """The places of a reference inside an outline (m, 2), those found most often first.

    Args:
        worthwhile: without those that are not found any more.
    """
    area = on_the_map(shapely.Polygon(outline))
    rows = connection.execute(
        """select id, st_x(geom) as lon, st_y(geom) as lat, st_z(geom) as h from reference_point
           where reference_id = %s and st_intersects(geom, st_setsrid(st_geomfromwkb(%s), 4979))
               and not (%s and attempts >= %s and 2 * successes < attempts)
           order by successes::real / attempts desc, successes desc, id""",
        [reference_id, shapely.to_wkb(area), worthwhile, FEW_TRIES],
    ).fetchall()
    return HomologousPlaces(
        np.array([row["id"] for row in rows], dtype=np.int64),
        np.array([(row["lon"], row["lat"], row["h"]) for row in rows], dtype=np.float64).reshape(-1, 3),
    )


def count_places(connection: Connection, ids: IntArray, found: BoolArray) -> None:
    """Note of places (n,) that a scene was looked for there, and whether it was found."""
    connection.execute(
        """update reference_point p set attempts = attempts + 1, successes = successes + new.found::int,
               last_success_at = case when new.found then now() else last_success_at end
           from (select * from unnest(%s::bigint[], %s::bool[]) as n(id, found) order by id) new
           where p.id = new.id""",
        [ids.tolist(), found.tolist()],
    )


def insert_places(connection: Connection, reference_id: int, lon_lat_h: Array) -> None:
    """Keep new places (n, 3) that a scene was found by."""
    with connection.cursor() as cursor:
        cursor.executemany(
            """insert into reference_point (reference_id, geom, attempts, successes, last_success_at)
               values (%s, st_setsrid(st_makepoint(%s, %s, %s), 4979), 1, 1, now())""",
            [(reference_id, *place) for place in lon_lat_h.tolist()],
        )


def lock_reference(connection: Connection, reference_id: int) -> bool:
    """Let one registration after the other keep its places; False when the reference is gone."""
    row = connection.execute(
        "select 1 from reference_image where id = %s for no key update", [reference_id]
    ).fetchone()
    return row is not None


def _wkb(outline: Array) -> bytes:
    return bytes(shapely.to_wkb(shapely.Polygon(outline)))


def _wkb_all_round(outline: Array) -> bytes:
    """An outline a turn to the west, as it is, and a turn to the east.

    Footprints go on beyond 180 degrees on the side where they begin, which may be the other one.
    """
    around = [shapely.Polygon(outline + [turn, 0.0]) for turn in TURNS_DEG]
    return bytes(shapely.to_wkb(shapely.MultiPolygon(around)))
