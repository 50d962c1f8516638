"""What registrations did with points and views, and what that says of them.

The rows of a registration are added up once, in its own transaction, in the order of their keys, so that
two registrations of one place wait for each other and never deadlock.
"""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

import numpy as np
from psycopg.rows import class_row

from app.db import binary_copy as binary
from app.db.blocks import PUBLISHED
from app.db.engine import Connection
from app.db.features.collection import Collection, Property
from services.types import HEALTH_PRIOR_TRIES, Array, IntArray, Measures, ViewMeasures, health

SAYS_NOTHING = ("not_tried", "no_chip", "nodata", "cloud")
"""Reasons that are no fault of a point: the scene did not show it, or nobody looked."""

SUSPECT_HEALTH = 0.5
"""A point of less health is proposed for suspension: it failed in six scenes where all others served,
in twelve where half of them did."""

HEALTH = f"""least(1.0, (coalesce(h.successes, 0) + {HEALTH_PRIOR_TRIES})
    / (coalesce(h.expected, 0) + {HEALTH_PRIOR_TRIES}))"""
"""`services.types.health` in SQL."""

STATES = ("served", "proposed", "suspended")
STATE = f"""case when p.suspended_at is not null then 'suspended'
    when {HEALTH} < {SUSPECT_HEALTH} then 'proposed' else 'served' end"""

FARED_OF_POINT = f"""{STATE} as state, coalesce(h.attempts, 0) as attempts,
    coalesce(h.successes, 0) as successes, coalesce(h.expected, 0) as expected, {HEALTH} as health,
    h.last_attempt, h.last_success, h.sum_residual_px / nullif(h.matched, 0) as mean_residual_px,
    h.sum_east_m / nullif(h.matched, 0) as mean_east_m,
    h.sum_north_m / nullif(h.matched, 0) as mean_north_m, p.suspended_at, p.suspended_because"""
"""How a point `p` fared, by its row `h` of sums."""

HISTORY = Collection(
    id="point-history",
    title="History of points",
    description="Points that registrations have tried, how they fared, and which should be suspended.",
    source=f"""(select p.id, {FARED_OF_POINT}, p.geom, p.block_number
        from point_history h join point p on p.id = h.point_id) t""",
    key=Property("id", "bigint", "Identifier of the point"),
    properties=(
        Property("state", "text", "Served, proposed for suspension, or suspended", choices=STATES),
        Property("attempts", "bigint", "Scenes that showed it and tried it"),
        Property("successes", "bigint", "Scenes in which it was active at the end"),
        Property("expected", "double precision", "Successes of an ordinary point in the same scenes"),
        Property("health", "double precision", "Successes against those expected, 0 to 1"),
        Property("last_attempt", "timestamptz", "When it was tried last", nullable=True),
        Property("last_success", "timestamptz", "When it last served", nullable=True),
        Property(
            "mean_residual_px", "double precision", "Mean distance of its measures", "", "px", True
        ),
        Property("mean_east_m", "double precision", "Mean of its residuals eastwards", "", "m", True),
        Property("mean_north_m", "double precision", "Mean of its residuals northwards", "", "m", True),
        Property("suspended_at", "timestamptz", "When it was suspended", nullable=True),
        Property("suspended_because", "text", "Why it was suspended", nullable=True),
        Property("block_number", "bigint", "Number of its block"),
    ),
    geometry_type="Point",
    has_height=True,
    visible=f"t.block_number = any(array({PUBLISHED}))",
    interval=("last_attempt", "last_attempt"),
)


