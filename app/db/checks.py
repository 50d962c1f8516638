"""What a database can do at present: answer, in sessions that are ours, and take writes."""

from sqlalchemy import func, select

from amers.app.db.engine import Connection, driver
from amers.app.db.schema import metadata
from amers.app.db.session import SETTINGS, UnusableSession
from amers.app.outages import POOLER, READ_ONLY, RIGHTS

RIGHTS_MISSING = b"""select current_setting('transaction_read_only'), (
        select string_agg(concat_ws(' ', needed, 'on', name), ', ' order by name, needed)
        from unnest(%s::text[]) name, unnest(array['select', 'insert', 'update', 'delete']) needed
        where not has_table_privilege(quote_ident(name), needed))"""


def check_reading(connection: Connection) -> None:
    """Let the database answer, and PostGIS in it, in a reading session that has kept its settings.

    Raises:
        psycopg.Error: one of them does not, or somebody else has had the session.
    """
    setting = func.current_setting
    answer = connection.execute(
        select(func.postgis_version(), setting("transaction_read_only"), setting("TimeZone"))
    ).one()
    if tuple(answer[1:]) != ("on", SETTINGS["TimeZone"]):
        raise UnusableSession(POOLER.reason)


def obstacle_to_writing(connection: Connection) -> str | None:
    """Why the transaction cannot change all tables; None if it can.

    Raises:
        psycopg.Error: the database does not answer, or a table is missing.
    """
    row = driver(connection).execute(RIGHTS_MISSING, [list(metadata.tables)]).fetchone()
    assert row is not None
    read_only, missing = row
    if read_only == "on":
        return READ_ONLY.reason
    return None if missing is None else f"{RIGHTS.reason} ({missing})"
