"""Groups of commands that are imported on first use: help and errors need none of their modules."""

from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from amers.app.cli.arguments import CheckedCommand
from amers.app.cli.options import with_options
from amers.app.cli.recorded import recorded


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        function: `MODULE:FUNCTION` below `amers.app.cli`.
        help: the first line of the function's docstring, for lists of commands.
    """

    function: str
    help: str


@dataclass(frozen=True)
class Group:
    """Commands with one noun.

    Attributes:
        help: what they are about.
        commands: by their names.
    """

    help: str
    commands: "Tree"


Tree: TypeAlias = Mapping[str, Command | Group]


class LoadedCommands(UserDict[str, Any]):
    """The commands of a tree by name; the module of a command is imported on first use."""

    def __init__(self, tree: Tree) -> None:
        super().__init__()
        self._tree = tree
        self.data = dict.fromkeys(tree)

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is None:
            self.data[name] = _load(name, self._tree[name])
        return self.data[name]


class GroupOnDemand(TyperGroup):
    """A group whose help needs none of the modules of its commands."""

    def __init__(self, tree: Tree, **attributes: Any) -> None:
        super().__init__(**attributes)
        self._tree = tree
        self.commands = LoadedCommands(tree)

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all commands."""
        return list(self._tree)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The name and the help of a command, for lists of commands."""
        found = self._tree.get(cmd_name)
        return None if found is None else TyperCommand(cmd_name, help=found.help)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command to run, and the rest of the arguments."""
        name, _, rest = super().resolve_command(ctx, args)
        entry = self._tree[str(name)]
        # A shell that completes a word needs the names of options, as the help does.
        is_shown = "--help" in rest or ctx.resilient_parsing
        if isinstance(entry, Command) and is_shown and (shown := recorded(entry.function)):
            return name, _as_command(str(name), shown), rest
        return name, self.commands[str(name)], rest


def _load(name: str, entry: Command | Group) -> Any:
    if isinstance(entry, Group):
        return GroupOnDemand(entry.commands, name=name, help=entry.help, no_args_is_help=True)
    module, _, function = entry.function.partition(":")
    return _as_command(name, with_options(getattr(import_module(f"amers.app.cli.{module}"), function)))


def _as_command(name: str, function: Callable[..., None]) -> Any:
    one = typer.Typer(add_completion=False)
    one.command(name, cls=CheckedCommand)(function)
    return get_command(one)
