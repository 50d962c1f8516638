"""Files next to an image, found by name in upper or lower case."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from amers.services.formats.addresses import Address, FilePlace


class Siblings:
    """The files beside an image.

    A folder is listed once. At an address nothing is listed: names are tried as they are spelt.
    """

    def __init__(self, path: FilePlace) -> None:
        """Of the image at a path; nothing is read yet."""
        self.path = path
        self._listed: dict[str, Path] | None = None
        self._tried: dict[str, bool] = {}

    def named(self, names: Sequence[str]) -> list[FilePlace]:
        """Those that have one of these names, in the order of the names."""
        path = self.path
        if isinstance(path, Address):
            new = [name for name in dict.fromkeys(names) if name not in self._tried]
            if new:
                with ThreadPoolExecutor(len(new)) as pool:
                    there = pool.map(lambda name: path.with_name(name).is_file(), new)
                    self._tried |= dict(zip(new, there, strict=True))
            return [path.with_name(name) for name in dict.fromkeys(names) if self._tried[name]]
        beside = self._files()
        found = [beside[name.upper()] for name in names if name.upper() in beside]
        return list(dict.fromkeys(found))

    def ending(self, suffix: str) -> list[FilePlace]:
        """Those whose names have a suffix, by name; none at an address."""
        if isinstance(self.path, Address):
            return []
        return [file for name, file in sorted(self._files().items()) if name.endswith(suffix.upper())]

    def _files(self) -> dict[str, Path]:
        """The files in the folder, by their names in upper case."""
        if self._listed is None:
            assert isinstance(self.path, Path)
            folder = self.path.resolve().parent
            self._listed = {name.upper(): folder / name for name in os.listdir(folder)}
        return self._listed
