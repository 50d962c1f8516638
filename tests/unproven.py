"""A storage that is written into without an installation, as by an operator or for a test."""

from dataclasses import replace

from amers.app.config import Settings
from amers.app.storage import Storage, open_storage


def unproven_storage(settings: Settings) -> Storage:
    """The storage of settings, which takes files whatever marker it carries."""
    return replace(open_storage(settings), proof=None)
