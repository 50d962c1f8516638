"""The file `installation.json` of a storage: the installation that the stored files belong to."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from uuid import UUID

from amers.app.errors import InputError

if TYPE_CHECKING:
    from amers.app.storage.folder import Storage

MARKER = "installation.json"


@dataclass(frozen=True)
class Marker:
    """What a storage records about its installation.

    Attributes:
        installation: its id.
        generation: of the storage when the file was written; the database's is never smaller.
    """

    installation: UUID
    generation: int


def parse_marker(content: bytes) -> Marker:
    """The marker in the content of its file.

    Raises:
        InputError: the file cannot be understood.
    """
    try:
        fields = json.loads(content)
        return Marker(UUID(fields["installation"]), int(fields["generation"]))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{MARKER} of the storage is damaged: no installation can be read") from error


def read_marker(storage: "Storage") -> Marker | None:
    """The installation that a storage belongs to; None if the storage does not name one.

    Raises:
        InputError: the file cannot be understood.
        StorageOutage: the storage cannot be read.
    """
    return storage.look_closely()[1]


def write_marker(storage: "Storage", marker: Marker) -> None:
    """Record in a storage which installation it belongs to."""
    fields = {
        "installation": str(marker.installation),
        "generation": marker.generation,
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    storage.put(MARKER, [json.dumps(fields, indent=2).encode()])
