"""The history of points and views: outcomes of registrations and what follows from them.

The rows of a registration are added up once, in its own transaction, in the order of their keys, so that
two registrations of one place wait for each other and never deadlock.
"""

from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Any
from uuid import UUID

import numpy as np
from sqlalchemy import (
    ARRAY,
    BigInteger,
    ColumnElement,
    Integer,
    Text,
    any_,
    bindparam,
    case,
    delete,
    func,
    literal,
    select,
    update,
)
from sqlalchemy.dialects.postgresql import insert

from amers.app.db import binary_copy as binary
from amers.app.db.blocks import in_published_block
from amers.app.db.constants import integer_constant, real_constant, text_constant
from amers.app.db.engine import Connection, driver
from amers.app.db.features.collection import Collection, Property, column_property
from amers.app.db.rows import every, first
from amers.app.db.schema import measure, point, point_history, view_history, view_measure
from amers.app.db.schema.base import Double
from amers.app.db.statements import HotStatement, hot, named
from amers.services.types import HEALTH_PRIOR_TRIES, Array, IntArray, Measures, ViewMeasures, health

NOT_ATTRIBUTABLE = ("not_tried", "no_chip", "nodata", "saturated", "cloud")
"""Reasons that are no fault of a point: the scene did not show it, or the point was not tried."""

SUSPECT_HEALTH = 0.5
"""A point of less health is proposed for suspension: it failed in six scenes where all others served,
in twelve where half of them did."""

STATES = ("served", "proposed", "suspended")

_SUMS = point_history.c
_PRIOR = real_constant(HEALTH_PRIOR_TRIES)
_SUCCESSES = func.coalesce(_SUMS.successes, integer_constant(0))
_EXPECTED = func.coalesce(_SUMS.expected, integer_constant(0))
# `amers.services.types.health` in SQL.
HEALTH = func.least(real_constant(1.0), (_SUCCESSES + _PRIOR) / (_EXPECTED + _PRIOR), type_=Double)
STATE = case(
    (point.c.suspended_at.is_not(None), text_constant("suspended")),
    (real_constant(SUSPECT_HEALTH) > HEALTH, text_constant("proposed")),
    else_=text_constant("served"),
)


def _mean(total: ColumnElement[Any]) -> ColumnElement[Any]:
    """A sum by the number of matches, unknown without any."""
    return total / func.nullif(_SUMS.matched, integer_constant(0), type_=Integer())


OUTCOME: dict[str, ColumnElement[Any]] = {
    "state": STATE,
    "attempts": func.coalesce(_SUMS.attempts, integer_constant(0)),
    "successes": _SUCCESSES,
    "expected": _EXPECTED,
    "health": HEALTH,
    "last_attempt": _SUMS.last_attempt,
    "last_success": _SUMS.last_success,
    "mean_residual_px": _mean(_SUMS.sum_residual_px),
    "mean_east_m": _mean(_SUMS.sum_east_m),
    "mean_north_m": _mean(_SUMS.sum_north_m),
    "suspended_at": point.c.suspended_at,
    "suspended_because": point.c.suspended_because,
}
"""The attributes of `PointHistory` besides its id, of a row of `point` and its row of sums, if any."""


def _property(name: str, title: str, unit: str = "", **options: Any) -> Property:
    return Property(name, title, OUTCOME[name], unit, **options)


