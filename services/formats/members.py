"""Files that other files refer to: their paths cannot lead out of the folder that is searched."""

from pathlib import Path

from amers.services.errors import FormatError


def folder_member(folder: Path, name: str, what: str) -> Path:
    """The path of a file in a folder, by a name that another file gives.

    Args:
        folder: where the file is.
        name: relative path with slashes.
        what: the folder, for messages.

    Raises:
        FormatError: the name leads out of the folder or through a symbolic link.
    """
    parts = name.split("/")
    if not name or name.startswith("/") or "\\" in name or {"", ".", ".."} & set(parts) or "\0" in name:
        raise FormatError(f"{name!r:.200} found, a relative path inside {what} expected")
    path = Path(folder)
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise FormatError(
                f"{name!r:.200}: leads through a symbolic link; replace the link by the file"
            )
    return path