@dataclass(frozen=True)
class PointHistory:
    """How a point fared in the scenes that tried it.

    Attributes:
        state: "served", "proposed" for suspension, or "suspended".
        attempts: scenes that showed it and tried it; each counts once.
        successes: scenes in which it was active at the end.
        expected: what an ordinary point would have had: the sum of the shares of points that served.
        health: as `services.types.health`, of successes and those expected.
        last_attempt, last_success: None: never.
        mean_residual_px: mean distance of its measures from the registered models; None: never found.
        mean_east_m, mean_north_m: mean of its residuals on the ground: where it may really be.
        suspended_at, suspended_because: None unless suspended.
    """

    id: int
    state: str
    attempts: int
    successes: int
    expected: float
    health: float
    last_attempt: datetime | None
    last_success: datetime | None
    mean_residual_px: float | None
    mean_east_m: float | None
    mean_north_m: float | None
    suspended_at: datetime | None
    suspended_because: str | None


def insert_measures(connection: Connection, registration_id: UUID, measures: Measures) -> None:
    """Store what happened to each point that a scene could show."""
    columns = (
        "registration_id, point_id, matched, active, reason, score, line, sample, sigma_px,"
        " residual_line_px, residual_sample_px, residual_east_m, residual_north_m"
    )
    _copy(
        connection,
        f"measure ({columns})",
        [
            binary.uuids(registration_id, len(measures.point_id)),
            binary.numbers(measures.point_id, "i8"),
            binary.numbers(measures.matched, "i1"),
            binary.numbers(measures.active, "i1"),
            binary.texts(measures.reason.astype(object)),
            binary.reals(measures.score, "f4"),
            *(binary.reals(measures.line_sample[:, axis], "f8") for axis in (0, 1)),
            binary.reals(measures.sigma_px, "f4"),
            *(binary.reals(measures.residual_px[:, axis], "f4") for axis in (0, 1)),
            *(binary.reals(measures.residual_m[:, axis], "f4") for axis in (0, 1)),
        ],
    )


def insert_views(
    connection: Connection, registration_id: UUID, measures: Measures, views: ViewMeasures
) -> None:
    """Store what happened to each view that was tried."""
    _copy(
        connection,
        "view_measure (registration_id, point_id, view, agreed, reason, score)",
        [
            binary.uuids(registration_id, len(views.point)),
            binary.numbers(measures.point_id[views.point], "i8"),
            binary.numbers(views.view, "i2"),
            binary.numbers(views.agreed, "i1"),
            binary.texts(views.reason.astype(object)),
            binary.reals(views.score, "f4"),
        ],
    )


def _copy(connection: Connection, table: str, columns: list[binary.Column]) -> None:
    statement = f"copy {table} from stdin (format binary)"
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        for piece, _ in binary.copy_pieces(columns):
            copy.write(piece)


def count_registration(connection: Connection, registration_id: UUID) -> None:
    """Add the rows of a registration to what is known of its points and views.

    A point is expected to serve as often as the points tried by the same registration did. Of the
    views only those of active points count, since only there it is known where they should be found.
    """
    connection.execute(
        """with tried as (
            select point_id, active, matched, residual_east_m, residual_north_m,
                |/ (residual_line_px ^ 2 + residual_sample_px ^ 2) as residual_px
            from measure where registration_id = %(id)s and reason <> all(%(nothing)s)
        )
        insert into point_history as h (point_id, attempts, successes, expected, matched,
            sum_residual_px, sum_east_m, sum_north_m, last_attempt, last_success)
        select point_id, 1, active::int, (select avg(active::int) from tried), matched::int,
            coalesce(residual_px, 0), coalesce(residual_east_m, 0), coalesce(residual_north_m, 0),
            now(), case when active then now() end
        from tried order by point_id
        on conflict (point_id) do update set attempts = h.attempts + 1,
            successes = h.successes + excluded.successes, expected = h.expected + excluded.expected,
            matched = h.matched + excluded.matched,
            sum_residual_px = h.sum_residual_px + excluded.sum_residual_px,
            sum_east_m = h.sum_east_m + excluded.sum_east_m,
            sum_north_m = h.sum_north_m + excluded.sum_north_m,
            last_attempt = excluded.last_attempt,
            last_success = coalesce(excluded.last_success, h.last_success)""",
        {"id": registration_id, "nothing": list(SAYS_NOTHING)},
    )
    connection.execute(
        """with tried as (
            select v.point_id, v.view, v.agreed
            from view_measure v join measure m using (registration_id, point_id)
            where v.registration_id = %(id)s and m.active and v.reason <> all(%(nothing)s)
        )
        insert into view_history as h (point_id, view, attempts, successes, expected)
        select point_id, view, 1, agreed::int, (select avg(agreed::int) from tried)
        from tried order by point_id, view
        on conflict (point_id, view) do update set attempts = h.attempts + 1,
            successes = h.successes + excluded.successes, expected = h.expected + excluded.expected""",
        {"id": registration_id, "nothing": list(SAYS_NOTHING)},
    )