HISTORY = Collection(
    id="point-history",
    title="History of points",
    description="Points that registrations have tried, with their success counts and proposals "
    "for suspension.",
    source=point_history.join(point, point.c.id == point_history.c.point_id),
    key=column_property(point.c.id, "Identifier of the point"),
    properties=(
        _property("state", "Served, proposed for suspension, or suspended", choices=STATES),
        _property("attempts", "Scenes that showed the point and tried it"),
        _property("successes", "Scenes in whose final adjustment the point was active"),
        _property("expected", "Successes of an ordinary point in the same scenes"),
        _property("health", "Successes relative to the expected successes, 0 to 1"),
        _property("last_attempt", "When it was tried last", nullable=True),
        _property("last_success", "Time of the last success", nullable=True),
        _property(
            "mean_residual_px", "Mean distance of measures from registered models", "px", nullable=True
        ),
        _property("mean_east_m", "Mean of its residuals eastwards", "m", nullable=True),
        _property("mean_north_m", "Mean of its residuals northwards", "m", nullable=True),
        _property("suspended_at", "When it was suspended", nullable=True),
        _property("suspended_because", "Why it was suspended", nullable=True),
        column_property(point.c.block_number, "Number of its block"),
    ),
    geometry_type="Point",
    geometry=point.c.geom,
    has_height=True,
    visible=in_published_block(),
    interval=("last_attempt", "last_attempt"),
)


