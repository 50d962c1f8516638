"""Every request that reads is answered as it was, in an installation with something of each kind.

`tests/golden/replies.json` has the answers. After a change that is meant, write them anew and read what
differs: `WRITE_REPLIES=1 python -m pytest -n0 tests/app/test_replies.py`.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from amers.app.db import engine
from amers.app.usecases.tokens import create_token
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.http_world import http_world
from tests.app.replies import GOLDEN, answers, populate, written

EXPECTED = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}


@pytest.fixture(scope="module")
def found(cluster, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, dict[str, Any]]:
    folder: Path = tmp_path_factory.mktemp("replies")
    with fresh_database(cluster, TEMPLATE) as dsn, http_world(dsn, folder) as world:
        populate(world, dsn, folder)
        with engine.connect(dsn) as connection:
            secret = create_token(connection, "a reader", ["read"]).secret
        answered = answers(world, {"Authorization": f"Bearer {secret}"})
    if "WRITE_REPLIES" in os.environ:
        GOLDEN.write_text(written(answered))
    return answered


def test_the_same_can_be_read(found: Mapping[str, dict[str, Any]]) -> None:
    assert list(found) == list(EXPECTED)


@pytest.mark.parametrize("address", EXPECTED)
def test_a_request_is_answered_as_it_was(found: Mapping[str, dict[str, Any]], address: str) -> None:
    assert found[address] == EXPECTED[address]
