"""Independent tasks: computed by any executor in any order, their results kept by name."""

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any

import numpy.typing as npt

from services.types import Progress, no_progress

Arrays = Mapping[str, npt.NDArray[Any]]
"""What a task returns: arrays by their names."""


def _own_thread() -> Executor:
    return ThreadPoolExecutor(max_workers=1)


@dataclass(frozen=True)
class Work:
    """Where tasks are computed, and where their results are kept.

    Attributes:
        executor: of the tasks: threads, processes, or the machines of a cluster.
        kept: results by the name of the task. One that is there is not computed again, so that a
            mapping on a disk lets an interrupted work go on.
        ahead: tasks that are handed to the executor at once; their arguments are in memory.
    """

    executor: Executor = field(default_factory=_own_thread)
    kept: MutableMapping[str, Arrays] = field(default_factory=dict)
    ahead: int = 2

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
        pending: dict[Future[Arrays], str] = {}
        done = 0
        try:
            for name, arguments in tasks:
                if name not in self.kept:
                    pending[self.executor.submit(function, *arguments())] = name
                else:
                    done += 1
                if len(pending) >= self.ahead:
                    done += self._keep_ended(pending)
                progress(done / len(tasks), f"{name.partition('/')[0]}: {done} of {len(tasks)}")
            while pending:
                done += self._keep_ended(pending)
                progress(done / len(tasks), f"{name.partition('/')[0]}: {done} of {len(tasks)}")
        finally:
            for future in pending:
                future.cancel()

    def _keep_ended(self, pending: dict[Future[Arrays], str]) -> int:
        ended = wait(pending, return_when=FIRST_COMPLETED).done
        for future in ended:
            self.kept[pending.pop(future)] = future.result()
        return len(ended)
