"""A client that repeats its requests until an installation whose processes are killed answers."""

import hashlib
import random
import time
from base64 import b64encode
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import httpx

from tests.app.flat_world import SIGMA_M

ENDED = ("successful", "failed", "dismissed")
BROKEN = {500, 501, 502, 504}
OUTAGES = {503, 507}
LONGEST_PIECE_BYTES = 600_000
TUS = {"Tus-Resumable": "1.0.0"}


@dataclass
class Caller:
    """A client that repeats requests until they are answered, and remembers what was accepted.

    Attributes:
        log: of the installation, named in errors.
        deadline: on the monotonic clock, seconds.
        scenes: id to checksum of the images that were accepted.
        jobs: id to the scene, the name of the block, or the box of the export.
        unexpected: replies that no outage explains.
        refused: how often each reason for a 503 or 507 was given.
        longest_s: time of the slowest request, and what it was.
        n_timeouts: requests without a reply within the timeout of the client.
    """

    client: httpx.Client
    log: str
    deadline: float
    scenes: dict[str, str] = field(default_factory=dict)
    jobs: dict[str, str] = field(default_factory=dict)
    unexpected: list[str] = field(default_factory=list)
    refused: "Counter[str]" = field(default_factory=Counter)
    longest_s: tuple[float, str] = (0.0, "")
    n_timeouts: int = 0

    def ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        """The reply to a request, which is repeated while the service or its database is down.

        Raises:
            TimeoutError: there was no reply until the deadline.
        """
        while time.monotonic() < self.deadline:
            reply = self.try_once(method, path, **more)
            if reply is not None:
                return reply
            time.sleep(0.1)
        raise TimeoutError(f"{method} {path}: not answered: see {self.log}")

    def try_once(self, method: str, path: str, **more: Any) -> httpx.Response | None:
        """The reply to a request; None while the service or its database is down."""
        began = time.monotonic()
        try:
            reply = self.client.request(method, path, **more)
        except httpx.TimeoutException:
            self.n_timeouts += 1
            return None
        except httpx.TransportError:
            return None
        finally:
            self.longest_s = max(self.longest_s, (time.monotonic() - began, f"{method} {path}"))
        if reply.status_code in BROKEN:
            self.unexpected.append(f"{method} {path}: {reply.status_code} {reply.text[:200]}")
        elif reply.status_code in OUTAGES:
            # The reply to HEAD has no body.
            detail = reply.json().get("detail") if reply.content else f"{method}: {reply.status_code}"
            self.refused[str(detail)] += 1
        else:
            return reply
        return None

    def register(self, image: bytes, passes: int, key: str) -> None:
        """Upload a scene and request its registration."""
        name = f"/scenes?name=scene.tif&sigma_m={SIGMA_M}"
        scene = self._promised(self.ask("POST", name, content=image))["id"]
        self.scenes[scene] = hashlib.sha256(image).hexdigest()
        inputs = {"scene": scene, "options": {"fine_stages": passes}}
        self._execute("register-scene", inputs, key, scene)

    def export(self, bbox: tuple[float, float, float, float], key: str) -> None:
        """Request the export of the points of a box."""
        self._execute("export-block", {"bbox": bbox}, key, str(bbox))

    def ingest(self, name: str, key: str) -> None:
        """Request the ingestion of a block."""
        body = {"path": name, "publish": True}
        job = self._promised(self.ask("POST", "/blocks", json=body, headers={"Idempotency-Key": key}))
        self.jobs[job["jobID"]] = name

    def upload(self, image: bytes, rng: random.Random) -> None:
        """Upload a scene in pieces of random length, and go on where the service lost the thread."""
        sha256 = hashlib.sha256(image).hexdigest()
        values = {"filename": "pieces.tif", "sha256": sha256}
        metadata = ", ".join(
            f"{name} {b64encode(value.encode()).decode()}" for name, value in values.items()
        )
        headers = TUS | {"Upload-Length": str(len(image)), "Upload-Metadata": metadata}
        created = self.ask("POST", "/uploads", headers=headers)
        if created.status_code != 201:
            raise RuntimeError(f"POST /uploads: {created.status_code} {created.text}")
        path = f"/uploads/{created.headers['location'].rsplit('/', 1)[1]}"
        offset = 0
        while offset < len(image) or not self._is_finished(path):
            piece = image[offset : offset + rng.randint(1, LONGEST_PIECE_BYTES)]
            headers = TUS | {
                "Upload-Offset": str(offset),
                "Content-Type": "application/offset+octet-stream",
            }
            sent = self.try_once("PATCH", path, headers=headers, content=piece)
            if sent is not None and sent.status_code == 204:
                offset = int(sent.headers["upload-offset"])
            else:
                # A lost reply, or an offset that a lost reply hides (409, 423): ask where to go on.
                offset = self._offset(path)
        self.scenes[created.headers["amers-scene"]] = sha256

    def wait(self, open_jobs: int) -> None:
        """Wait until at most this many jobs are open."""
        waiting = set(self.jobs)
        while len(waiting) > open_jobs:
            for job in tuple(waiting):
                if self.ask("GET", f"/jobs/{job}").json().get("status") in ENDED:
                    waiting.discard(job)
            time.sleep(0.2)

    def _execute(self, process: str, inputs: dict[str, Any], key: str, subject: str) -> None:
        path, headers = f"/processes/{process}/execution", {"Idempotency-Key": key}
        job = self._promised(self.ask("POST", path, json={"inputs": inputs}, headers=headers))
        self.jobs[job["jobID"]] = subject

    def _offset(self, path: str) -> int:
        reply = self.ask("HEAD", path, headers=TUS)
        if reply.status_code != 200:
            raise RuntimeError(f"HEAD {path}: {reply.status_code}: the upload is lost")
        return int(reply.headers["upload-offset"])

    def _is_finished(self, path: str) -> bool:
        return bool(self.ask("GET", path).json().get("state") == "finished")

    def _promised(self, reply: httpx.Response) -> dict[str, Any]:
        if reply.status_code != 201:
            raise RuntimeError(f"{reply.request.url}: {reply.status_code} {reply.text}")
        document: dict[str, Any] = reply.json()
        return document
