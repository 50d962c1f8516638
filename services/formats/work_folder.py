"""A folder with complete results of tasks, from which interrupted work continues."""

import json
import shutil
import uuid
from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import numpy as np

from amers.services.errors import FormatError, InputError
from amers.services.tasks import Arrays

_INPUTS = "inputs.json"


class WorkFolder(MutableMapping[str, Arrays]):
    """Results of tasks in files: a folder for each, a file for every array, read when asked for."""

    def __init__(self, folder: Path, inputs: Mapping[str, Any], most_bytes: int | None = None) -> None:
        """Open a folder, or make it.

        Args:
            folder: of the results.
            inputs: what all results depend on, as JSON.
            most_bytes: that the results may take; None for any.

        Raises:
            InputError: the folder has the results of other inputs, or is something else.
        """
        self.folder, self.most_bytes = folder, most_bytes
        stated = json.dumps(inputs, indent=1, sort_keys=True, default=str)
        file = folder / _INPUTS
        if folder.exists() and not file.is_file() and any(folder.iterdir()):
            raise InputError(
                f"{folder}: not a work folder of a production, since it has no {_INPUTS}; give a new or "
                "empty folder (--work)"
            )
        if file.is_file() and (found := file.read_text(encoding="utf-8")) != stated:
            raise InputError(
                f"{folder}: has results of other inputs ({_first_difference(found, stated)}); give "
                "another folder (--work), or delete this one"
            )
        folder.mkdir(parents=True, exist_ok=True)
        if not file.is_file():
            partial = folder / f".{_INPUTS}.{uuid.uuid4().hex}"
            partial.write_text(stated, encoding="utf-8")
            partial.rename(file)
        self._bytes = sum(path.stat().st_size for path in folder.rglob("*.npy"))

    def __getitem__(self, name: str) -> Arrays:
        """Arrays of a result, mapped into memory."""
        if name not in self:
            raise KeyError(name)
        arrays = {}
        for file in sorted((self.folder / name).iterdir()):
            try:
                arrays[file.stem] = np.load(file, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise FormatError(
                    f"{file}: damaged ({error}); delete the folder {file.parent}, so that it is "
                    "computed again"
                ) from error
        return arrays

    def __setitem__(self, name: str, arrays: Arrays) -> None:
        """Write a result beside its place, then put it there.

        Raises:
            InputError: the results would take more than they may.
        """
        self._bytes += sum(values.nbytes for values in arrays.values())
        if self.most_bytes is not None and self._bytes > self.most_bytes:
            raise InputError(
                f"intermediate results would take more than the {self.most_bytes:,} bytes that are left "
                "for them: make less at once (larger cells, fewer pairs, a smaller area), or free room "
                "on the disk or in the quota"
            )
        place = self.folder / name
        partial = place.with_name(f".{place.name}.{uuid.uuid4().hex}")
        partial.mkdir(parents=True)
        try:
            for key, values in arrays.items():
                np.save(partial / f"{key}.npy", values, allow_pickle=False)
            if place.exists():
                shutil.rmtree(place)
            partial.rename(place)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise

    def __delitem__(self, name: str) -> None:
        """Delete a result."""
        shutil.rmtree(self.folder / name)

    def __contains__(self, name: object) -> bool:
        """Whether a result is there."""
        return isinstance(name, str) and (self.folder / name).is_dir()

    def __iter__(self) -> Iterator[str]:
        """Names of all results."""
        for stage in sorted(self.folder.iterdir()):
            if stage.is_dir():
                yield from (
                    f"{stage.name}/{task.name}"
                    for task in sorted(stage.iterdir())
                    if not task.name.startswith(".")
                )

    def __len__(self) -> int:
        """Number of results."""
        return sum(1 for _ in self)


def _first_difference(found: str, stated: str) -> str:
    """The first line that differs."""
    for old, new in zip(found.splitlines(), stated.splitlines(), strict=False):
        if old != new:
            return f"{old.strip()} there, {new.strip()} now"
    return "fewer or more images"
