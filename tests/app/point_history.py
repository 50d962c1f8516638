"""Time that passes for a store: what was written down lies further back."""

from app.db.engine import Connection

MOVED = (
    "update upload set expires_at = expires_at - make_interval(hours => %s)",
    "update scene set created_at = created_at - make_interval(hours => %s) where state = 'uploading'",
    "update service_time set read_at = read_at - make_interval(hours => %s)",
)


def jump(connection: Connection, hours: int) -> None:
    """The clock of the database is so far ahead of what it was, all of a sudden; or behind."""
    for statement in MOVED:
        connection.execute(statement, [hours])


def let_pass(connection: Connection, hours: int) -> None:
    """So many hours go by in which the service runs."""
    jump(connection, hours)
    connection.execute(
        "update service_time set ran_s = ran_s + 3600 * %s, read_at = clock_timestamp()", [hours]
    )
