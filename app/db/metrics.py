"""Figures of the installation for monitoring: published blocks, waiting jobs, used storage."""

from dataclasses import dataclass

from sqlalchemy import func, select

from amers.app.db.engine import Connection
from amers.app.db.schema import JobState, block, job
from amers.app.db.statements import named
from amers.services.conventions import CHIP_SIZE

INSTALLATION = named("metrics.sql", "installation")


@dataclass(frozen=True)
class Gauges:
    """Figures at one moment.

    Attributes:
        jobs: kind and state to number.
        registrations: verdict on the result of a registration job to number of these jobs.
        oldest_waiting_s: how long the oldest job waits for a worker; 0 when none does.
        queue: entries of the queue that no worker has taken.
        blocks: state to number.
        points: that are served.
        chip_bytes: size of the files of chips of all blocks, without their heads.
        damaged_files: files of the storage that were found damaged or missing, and not repaired since.
        database_bytes: size of the database.
    """

    jobs: dict[tuple[str, str], int]
    registrations: dict[str, int]
    oldest_waiting_s: float
    queue: int
    blocks: dict[str, int]
    points: int
    chip_bytes: int
    damaged_files: int
    database_bytes: int

    def jobs_in(self, state: JobState) -> int:
        """The number of jobs in a state."""
        return sum(number for (_, of), number in self.jobs.items() if of == state)


def read_gauges(connection: Connection) -> Gauges:
    """The figures of this moment."""
    jobs = select(job.c.kind, job.c.state, func.count().label("n")).group_by(job.c.kind, job.c.state)
    verdict = job.c.results["verdict"].astext.label("verdict")
    verdicts = select(verdict, func.count().label("n")).where(verdict.is_not(None)).group_by(verdict)
    blocks = select(block.c.state, func.count().label("n")).group_by(block.c.state)
    return Gauges(
        jobs={(row.kind, row.state): row.n for row in connection.execute(jobs)},
        registrations={row.verdict: row.n for row in connection.execute(verdicts)},
        blocks={row.state: row.n for row in connection.execute(blocks)},
        **connection.execute(INSTALLATION, {"chip_px": CHIP_SIZE**2}).one()._mapping,
    )
