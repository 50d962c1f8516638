"""The service follows its own description: schemathesis makes valid and invalid requests from it.

AMERS_API_CASES sets the number of cases for each operation, 5 by default.
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

from amers.app.config import Settings
from amers.app.main import create_app
from tests.app.running_service import Served, service_with_a_block

pytestmark = pytest.mark.long

CASES = int(os.environ.get("AMERS_API_CASES", "5"))
CONFIG = {
    "generation": {"max-examples": CASES, "deterministic": "AMERS_API_CASES" not in os.environ},
    # The phase tries every limit of every parameter: thousands of cases.
    "phases": {"coverage": {"enabled": "AMERS_API_CASES" in os.environ}},
}
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]
EXISTING = {"point_id": 2**26 + 7, "feature_id": 2**26 + 7, "reference": "calanques", "view": 2}
"""Identifiers of things in the store of the tests; half of the cases use them."""

DESCRIPTION = schemathesis.openapi.from_dict(
    create_app(Settings(data_folder=Path("unused"))).openapi(),
    config=SchemathesisConfig.from_dict(CONFIG),
)


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory) -> Iterator[Served]:
    with service_with_a_block(cluster, tmp_path_factory.mktemp("served"), "admin") as served:
        yield served


@schemathesis.serializer("application/offset+octet-stream")
def raw_bytes(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


@DESCRIPTION.hook
def map_path_parameters(context, path_parameters):
    """Use existing identifiers in half of the cases."""
    if not path_parameters or len(str(path_parameters)) % 2:
        return path_parameters
    return {name: EXISTING.get(name, value) for name, value in path_parameters.items()}


@DESCRIPTION.parametrize()
def test_every_reply_follows_the_description_of_the_api(case, served):
    reply = case.call(base_url=served.url, headers=served.authorization)
    case.validate_response(reply, checks=CHECKS, headers=served.authorization)
