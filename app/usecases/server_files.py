"""Files on the server that a setting makes available: those below one folder, and no others."""

from pathlib import Path

from amers.app.errors import InputError


def file_below(folder: Path, path: str, field: str, setting: str) -> Path:
    """The path of an existing file below a folder, with all links resolved.

    Args:
        folder: that the setting names.
        path: relative path, from a request.
        field: of the request, for the message.
        setting: for the message.

    Raises:
        InputError: there is no such file, or it lies outside the folder.
    """
    try:
        top = folder.resolve()
        file = (top / path).resolve()
        is_usable = file.is_relative_to(top) and file.is_file()
    except (OSError, ValueError):
        is_usable = False
    if not is_usable:
        raise InputError(f"{field}: {path[:200]!r} is not a file below the folder of {setting}")
    return file
