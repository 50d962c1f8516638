"""A campaign: trials that run one after another or in processes, each outcome kept at once."""

import hashlib
import json
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, is_dataclass
from multiprocessing import get_context
from multiprocessing.managers import SyncManager
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Generic, TypeVar, get_type_hints

import cv2
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

T = TypeVar("T")
R = TypeVar("R")
Named = list[tuple[str, T]]
ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class Log(Generic[R]):
    """Outcomes in a file, a line each: pairs of what was tried and what became of it.

    Attributes:
        file: of the lines; a broken line is passed over.
        kinds: the two dataclasses of a pair.
        code: fingerprint of the sources that outcomes follow from.
        any_code: whether outcomes of other sources count.
    """

    file: Path
    kinds: tuple[type, type]
    code: str
    any_code: bool = False

    def read(self) -> dict[str, R]:
        """Outcomes by name."""
        outcomes: dict[str, Any] = {}
        for line in self.file.read_text().splitlines() if self.file.exists() else ():
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            if self.any_code or record["code"] == self.code:
                parts = zip(self.kinds, (record["trial"], record["outcome"]), strict=True)
                outcomes[record["name"]] = tuple(_loaded(kind, values) for kind, values in parts)
        return outcomes

    def append(self, name: str, result: R) -> None:
        """Keep the outcome of a trial."""
        trial, outcome = map(asdict, result)  # type: ignore[call-overload]
        record = {"name": name, "code": self.code, "trial": trial, "outcome": outcome}
        with self.file.open("a") as out:
            out.write(json.dumps(record) + "\n")


def _loaded(kind: type, values: dict[str, Any]) -> Any:
    """A dataclass from what `asdict` and JSON made of it: its dataclasses and tuples come back."""
    hints = get_type_hints(kind)
    for field in fields(kind):
        value = values.get(field.name)
        if isinstance(value, dict) and is_dataclass(hints[field.name]):
            values[field.name] = _loaded(hints[field.name], value)
        elif isinstance(value, list):
            values[field.name] = tuple(value)
    return kind(**values)


def fingerprint(folder: str, *modules: str) -> str:
    """A short hash of the sources below a folder and of some modules of the benchmarks."""
    digest = hashlib.sha256()
    drawn = [ROOT / "benchmarks" / f"_{name}.py" for name in modules]
    for path in sorted((ROOT / folder).rglob("*.py")) + drawn:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def run_campaign(
    trials: Mapping[str, T],
    work: Callable[[T], R],
    *,
    jobs: int = 1,
    stratum: Callable[[T], Hashable] = id,
    log: Log[R] | None = None,
    say: Callable[[str, R], object] = lambda name, result: None,
) -> dict[str, R]:
    """The outcomes of trials by name, in the order of the trials.

    Args:
        trials: by name; those that the log has are not run again.
        work: what is done with a trial; the same trial gives the same outcome.
        jobs: processes.
        stratum: trials of one stratum run one after another in one process, and share what it makes.
        log: keeps every outcome as soon as it is known.
        say: receives each new outcome.
    """
    outcomes = {} if log is None else log.read()
    missing = {name: trial for name, trial in trials.items() if name not in outcomes}
    columns = TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress:
        task = progress.add_task("", total=len(trials), completed=len(trials) - len(missing))
        for name, result in _run(_groups(missing, stratum), work, jobs):
            outcomes[name] = result
            if log is not None:
                log.append(name, result)
            say(name, result)
            progress.advance(task)
    return {name: outcomes[name] for name in trials}


def _groups(trials: Mapping[str, T], stratum: Callable[[T], Hashable]) -> list[Named[T]]:
    """Trials by stratum, the largest first."""
    groups: dict[Hashable, Named[T]] = {}
    for name, trial in trials.items():
        groups.setdefault(stratum(trial), []).append((name, trial))
    return sorted(groups.values(), key=len, reverse=True)


def _run(
    groups: list[list[tuple[str, T]]], work: Callable[[T], R], jobs: int
) -> Iterator[tuple[str, R]]:
    """Names and outcomes in the order in which they end."""
    if jobs == 1:
        yield from ((name, work(trial)) for group in groups for name, trial in group)
        return
    context = get_context("spawn")
    with SyncManager(ctx=context) as manager, ProcessPoolExecutor(jobs, context) as pool:
        done: Queue[tuple[str, R]] = manager.Queue()
        futures = [pool.submit(_run_group, group, work, done) for group in groups]
        for _ in range(sum(map(len, groups))):
            while True:
                try:
                    yield done.get(timeout=1.0)
                    break
                except Empty:
                    for future in futures:
                        if future.done():
                            future.result()


def _run_group(group: Named[T], work: Callable[[T], R], done: "Queue[tuple[str, R]]") -> None:
    cv2.setNumThreads(1)
    for name, trial in group:
        done.put((name, work(trial)))
