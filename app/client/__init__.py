"""A Python client of an Amers service: `from amers import Client`, or `from amers_client import Client`.

It needs httpx alone. The distribution `amers-client` installs this folder as the package `amers_client`,
so its modules import each other relatively, and nothing else of Amers.

from pathlib import Path

from amers_client import Client

with Client("http://127.0.0.1:8000", token) as client:
    scene = client.upload_scene(Path("scene.tif"))
    job = client.wait(client.execute("register-scene", {"scene": scene}))
    client.download(job, Path("registered"))
    print(job.verdict)
"""

from .client import Box, Client, Feature
from .errors import JobFailed, RequestRefused, ServiceError, ServiceFailure
from .job import Job, Progress

__all__ = [
    "Box",
    "Client",
    "Feature",
    "Job",
    "JobFailed",
    "Progress",
    "RequestRefused",
    "ServiceError",
    "ServiceFailure",
]
