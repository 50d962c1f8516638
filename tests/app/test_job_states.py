"""Every change of a job does to a job in every state what it did, and nothing to other jobs.

`tests/golden/job_states.json` has what: columns that change, tickets, turns and messages, or that it is
refused. After a change that is meant, write it anew and read what differs:
`WRITE_JOB_STATES=1 python -m pytest -n0 tests/app/test_job_states.py`.
"""

import json
import os

import pytest

from amers.app.db.engine import Connection
from tests.app.job_states import GOLDEN, STATES, outcomes, written


@pytest.mark.parametrize("state", STATES)
def test_every_change_does_to_a_job_in_a_state_what_it_did(state: str, connection: Connection) -> None:
    found = dict(outcomes(connection, state))
    expected = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    if "WRITE_JOB_STATES" in os.environ:
        GOLDEN.write_text(written({**expected, state: found}))
    else:
        assert found == expected[state]
