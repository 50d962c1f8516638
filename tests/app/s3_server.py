"""An S3-compatible server in this process, with a new bucket for each test."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import httpx
import pytest
from moto.server import ThreadedMotoServer

KEYS = {
    "AWS_ACCESS_KEY_ID": "of a test",
    "AWS_SECRET_ACCESS_KEY": "of a test",
    "AWS_REGION": "us-east-1",
}


@contextmanager
def running_bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The AMERS_STORAGE_URL of a new bucket; environment variables lead to its server."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {**KEYS, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
        monkeypatch.setenv(name, value)
    name = f"amers-{uuid4().hex}"
    try:
        httpx.put(f"http://{host}:{port}/{name}").raise_for_status()
        yield f"s3://{name}/test"
    finally:
        server.stop()
