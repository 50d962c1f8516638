"""A Python client of an Amers service. Importing it loads httpx and nothing else of weight.

from pathlib import Path

from amers.app.client import Client

with Client("http://127.0.0.1:8000", token) as client:
    scene = client.upload_scene(Path("scene.tif"))
    job = client.wait(client.execute("register-scene", {"scene": scene}))
    client.download(job, Path("registered"))
    print(job.verdict)
"""

from amers.app.client.client import Box, Client, Feature
from amers.app.client.errors import JobFailed, RequestRefused, ServiceError, ServiceFailure
from amers.app.client.job import Job, Progress

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
