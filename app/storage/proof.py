"""The proof that a storage is that of its installation, which every write needs.

A folder that is not mounted looks like an empty one, and a bucket may be another one: what is written
there is gone after the remount. The proof is the marker of the storage. It is read at most once in
`VALID_S`, and again after every error; the place itself is compared at every write, by a `stat`.
"""

import threading
import time
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Protocol
from uuid import UUID

from amers.app.errors import InputError, StorageOutage
from amers.app.storage.marker import MARKER, Marker

VALID_S = 1.0
UNKNOWN = "it is not known yet whether the storage of files is that of the database"
NOT_MOUNTED = "the storage of files is not mounted, is empty or is another one"


class Provable(Protocol):
    """What a proof looks at."""

    @property
    def place(self) -> str:
        """The folder or the address, for messages to operators."""

    def look(self) -> Hashable:
        """What tells one place from another under the same name; None where there is nothing. Cheap."""

    def look_closely(self) -> tuple[Hashable, Marker | None]:
        """The same, with the marker that was read in this place."""


class Proof:
    """The identity of one storage, checked before each write. Threads may share it.

    Nothing is written before `bind`: only the database tells which installation it is.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._installation: UUID | None = None
        self._place: Hashable = None
        self._failure: StorageOutage | None = None
        self._looked_at = float("-inf")
        self._granted: Hashable = None

    def bind(self, installation: UUID) -> None:
        """Expect the marker of this installation from now on."""
        if installation != self._installation:
            self._installation = installation
            self.forget()

    def forget(self) -> None:
        """Look closely before the next write."""
        self._looked_at = float("-inf")

    def require(self, storage: Provable) -> Hashable:
        """Check that a storage is that of the installation; returns the place that is.

        Raises:
            StorageOutage: it is not, or cannot be read.
        """
        if self._installation is None:
            raise StorageOutage(f"{storage.place}: {UNKNOWN}", UNKNOWN)
        asked_at = time.monotonic()
        place = storage.look()
        is_proven = place == self._place and asked_at - self._looked_at < VALID_S
        if is_proven or (place is not None and place == self._granted):
            return place
        with self._lock:
            # Who waited for the look of another takes its outcome: a silent bucket holds up once. But
            # that look may have been at another place, where the storage was before.
            is_elsewhere = self._failure is None and place != self._place
            if self._looked_at < asked_at or is_elsewhere:
                self._place = None
                self._failure = self._find_failure(storage)
                self._looked_at = time.monotonic()
            if self._failure is not None:
                raise StorageOutage(str(self._failure), self._failure.reason)
            return self._place

    @contextmanager
    def granted(self, storage: Provable, installation: UUID) -> Iterator[None]:
        """Let the first files be written into a storage that has no marker of the installation yet."""
        self.bind(installation)
        self._granted = storage.look()
        try:
            yield
        finally:
            self._granted = None
            self.forget()

    def _find_failure(self, storage: Provable) -> StorageOutage | None:
        """Why a storage is not that of the installation; remembers its place if it is."""
        try:
            place, marker = storage.look_closely()
        except StorageOutage as outage:
            return outage
        except InputError as error:
            return StorageOutage(
                f"{storage.place}: {error}", "the storage of files has a damaged marker"
            )
        if marker is None:
            return StorageOutage(f"{storage.place}: {NOT_MOUNTED}: it has no {MARKER}", NOT_MOUNTED)
        if marker.installation != self._installation:
            return StorageOutage(
                f"{storage.place}: {MARKER} names installation {marker.installation}, "
                f"{self._installation} is expected",
                "the storage of files is that of another installation",
            )
        self._place = place
        return None
