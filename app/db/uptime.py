"""The table `uptime`: how long the service has run, independent of changes of the clock.

Ages that decide over files are counted in it: `uptime_s()` in SQL.
"""

from app.db.engine import Connection


def advance(connection: Connection, most_s: float) -> None:
    """Advance the time that the service has run to now.

    Args:
        most_s: the longest step; beyond it the clock of the database has jumped, or the service did not
            run.
    """
    connection.execute(
        """update uptime set advanced_at = clock_timestamp(),
               elapsed_s = elapsed_s
                   + least(greatest(extract(epoch from clock_timestamp() - advanced_at), 0.0), %s)""",
        [most_s],
    )
