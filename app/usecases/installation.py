"""The parts of an installation that most use cases need together."""

from dataclasses import dataclass

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.storage import Storage


@dataclass(frozen=True)
class Installation:
    """The database, the file storage and the settings of one installation."""

    database: Database
    storage: Storage
    settings: Settings
