"""Independent tasks, computed by any executor in any order, with results stored by name."""

import time
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy.typing as npt

from amers.services.types import Progress, no_progress

Arrays = Mapping[str, npt.NDArray[Any]]
"""What a task returns: arrays by their names."""


@dataclass(frozen=True)
class Effort:
    """What tasks of one stage took.

    Attributes:
        tasks: number of those that were computed, not kept from before.
        cpu_s: seconds of one core.
    """

    tasks: int = 0
    cpu_s: float = 0.0


class Here(Executor):
    """Computes tasks where they are submitted, one after the other."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """A future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@dataclass(frozen=True)
class Work:
    """Where tasks are computed, and where their results are kept.

    Attributes:
        executor: of the tasks: threads, processes, or the machines of a cluster.
        kept: results by the name of the task. One that is there is not computed again, so that a
            mapping on a disk lets an interrupted work go on.
        ahead: tasks that are handed to the executor at once; their arguments are in memory.
        effort: of the tasks computed so far, by the first part of their names.
    """

    executor: Executor = field(default_factory=Here)
    kept: MutableMapping[str, Arrays] = field(default_factory=dict)
    ahead: int = 2
    effort: dict[str, Effort] = field(default_factory=dict)

    def run(
        self,
        function: Callable[..., Arrays],
        tasks: Sequence[tuple[str, Callable[[], tuple[Any, ...]]]],
        progress: Progress = no_progress,
    ) -> None:
        """Keep the result of every task under its name.

        Results do not depend on the order in which tasks end. The first error of a task ends the work;
        what had ended before stays kept.

        Args:
            function: of the module that it is defined in, so that other processes can import it.
            tasks: names, and what returns the arguments when the task begins.
            progress: receives the fraction done.
        """
        pending: dict[Future[tuple[Arrays, float]], str] = {}
        course, done = _Course(len(tasks)), 0
        try:
            for name, arguments in tasks:
                if name not in self.kept:
                    pending[self.executor.submit(_measured, function, arguments())] = name
                else:
                    course, done = replace(course, kept=course.kept + 1), done + 1
                if len(pending) >= self.ahead:
                    done += self._keep_ended(pending)
                progress(done / len(tasks), course.words(name, done))
            while pending:
                done += self._keep_ended(pending)
                progress(done / len(tasks), course.words(name, done))
        finally:
            for future in pending:
                future.cancel()

    def results(
        self, stage: str, function: Callable[..., Arrays], arguments: Sequence[tuple[Any, ...]]
    ) -> list[dict[str, Any]]:
        """The results of short tasks in their order, which are not kept.

        Args:
            stage: that counts their effort.
            function: as in `run`.
            arguments: of every task.
        """
        return self.each(stage, function, [partial(tuple, one) for one in arguments])

    def each(
        self, stage: str, function: Callable[..., Arrays], tasks: Sequence[Callable[[], tuple[Any, ...]]]
    ) -> list[dict[str, Any]]:
        """As `results`, of tasks whose arguments are made when each begins."""
        here = replace(self, kept={})
        names = [f"{stage}/{number}" for number in range(len(tasks))]
        here.run(function, list(zip(names, tasks, strict=True)))
        return [dict(here.kept.pop(name)) for name in names]

    def _keep_ended(self, pending: dict[Future[tuple[Arrays, float]], str]) -> int:
        ended = wait(pending, return_when=FIRST_COMPLETED).done
        # What has ended well is kept, whatever else has failed.
        for future in sorted(ended, key=lambda future: future.exception() is not None):
            name = pending.pop(future)
            self.kept[name], cpu_s = future.result()
            stage = name.partition("/")[0]
            before = self.effort.get(stage, Effort())
            self.effort[stage] = Effort(before.tasks + 1, before.cpu_s + cpu_s)
        return len(ended)


@dataclass(frozen=True)
class _Course:
    """The tasks of one run: their number, those kept from before, and when the run began."""

    count: int
    kept: int = 0
    begun_s: float = field(default_factory=time.monotonic)

    def words(self, name: str, done: int) -> str:
        """How many tasks are done, and how long the rest takes at the rate so far."""
        words = f"{name.partition('/')[0]}: {done} of {self.count}"
        computed = done - self.kept
        if computed == 0 or done == self.count:
            return words
        left_s = (time.monotonic() - self.begun_s) / computed * (self.count - done)
        return f"{words}, {_duration(left_s)} left"


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.0f} h"


def _measured(function: Callable[..., Arrays], arguments: tuple[Any, ...]) -> tuple[Arrays, float]:
    """The result of a task, and the seconds of a core that it took."""
    begun = time.thread_time()
    return function(*arguments), time.thread_time() - begun
