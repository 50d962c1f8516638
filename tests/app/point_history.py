"""Simulated time for a store: recorded times are moved into the past."""

from amers.app.db.engine import Connection
from tests.statements import run_sql

MOVED = (
    "update upload set expires_at = expires_at - make_interval(hours => %s)",
    "update scene set created_at = created_at - make_interval(hours => %s) where state = 'uploading'",
    "update uptime set advanced_at = advanced_at - make_interval(hours => %s)",
)


def jump(connection: Connection, hours: int) -> None:
    """Simulate a jump of the database's clock, ahead or back."""
    for statement in MOVED:
        run_sql(connection, statement, [hours])


def let_pass(connection: Connection, hours: int) -> None:
    """Simulate hours during which the service runs."""
    jump(connection, hours)
    run_sql(
        connection,
        "update uptime set elapsed_s = elapsed_s + 3600 * %s, advanced_at = clock_timestamp()",
        [hours],
    )
