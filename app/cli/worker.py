"""`amers worker`: a worker alone."""

import logging

from app.config import read_settings
from app.worker.main import run_worker


def worker() -> None:
    """Do the jobs of the queue, one after the other, until Ctrl-C."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    run_worker(read_settings())
