"""Where long work is computed: in processes of this machine, or on a Dask cluster."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from amers.app.child_processes import leave_out_working_folder
from amers.app.errors import InputError
from amers.app.one_thread import use_one_thread

_LOST_WORKERS = 3
"""How often a task is given to another worker after its own was lost."""
_SECONDS_TO_CONNECT = 30


@dataclass(frozen=True)
class ComputeOptions:
    """Where tasks are computed.

    Attributes:
        jobs: processes on this machine; ignored with a cluster.
        cluster: address of the scheduler of a Dask cluster, such as tcp://host:8786.
    """

    jobs: int = 1
    cluster: str | None = None


@contextmanager
def open_executor(options: ComputeOptions) -> Iterator[tuple[Executor, int]]:
    """An executor, and the number of tasks that keep it busy.

    Raises:
        InputError: the cluster cannot be reached or has no workers, or the library for it is missing.
    """
    if options.cluster is not None:
        with _cluster(options.cluster) as opened:
            yield opened
        return
    if options.jobs == 1:
        with ThreadPoolExecutor(max_workers=1) as thread:
            yield thread, 1
        return
    use_one_thread()
    leave_out_working_folder()
    # Children that are forked from threads may lock up.
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(options.jobs, mp_context=context, initializer=_begin_process) as pool:
        # Its users cancel what they do not need any more. With `cancel_futures`, Python 3.11 never ends
        # where a task cannot be pickled.
        yield pool, options.jobs + 1


def _begin_process() -> None:
    import cv2

    cv2.setNumThreads(1)


@contextmanager
def _cluster(address: str) -> Iterator[tuple[Executor, int]]:
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--cluster: the library of Dask is not installed; install amers[cluster]"
        ) from None
    try:
        client: Any = Client(address, timeout=_SECONDS_TO_CONNECT)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise InputError(f"--cluster: {address}: no scheduler of Dask answers: {error}") from error
    with client:
        threads = sum(client.nthreads().values())
        if threads == 0:
            raise InputError(
                f"--cluster: {address}: the cluster has no workers; start some with "
                f"`dask worker {address}`"
            )
        client.run(_begin_process)
        yield client.get_executor(pure=False, retries=_LOST_WORKERS), 2 * threads
