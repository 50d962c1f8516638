"""The parts of an installation that most use cases need together."""

from dataclasses import dataclass

from app.config import Settings
from app.db.engine import Database
from app.storage import Storage


@dataclass(frozen=True)
class Installation:
    """The database, the file storage and the settings of one installation."""

    database: Database
    storage: Storage
    settings: Settings
