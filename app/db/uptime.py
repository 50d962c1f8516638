"""The table `service_time`: how long the service has run, whatever its clocks were put to.

Ages are counted by it where more than a moment depends on them: `service_time_s()` in SQL.
"""

from app.db.engine import Connection


def advance(connection: Connection, most_s: float) -> None:
    """Let the time of the service go on to now.

    Args:
        most_s: believed of the database's clock; what it says beyond that is a jump, or a rest.
    """
    connection.execute(
        """update service_time set read_at = clock_timestamp(),
               ran_s = ran_s
                   + least(greatest(extract(epoch from clock_timestamp() - read_at), 0.0), %s)""",
        [most_s],
    )