def point_health(connection: Connection, ids: IntArray) -> Array:
    """Health (n,) of points of ascending ids; 1 without a history."""
    rows = connection.execute(
        """select point_id, successes, expected from point_history
           where point_id = any(%s) order by point_id""",
        [ids.tolist()],
    ).fetchall()
    found = np.ones(len(ids))
    at = np.searchsorted(ids, np.array([row["point_id"] for row in rows], dtype=np.int64))
    found[at] = health(*_tried_and_succeeded(rows))
    return found


def view_health(connection: Connection, ids: IntArray, start: IntArray) -> Array:
    """Health (m,) of all views of points of ascending ids; 1 without a history.

    Args:
        ids: (n,) of the points.
        start: (n + 1,) where the views of each begin, in the order of their numbers.
    """
    rows = connection.execute(
        """select point_id, view, successes, expected from view_history
           where point_id = any(%s) order by point_id, view""",
        [ids.tolist()],
    ).fetchall()
    found = np.ones(int(start[-1]))
    point = np.searchsorted(ids, np.array([row["point_id"] for row in rows], dtype=np.int64))
    view = np.array([row["view"] for row in rows], dtype=np.int64)
    found[start[point] + view] = health(*_tried_and_succeeded(rows))
    return found


def _tried_and_succeeded(rows: list[dict[str, float]]) -> tuple[Array, Array]:
    return (
        np.array([row["expected"] for row in rows], dtype=np.float64),
        np.array([row["successes"] for row in rows], dtype=np.float64),
    )


def find_history(connection: Connection, point_id: int) -> PointHistory | None:
    """How a point of any block fared; None when there is no such point."""
    with connection.cursor(row_factory=class_row(PointHistory)) as cursor:
        return cursor.execute(
            f"""select p.id, {FARED_OF_POINT} from point p left join point_history h on h.point_id = p.id
                where p.id = %s""",
            [point_id],
        ).fetchone()


def list_histories(connection: Connection, state: str, limit: int) -> list[PointHistory]:
    """The points of published blocks in a state, the worst first."""
    with connection.cursor(row_factory=class_row(PointHistory)) as cursor:
        return cursor.execute(
            f"""select p.id, {FARED_OF_POINT} from point_history h join point p on p.id = h.point_id
                where {STATE} = %s and p.block_number = any(array({PUBLISHED}))
                order by health, attempts desc, p.id limit %s""",
            [state, limit],
        ).fetchall()


def suspend(connection: Connection, point_id: int, because: str) -> bool:
    """Serve a point no longer; False when there is none that was served.

    The point gets a history, so that it is found there.
    """
    done = connection.execute(
        """update point set suspended_at = now(), suspended_because = %s
           where id = %s and suspended_at is null""",
        [because, point_id],
    )
    if done.rowcount:
        connection.execute(
            "insert into point_history (point_id) values (%s) on conflict do nothing", [point_id]
        )
    return done.rowcount == 1


def reinstate(connection: Connection, point_id: int) -> bool:
    """Serve a suspended point again, its history forgotten; False when it was not suspended.

    What made it fail may have been mended or have been wrong: it would be proposed again at once.
    """
    done = connection.execute(
        """update point set suspended_at = null, suspended_because = null
           where id = %s and suspended_at is not null""",
        [point_id],
    )
    if done.rowcount:
        connection.execute("delete from point_history where point_id = %s", [point_id])
    return done.rowcount == 1
