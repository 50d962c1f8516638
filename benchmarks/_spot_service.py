"""Products of SPOT 2, uploaded to a running service with their names and registered by its jobs."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from amers.app.client import Client
from tests.command_line import amers_here
from tests.service_process import Service, until

READY_S = 600.0
"""Longest time of a job, most of which is the registration."""


@dataclass(frozen=True)
class SpotService:
    """A service with points and a reference, and a client of it that may register."""

    client: Client

    def register(self, image: Path, method: str, folder: Path) -> Path:
        """Upload a product, register it on "points" or a "reference", download the results."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        scene = self.client.upload_scene(image)
        self.client.upload_file(scene, image.with_name("METADATA.DIM"))
        job = self.client.execute("register-scene", {"scene": scene, "method": method})
        self.client.download(self.client.wait(job, timeout_s=READY_S), folder)
        return folder


@contextmanager
def spot_service(folder: Path, block: Path, reference: Sequence[object]) -> Iterator[SpotService]:
    """A service that has published a block and has a reference image.

    Args:
        folder: for its files; the reference lies in it.
        block: folder of the block.
        reference: options of a command, as `write_reference` returns them.
    """
    service = Service(folder / "data", AMERS_REFERENCE_FOLDER=str(folder))
    environment = {**os.environ, **service.environment}

    def amers(*words: object) -> str:
        done = amers_here(words, environment)
        if done.returncode:
            raise SystemExit(f"{words}: {done.stderr}")
        return str(done.stdout)

    try:
        if not until(service.is_ready):
            raise SystemExit(f"the service did not start: {service.log.read_text()}")
        amers("block", "ingest", block)
        amers("block", "publish", "spot-2")
        ortho, *terrain = [word.name if isinstance(word, Path) else word for word in reference[1:6]]
        amers("reference", "add", ortho, "--name", "spot", *terrain, "--sigma-m", "1.0")
        secret = amers("token", "create", "spot", "--scope", "register").split()[-1]
        with Client(service.url, secret) as client:
            yield SpotService(client)
    finally:
        service.end()
