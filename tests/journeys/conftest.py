"""Fixtures of the journeys: a running service, and the command line beside it."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from tests.command_line import amers_here
from tests.service_process import Service, until

Amers = Callable[..., Any]


@pytest.fixture(scope="module")
def service(open_folder: Path) -> Iterator[Service]:
    """A running service with an empty store."""
    folder = open_folder / uuid4().hex[:8]
    folder.mkdir(mode=0o755)
    service = Service(folder / "data")
    try:
        assert until(service.is_ready), service.log.read_text()
        assert until(service.workers), service.log.read_text()
        yield service
    finally:
        service.end()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def amers(service: Service) -> Amers:
    """Runs a command on the service's installation; returns its JSON output."""

    def run(*words: str | Path) -> Any:
        done = amers_here((*words, "--json"), service.environment)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture(scope="module")
def secret(amers: Amers) -> str:
    """A token that may register scenes."""
    return str(amers("token", "create", "journey", "--scope", "register")["secret"])
