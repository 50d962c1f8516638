"""Options that a user repeats, in a TOML file: a table for each command, such as `[scene.register]`.

What is given on the command line counts more. Names are those of the options, with or without dashes.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amers.app.cli.on_demand import Group, Tree
from amers.app.errors import InputError


def read_options(path: Path, tree: Tree) -> dict[str, Any]:
    """The options of a file by command, as the parser takes its defaults.

    Raises:
        InputError: the file cannot be read, is no TOML, or names a command that does not exist.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--options: {path}: {error.strerror}; a TOML file expected") from None
    except ValueError as error:
        raise InputError(f"--options: {path}: {error}; a TOML file expected") from None
    return _of_group(document, tree, str(path), ())


def _of_group(
    document: Mapping[str, Any], tree: Tree, path: str, words: tuple[str, ...]
) -> dict[str, Any]:
    options = {}
    for name, table in document.items():
        entry, place = tree.get(name), " ".join((*words, name))
        if entry is None or not isinstance(table, dict):
            raise InputError(
                f"--options: {path}: {place!r:.60} found, the table of a command expected, such as "
                "[scene.register]"
            )
        if isinstance(entry, Group):
            options[name] = _of_group(table, entry.commands, path, (*words, name))
        else:
            options[name] = {key.strip("-").replace("-", "_"): value for key, value in table.items()}
    return options
