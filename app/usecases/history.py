"""History of points: record what registrations measured, list doubtful points, suspend and reinstate."""

from uuid import UUID

from amers.app.db import history, registrations, superseding
from amers.app.db.engine import Connection
from amers.app.db.history import PointHistory
from amers.app.errors import Conflict, InputError, NotFound
from amers.services.registration.on_points import Registration
from amers.services.registration.scene_marks import without_marks

MOST_HISTORIES = 1000
LONGEST_REASON = 500


def record_measures(
    connection: Connection, registration_id: UUID, registration: Registration, scene_key: str
) -> None:
    """Store the measures of a registration; count them towards the points' history once per scene.

    A registration with the verdict "failed" does not count: its model may be wrong, and then the wrong
    points look good. A second registration of the same scene does not count either: it adds no
    information about the points. Marks of a person are no points of the store, and are left out.

    Args:
        connection: with the transaction that stores the registration.
        registration_id: id of the registration's row.
        registration: on points of the store.
        scene_key: identifies the image; equal for equal images.
    """
    measures = without_marks(registration.measures)
    if not len(measures.point_id):
        return
    history.insert_measures(connection, registration_id, measures)
    history.insert_views(connection, registration_id, measures, registration.views)
    if registration.qualification.verdict == "failed":
        return
    if registrations.claim_scene(connection, registration_id, scene_key):
        history.count_registration(connection, registration_id)


def find_history(connection: Connection, point_id: int) -> PointHistory:
    """The history of a point: how often scenes tried and used it.

    Raises:
        NotFound: there is no such point.
    """
    point = history.find_history(connection, point_id) if abs(point_id) < 2**63 else None
    if point is None:
        raise NotFound(f"no point {point_id}: expected the id of a point of the store")
    return point


def list_histories(connection: Connection, state: str, limit: int = 100) -> list[PointHistory]:
    """The points proposed for suspension, or suspended, or served and tried; the worst first.

    Raises:
        InputError: the state is unknown, or the limit is out of range.
    """
    if state not in history.STATES:
        raise InputError(f"state: {state!r:.40} found, one of {', '.join(history.STATES)} expected")
    if not 1 <= limit <= MOST_HISTORIES:
        raise InputError(f"limit: {limit} found, 1 to {MOST_HISTORIES} expected")
    return history.list_histories(connection, state, limit)


def suspend_point(connection: Connection, point_id: int, because: str) -> PointHistory:
    """Suspend a point: registrations and readers no longer get it. It can be reinstated.

    Raises:
        InputError: the reason is empty or too long.
        NotFound: there is no such point.
        Conflict: the point is already suspended.
    """
    reason = because.strip()
    if not 1 <= len(reason) <= LONGEST_REASON:
        raise InputError(f"because: {len(because)} characters found, 1 to {LONGEST_REASON} expected")
    point = find_history(connection, point_id)
    if not history.suspend(connection, point_id, reason):
        raise Conflict(f"point {point_id} is already suspended, because: {point.suspended_because}")
    superseding.count_unserved(connection)
    return find_history(connection, point_id)


def reinstate_point(connection: Connection, point_id: int) -> PointHistory:
    """Serve a suspended point again; its history starts again from nothing.

    Raises:
        NotFound: there is no such point.
        Conflict: the point is not suspended.
    """
    find_history(connection, point_id)
    if not history.reinstate(connection, point_id):
        raise Conflict(f"point {point_id} is not suspended")
    superseding.count_unserved(connection)
    return find_history(connection, point_id)
