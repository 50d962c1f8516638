"""Clock jumps: leases and tokens follow the clock of the database, time limits a monotonic clock."""

import os
import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.usecases.tokens import create_token
from tests.app.flat_world import make_flat_world
from tests.app.installation import Installation
from tests.app.worker_processes import wait_until
from tests.service_process import free_port
from tests.statements import run_in, run_sql

pytestmark = pytest.mark.thorough

LEASE_S = 3.0
PASSES = 40
JUMPS_DAYS = (2.0, -3.0, 14_600.0, -1.0)
SOURCE = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static long long wrong_by(void) {
    static volatile long long *seconds = 0;
    if (!seconds) {
        int file = open(getenv("WRONG_CLOCK"), O_RDONLY);
        seconds = mmap(0, sizeof *seconds, PROT_READ, MAP_SHARED, file, 0);
    }
    return *seconds;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    int (*right)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int answer = right(clock, now);
    if (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE) now->tv_sec += wrong_by();
    return answer;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    now->tv_sec = fine.tv_sec;
    now->tv_usec = fine.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *into) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    if (into) *into = fine.tv_sec;
    return fine.tv_sec;
}
"""


@dataclass(frozen=True)
class WrongClock:
    """The wall clock of processes, moved by a number of seconds in a file; other clocks are unchanged.

    Attributes:
        file: eight bytes, a whole number of seconds.
        environment: of the processes.
    """

    file: Path
    environment: dict[str, str]

    def jump(self, days: float) -> None:
        """Move the clock this far from the right time."""
        with self.file.open("r+b") as file:
            file.write(struct.pack("q", round(86_400 * days)))


@pytest.fixture
def clock(tmp_path: Path) -> WrongClock:
    """A clock that shows the right time at first."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler is installed: no clock can be made to jump")
    source, library, file = (tmp_path / name for name in ("clock.c", "clock.so", "clock"))
    source.write_text(SOURCE)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    file.write_bytes(struct.pack("q", 0))
    return WrongClock(file, {"LD_PRELOAD": str(library), "WRONG_CLOCK": str(file)})


def lease(dsn: str) -> object:
    """When the lease of the job ends; None for a job that has ended."""
    (row,) = run_in(engine.connect(dsn), "select lease_until from job")
    return row["lease_until"]


def test_a_worker_whose_clock_jumps_keeps_its_job(
    clock: WrongClock, installation: Installation, dsn: str, tmp_path: Path
):
    world = make_flat_world(tmp_path / "world", size=800)
    job = installation.registering(world)(PASSES)
    with installation.worker(clock.environment, lease_seconds=LEASE_S) as worker:
        installation.process(job, worker)
        for days in JUMPS_DAYS:
            clock.jump(days)
            before = lease(dsn)
            wait_until(
                lambda before=before: lease(dsn) != before,
                "the lease is renewed, or the job has ended",
            )
        ended_job = installation.ended(job)
    assert ended_job["status"] == "successful", ended_job
    (row,) = run_in(engine.connect(dsn), "select attempt, failures from job")
    assert row == {"attempt": 1, "failures": 0}


@pytest.mark.parametrize("wrong_days", [14_600.0, -7_300.0])
def test_tokens_expire_by_the_clock_of_the_database(
    clock: WrongClock, settings: Settings, dsn: str, wrong_days: float
):
    clock.jump(wrong_days)
    with engine.connect(dsn) as connection:
        valid = create_token(connection, "valid for a day", ["read"], 1).secret
        expired = create_token(connection, "expired", ["read"], 1)
        run_sql(
            connection,
            "update token set expires_at = now() - interval '1 hour' where id = %s",
            [expired.token.id],
        )
    port = free_port()
    environment = (
        os.environ
        | clock.environment
        | {
            "AMERS_DATABASE_URL": dsn,
            "AMERS_DATA_FOLDER": str(settings.data_folder),
        }
    )
    command = [sys.executable, "-m", "amers", "serve", "--no-worker", "--port", str(port)]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet) as service:
        try:
            url = f"http://127.0.0.1:{port}"
            wait_until(lambda: answers(f"{url}/readyz"), "the service is ready")
            for secret, status in ((valid, 200), (expired.secret, 401)):
                headers = {"Authorization": f"Bearer {secret}"}
                assert httpx.get(f"{url}/jobs", headers=headers, timeout=30).status_code == status
        finally:
            service.terminate()


def answers(url: str) -> bool:
    try:
        return httpx.get(url, timeout=30).status_code == 200
    except httpx.TransportError:
        return False
