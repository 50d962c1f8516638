"""The service held to its own description: cases made from it, valid and not, by schemathesis.

AMERS_API_CASES says how many cases an operation gets, a few if it is not set.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
from schemathesis.checks import not_a_server_error
from schemathesis.config import SchemathesisConfig
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from app.config import Settings
from app.main import create_app
from tests.app.running_service import Served, service_with_a_block

pytestmark = pytest.mark.long

CASES = int(os.environ.get("AMERS_API_CASES", "5"))
CONFIG = {
    "generation": {"max-examples": CASES, "deterministic": "AMERS_API_CASES" not in os.environ},
    # Every edge of every parameter by itself: thousands of cases.
    "phases": {"coverage": {"enabled": "AMERS_API_CASES" in os.environ}},
}
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]
THERE_ARE = {"point_id": 2**26 + 7, "feature_id": 2**26 + 7, "reference": "calanques", "view": 2}
"""What paths can name in the store of the tests; half of the cases do."""

DESCRIPTION = schemathesis.openapi.from_dict(
    create_app(Settings(data_folder=Path("unused"))).openapi(),
    config=SchemathesisConfig.from_dict(CONFIG),
)


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory) -> Iterator[Served]:
    with service_with_a_block(cluster, tmp_path_factory.mktemp("served"), "admin") as served:
        yield served


@schemathesis.serializer("application/offset+octet-stream")
def as_it_is(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


@DESCRIPTION.hook
def map_path_parameters(context, path_parameters):
    """Half of the paths lead to something."""
    if not path_parameters or len(str(path_parameters)) % 2:
        return path_parameters
    return {name: THERE_ARE.get(name, value) for name, value in path_parameters.items()}


@DESCRIPTION.parametrize()
def test_every_reply_is_one_that_the_description_of_the_api_knows(case, served):
    reply = case.call(base_url=served.url, headers=served.authorization)
    case.validate_response(reply, checks=CHECKS, headers=served.authorization)
