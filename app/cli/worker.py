"""`amers worker`: a worker without the API."""

from amers.app import logs
from amers.app.config import read_settings
from amers.app.worker.main import run_worker


def worker() -> None:
    """Run the jobs of the queue, one after another, until Ctrl-C."""
    settings = read_settings()
    logs.configure(settings)
    run_worker(settings)
