"""How long commands take that do little: CPU time of the whole process, beside `python -c pass`.

A private cluster runs for all of them, with ten blocks. The commands are run in turn, each as a process
of its own; user and system time of the process count, not the time that it waits.
Run: python -m benchmarks.command_line
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import Cluster
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block
from benchmarks._measuring import keep
from tests.factories import make_block

BASE = "python -c pass"
COMMANDS = (
    "--version",
    "--help",
    "block --help",
    "serve --help",
    "block list",
    "block publish --help",
    "token list",
    "audit",
    "db status",
    "points query --help",
    "scene register --help",
)
BLOCKS = 10


@dataclass(frozen=True)
class Outcome:
    """Median CPU time of a command, and how many times that of an empty Python it is."""

    command: str
    cpu_s: float
    ratio: float


def main() -> None:
    """Make a store, measure, print and save the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        with Cluster(folder / "postgres", durable=False).lease() as dsn:
            revisions.upgrade(dsn)
            with engine.connect(dsn) as connection:
                for number in range(BLOCKS):
                    made = make_block(folder / f"block-{number}", 5, version=str(number))
                    ingest_block(connection, Storage(folder / "storage"), made.folder)
            environment = {**os.environ, "AMERS_DATABASE_URL": dsn, "AMERS_DATA_FOLDER": name}
            outcomes = measure(environment, arguments.repeats)
    show(outcomes)
    keep("command_line", [asdict(outcome) for outcome in outcomes])


def measure(environment: dict[str, str], repeats: int) -> list[Outcome]:
    """Time all commands in turn; the first turn, which compiles modules, is not counted."""
    ways = {BASE: [sys.executable, "-c", "pass"]}
    for command in COMMANDS:
        ways[f"amers {command}"] = [sys.executable, "-m", "amers", *command.split()]
    times: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(repeats + 1):
        for name, words in ways.items():
            taken_s = cpu_s(words, environment)
            if turn > 0:
                times[name].append(taken_s)
    medians = {name: median(taken) for name, taken in times.items()}
    return [Outcome(name, taken_s, taken_s / medians[BASE]) for name, taken_s in medians.items()]


def cpu_s(words: list[str], environment: dict[str, str]) -> float:
    """The CPU time of a process."""
    process = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(words)}: exit code {process.returncode}")
    return used.ru_utime + used.ru_stime


def show(outcomes: list[Outcome]) -> None:
    """Print the table."""
    table = Table("command", "CPU, s", "times `python -c pass`", title="Commands that do little")
    for outcome in outcomes:
        table.add_row(outcome.command, f"{outcome.cpu_s:.3f}", f"{outcome.ratio:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
