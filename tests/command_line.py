"""The command `amers`, run in the process of a test: a process of its own takes seconds to start."""

import gc
import io
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from unittest.mock import patch

from amers.app.cli.main import main
from amers.app.config import Settings

Done = subprocess.CompletedProcess[str]


def environment_of(settings: Settings, **more: str) -> dict[str, str]:
    """The environment in which commands work on the database and the data folder of settings."""
    assert settings.database_url is not None
    return os.environ | {
        "AMERS_DATABASE_URL": settings.database_url.get_secret_value(),
        "AMERS_DATA_FOLDER": str(settings.data_folder),
        **more,
    }


def amers_here(words: Sequence[object], environment: Mapping[str, str]) -> Done:
    """What `amers` with these words does in an environment, as a process of its own would end and print.

    Commands that serve or work until a signal need a process: see `amers_process`.
    """
    command = ["amers", *map(str, words)]
    printed, said = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8") for _ in range(2))
    with (
        _restored(),
        patch.dict(os.environ, environment, clear=True),
        patch.object(sys, "argv", command),
        redirect_stdout(printed),
        redirect_stderr(said),
    ):
        code = _exit_code()
    return Done(command, code, *(_text(stream) for stream in (printed, said)))


def amers_process(words: Sequence[object], environment: Mapping[str, str]) -> Done:
    """What `amers` with these words does as a process."""
    command = [sys.executable, "-m", "amers", *map(str, words)]
    return subprocess.run(
        command, env=dict(environment), capture_output=True, text=True, timeout=600, check=False
    )


def _exit_code() -> int:
    try:
        main()
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def _text(stream: io.TextIOWrapper) -> str:
    stream.seek(0)
    return stream.read()


@contextmanager
def _restored() -> Iterator[None]:
    """Put back what a command sets for its process."""
    numbers = (signal.SIGTERM, signal.SIGHUP)
    handlers, threshold = [signal.getsignal(number) for number in numbers], gc.get_threshold()
    try:
        yield
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)
        gc.set_threshold(*threshold)
