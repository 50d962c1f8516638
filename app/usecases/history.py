"""What registrations say of points: remembered, shown, and acted upon by an administrator."""

from uuid import UUID

from app.db import history, registrations, superseding
from app.db.engine import Connection
from app.db.history import PointHistory
from app.errors import Conflict, InputError, NotFound
from services.registration.on_points import Registration

MOST_HISTORIES = 1000
LONGEST_REASON = 500


def remember(
    connection: Connection, registration_id: UUID, registration: Registration, scene_key: str
) -> None:
    """Keep what a registration did with each point and view; count it, if it can be trusted, once.

    A registration whose verdict is "failed" says nothing of its points: its model may be wrong, and
    then the points that found their place are those that seem to have failed. Nor does a second
    registration of the same scene say anything that the first did not.

    Args:
        connection: of the transaction that ends the registration.
        registration_id: its row.
        registration: on points of the store.
        scene_key: the same for the same image.
    """
    history.insert_measures(connection, registration_id, registration.measures)
    history.insert_views(connection, registration_id, registration.measures, registration.views)
    if registration.qualification.verdict == "failed":
        return
    if registrations.claim_scene(connection, registration_id, scene_key):
        history.count_registration(connection, registration_id)


def find_history(connection: Connection, point_id: int) -> PointHistory:
    """How a point fared in the scenes that tried it.

    Raises:
        NotFound: there is no such point.
    """
    found = history.find_history(connection, point_id) if abs(point_id) < 2**63 else None
    if found is None:
        raise NotFound(f"no point {point_id}")
    return found


def list_histories(connection: Connection, state: str, limit: int = 100) -> list[PointHistory]:
    """The points that are proposed for suspension, or suspended, or served though tried: worst first.

    Raises:
        InputError: no such state, or the limit is out of range.
    """
    if state not in history.STATES:
        raise InputError(f"state: {state!r:.40} found, one of {', '.join(history.STATES)} expected")
    if not 1 <= limit <= MOST_HISTORIES:
        raise InputError(f"limit: {limit} found, 1 to {MOST_HISTORIES} expected")
    return history.list_histories(connection, state, limit)


def suspend_point(connection: Connection, point_id: int, because: str) -> PointHistory:
    """Serve a point no longer, neither to registrations nor to readers; it can be reinstated.

    Raises:
        InputError: no reason is given, or one that is too long.
        NotFound: there is no such point.
        Conflict: it is suspended already.
    """
    if not 1 <= len(because.strip()) <= LONGEST_REASON:
        raise InputError(f"because: 1 to {LONGEST_REASON} characters expected, {len(because)} found")
    before = find_history(connection, point_id)
    if not history.suspend(connection, point_id, because.strip()):
        raise Conflict(f"point {point_id} is suspended already, because: {before.suspended_because}")
    superseding.count_unserved(connection)
    return find_history(connection, point_id)


def reinstate_point(connection: Connection, point_id: int) -> PointHistory:
    """Serve a suspended point again; its history begins anew.

    Raises:
        NotFound: there is no such point.
        Conflict: it is not suspended.
    """
    find_history(connection, point_id)
    if not history.reinstate(connection, point_id):
        raise Conflict(f"point {point_id} is not suspended")
    superseding.count_unserved(connection)
    return find_history(connection, point_id)
