"""Which reference image a scene gets, and which places on it are tried first."""

import numpy as np
import pytest

from amers.app.db import references
from amers.app.db.engine import Connection
from amers.app.db.references import NewReferenceImage, ReferenceRow
from tests.statements import run_sql

SQUARE = np.array([[5.0, 43.0], [5.1, 43.0], [5.1, 43.1], [5.0, 43.1]])


def added(connection: Connection, name: str, outline: np.ndarray, gsd_m: float = 1.0) -> ReferenceRow:
    """A reference image of an outline."""
    new = NewReferenceImage(name, f"{name}.tif", None, None, None, None, None, gsd_m, {})
    row = references.insert_reference(connection, new, outline)
    assert row is not None
    return row


def half(outline: np.ndarray, share: float = 0.5) -> np.ndarray:
    """The western part of a square."""
    west = outline[:, 0].min()
    return np.column_stack([west + (outline[:, 0] - west) * share, outline[:, 1]])


def best(connection: Connection, outline: np.ndarray = SQUARE) -> str | None:
    row = references.best_reference(connection, outline)
    return None if row is None else row.name


def test_the_reference_that_covers_most_comes_before_a_finer_one_and_of_equals_the_finest(
    connection: Connection,
):
    assert best(connection) is None
    added(connection, "half", half(SQUARE), gsd_m=0.2)
    assert best(connection) == "half"
    added(connection, "coarse", SQUARE, gsd_m=2.0)
    assert best(connection) == "coarse"
    added(connection, "fine", SQUARE, gsd_m=0.5)
    added(connection, "middling", SQUARE, gsd_m=1.0)
    assert best(connection) == "fine"
    added(connection, "finest, less a rim", half(SQUARE, 0.999), gsd_m=0.3)
    assert best(connection) == "finest, less a rim", "a thousandth of the ground does not matter"
    assert best(connection, SQUARE + [1.0, 0.0]) is None


PLACES = {
    "never failed": (4, 4),
    "mostly matched": (4, 3),
    "as often as not": (4, 2),
    "failed twice": (2, 0),
    "lost": (3, 1),
}
"""Places by their attempts and successes."""


@pytest.fixture
def places(connection: Connection) -> dict[int, str]:
    """Places of one reference image, by their ids."""
    reference = added(connection, "ortho", SQUARE)
    lon_lat_h = np.array([[5.01 + 0.01 * i, 43.05, 100.0 + i] for i in range(len(PLACES))])
    references.insert_places(connection, reference.id, lon_lat_h)
    rows = run_sql(connection, "select id from reference_point order by st_x(geom)").fetchall()
    names = dict(zip((row["id"] for row in rows), PLACES, strict=True))
    for place, name in names.items():
        run_sql(
            connection,
            "update reference_point set attempts = %s, successes = %s where id = %s",
            [*PLACES[name], place],
        )
    return names


def test_places_are_tried_by_their_success_without_those_where_scenes_are_lost(connection, places):
    (reference,) = references.list_references(connection)
    worthwhile = references.places_inside(connection, reference.id, SQUARE, worthwhile=True)
    assert [places[place] for place in worthwhile.id] == [
        "never failed",
        "mostly matched",
        "as often as not",
        "failed twice",
    ]
    everything = references.places_inside(connection, reference.id, SQUARE, worthwhile=False)
    assert [places[place] for place in everything.id][-2:] == ["lost", "failed twice"]
    heights = dict(zip(everything.id.tolist(), everything.lon_lat_h[:, 2].tolist(), strict=True))
    assert heights == {place: 100.0 + i for i, place in enumerate(places)}
    outside = references.places_inside(connection, reference.id, SQUARE + [1.0, 0.0], worthwhile=False)
    assert len(outside.id) == 0


def test_an_attempt_counts_at_its_place_and_a_failure_leaves_the_last_success(connection, places):
    run_sql(connection, "update reference_point set last_success_at = '2020-01-01'")
    found, missed = (place for place, name in places.items() if PLACES[name] == (4, 4) or name == "lost")
    references.count_places(connection, np.array([missed, found]), np.array([False, True]))
    rows = run_sql(
        connection,
        "select id, attempts, successes, last_success_at > '2021-01-01' as is_new from reference_point",
    ).fetchall()
    assert {places[row["id"]]: (row["attempts"], row["successes"], row["is_new"]) for row in rows} == {
        **{name: (*counts, False) for name, counts in PLACES.items()},
        "never failed": (5, 5, True),
        "lost": (4, 1, False),
    }