@dataclass(frozen=True)
class PointHistory:
    """The outcomes of a point in the scenes that tried it.

    Attributes:
        state: "served", "proposed" for suspension, or "suspended".
        attempts: scenes that showed it and tried it; each counts once.
        successes: scenes in which it was active at the end.
        expected: successes of an ordinary point: the sum of the shares of points that served.
        health: as `amers.services.types.health`, of successes and those expected.
        last_attempt, last_success: None: never.
        mean_residual_px: mean distance of its measures from the registered models; None: never matched.
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


def outcome_columns() -> list[ColumnElement[Any]]:
    """The columns of `PointHistory` besides its id."""
    return [expression.label(name) for name, expression in OUTCOME.items()]


def insert_measures(connection: Connection, registration_id: UUID, measures: Measures) -> None:
    """Store the outcome of each point that a scene could show."""
    count = len(measures.point_id)
    binary.insert_rows(
        connection,
        measure,
        {
            "registration_id": binary.uuids(registration_id, count),
            "point_id": binary.numbers(measures.point_id, "i8"),
            "matched": binary.numbers(measures.matched, "i1"),
            "active": binary.numbers(measures.active, "i1"),
            "reason": binary.texts(measures.reason.astype(object)),
            "score": binary.reals(measures.score, "f4"),
            "line": binary.reals(measures.line_sample[:, 0], "f8"),
            "sample": binary.reals(measures.line_sample[:, 1], "f8"),
            "sigma_px": binary.reals(measures.sigma_px, "f4"),
            "residual_line_px": binary.reals(measures.residual_px[:, 0], "f4"),
            "residual_sample_px": binary.reals(measures.residual_px[:, 1], "f4"),
            "residual_east_m": binary.reals(measures.residual_m[:, 0], "f4"),
            "residual_north_m": binary.reals(measures.residual_m[:, 1], "f4"),
        },
    )


def insert_views(
    connection: Connection, registration_id: UUID, measures: Measures, views: ViewMeasures
) -> None:
    """Store the outcome of each view that was tried."""
    binary.insert_rows(
        connection,
        view_measure,
        {
            "registration_id": binary.uuids(registration_id, len(views.point)),
            "point_id": binary.numbers(measures.point_id[views.point], "i8"),
            "view": binary.numbers(views.view, "i2"),
            "agreed": binary.numbers(views.agreed, "i1"),
            "reason": binary.texts(views.reason.astype(object)),
            "score": binary.reals(views.score, "f4"),
        },
    )


def count_registration(connection: Connection, registration_id: UUID) -> None:
    """Add the rows of a registration to the sums of its points and views.

    A point is expected to succeed as often as the points tried by the same registration did. Of the
    views only those of active points count, since only there the true position in the scene is known.
    """
    parameters = {"registration_id": registration_id, "not_attributable": list(NOT_ATTRIBUTABLE)}
    connection.execute(named("history.sql", "count_points"), parameters)
    connection.execute(named("history.sql", "count_views"), parameters)


def point_health(connection: Connection, ids: IntArray) -> Array:
    """Health (n,) of points of ascending ids; 1 without a history."""
    rows = _rows(connection, _point_sums(), ids)
    values = np.ones(len(ids))
    places = np.searchsorted(ids, _column(rows, 0).astype(np.int64))
    values[places] = health(_column(rows, 1), _column(rows, 2))
    return values


def view_health(connection: Connection, ids: IntArray, start: IntArray) -> Array:
    """Health (m,) of all views of points of ascending ids; 1 without a history.

    Args:
        ids: (n,) of the points.
        start: (n + 1,) where the views of each begin, in the order of their numbers.
    """
    rows = _rows(connection, _view_sums(), ids)
    values = np.ones(int(start[-1]))
    point_places = np.searchsorted(ids, _column(rows, 0).astype(np.int64))
    views = _column(rows, 3).astype(np.int64)
    values[start[point_places] + views] = health(_column(rows, 1), _column(rows, 2))
    return values


@cache
def _point_sums() -> HotStatement:
    columns = (_SUMS.point_id, _SUMS.expected, _SUMS.successes)
    return hot(select(*columns).where(_is_one_of(_SUMS.point_id)).order_by(_SUMS.point_id))


@cache
def _view_sums() -> HotStatement:
    sums = view_history.c
    columns = (sums.point_id, sums.expected, sums.successes, sums.view)
    return hot(select(*columns).where(_is_one_of(sums.point_id)).order_by(sums.point_id, sums.view))


def _is_one_of(column: ColumnElement[int]) -> ColumnElement[bool]:
    return column == any_(bindparam("ids", None, ARRAY(BigInteger())))


def _rows(connection: Connection, statement: HotStatement, ids: IntArray) -> list[tuple[float, ...]]:
    parameters = statement.parameters({"ids": ids.tolist()})
    return driver(connection).execute(statement.sql, parameters).fetchall()


def _column(rows: list[tuple[float, ...]], place: int) -> Array:
    return np.array([row[place] for row in rows], dtype=np.float64)


def find_history(connection: Connection, point_id: int) -> PointHistory | None:
    """The history of a point of any block; None when there is no such point."""
    statement = (
        select(point.c.id, *outcome_columns())
        .select_from(point.outerjoin(point_history, point_history.c.point_id == point.c.id))
        .where(point.c.id == point_id)
    )
    return first(PointHistory, connection.execute(statement))


def list_histories(connection: Connection, state: str, limit: int) -> list[PointHistory]:
    """The points of published blocks in a state, the worst first."""
    statement = (
        select(point.c.id, *outcome_columns())
        .select_from(HISTORY.source)
        .where(literal(state, Text()) == STATE, in_published_block())
        .order_by(HEALTH, OUTCOME["attempts"].desc(), point.c.id)
        .limit(limit)
    )
    return every(PointHistory, connection.execute(statement))


def suspend(connection: Connection, point_id: int, because: str) -> bool:
    """Stop serving a point; False when it does not exist or is not served.

    The point gets a history, so that it is listed with the others.
    """
    suspended = connection.execute(
        update(point)
        .where(point.c.id == point_id, point.c.suspended_at.is_(None))
        .values(suspended_at=func.now(), suspended_because=because)
    )
    if suspended.rowcount:
        history = insert(point_history).values(point_id=point_id)
        connection.execute(history.on_conflict_do_nothing())
    return suspended.rowcount == 1


def reinstate(connection: Connection, point_id: int) -> bool:
    """Serve a suspended point again and delete its history; False when it was not suspended.

    The cause of its failures may be repaired or may have been wrong: with its history the point would be
    proposed again at once.
    """
    reinstated = connection.execute(
        update(point)
        .where(point.c.id == point_id, point.c.suspended_at.is_not(None))
        .values(suspended_at=None, suspended_because=None)
    )
    if reinstated.rowcount:
        connection.execute(delete(point_history).where(point_history.c.point_id == point_id))
    return reinstated.rowcount == 1
