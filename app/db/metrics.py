"""Figures of the installation that are worth watching: what is published, what waits, what it takes."""

from dataclasses import dataclass

from app.db.engine import Connection


@dataclass(frozen=True)
class Gauges:
    """Figures at one moment.

    Attributes:
        jobs: kind and state to number.
        oldest_waiting_s: how long the oldest job waits for a worker; 0 when none does.
        queue: entries of the queue that no worker has taken.
        blocks: state to number.
        points: that are served.
        database_bytes: size of the database.
    """

    jobs: dict[tuple[str, str], int]
    oldest_waiting_s: float
    queue: int
    blocks: dict[str, int]
    points: int
    database_bytes: int


def read_gauges(connection: Connection) -> Gauges:
    """The figures of this moment."""
    jobs = connection.execute("select kind, state, count(*) as n from job group by kind, state")
    blocks = connection.execute("select state, count(*) as n from block group by state")
    row = connection.execute(
        """select
            (select coalesce(extract(epoch from clock_timestamp() - min(created_at)), 0)
                from job where state = 'accepted')::float8 as oldest_waiting_s,
            (select count(*) from procrastinate_jobs where status = 'todo') as queue,
            (select coalesce(sum(n_points - n_unserved), 0) from block
                where state = 'published')::bigint as points,
            pg_database_size(current_database()) as database_bytes"""
    ).fetchone()
    assert row is not None
    return Gauges(
        jobs={(one["kind"], one["state"]): one["n"] for one in jobs},
        blocks={one["state"]: one["n"] for one in blocks},
        **row,
    )
