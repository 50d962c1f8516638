"""Files of the server that a setting opens: what lies below a folder, and nothing else."""

from pathlib import Path

from app.errors import InputError


def file_below(folder: Path, path: str, field: str, setting: str) -> Path:
    """A file below a folder, all links followed and still below it.

    Args:
        folder: that is open.
        path: as a request names it.
        field: of the request, for the message.
        setting: that opens the folder, for the message.

    Raises:
        InputError: there is no such file there.
    """
    try:
        top = folder.resolve()
        found = (top / path).resolve()
        usable = found.is_relative_to(top) and found.is_file()
    except (OSError, ValueError):
        usable = False
    if not usable:
        raise InputError(f"{field}: {path[:200]!r} is no file below the folder of {setting}")
    return found
