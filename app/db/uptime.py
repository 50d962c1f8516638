"""The table `uptime`: how long the service has run, independent of changes of the clock.

Ages that decide over files are counted in it: `uptime_s()` in SQL.
"""

from datetime import date

from sqlalchemy import extract, func, select, update

from amers.app.db.engine import Connection
from amers.app.db.schema import clock, uptime, uptime_s


def advance(connection: Connection, most_s: float) -> None:
    """Advance the time that the service has run to now.

    Args:
        most_s: the longest step; beyond it the clock of the database has jumped, or the service did not
            run.
    """
    step_s = extract("epoch", clock - uptime.c.advanced_at)
    connection.execute(
        update(uptime).values(
            advanced_at=clock,
            elapsed_s=uptime.c.elapsed_s + func.least(func.greatest(step_s, 0.0), most_s),
        )
    )


def today(connection: Connection) -> tuple[date, float]:
    """The date by the clock of the database, and the seconds that the service has run."""
    row = connection.execute(select(func.current_date().label("day"), uptime_s.label("uptime_s"))).one()
    return row.day, float(row.uptime_s)
