"""Errors about the arguments of a command: all that is wrong at once, by the names of its options."""

import re
from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperCommand, TyperOption

from amers.app.cli.examples import epilogue
from amers.app.cli.exit_status import is_refusal
from amers.app.cli.option_groups import groups

INPUT = re.compile(r"^[a-z_]+(?=: )|(?<=`)[a-z_]+(?=`)")
"""The name of an input in an error of the science or of a use case, which know no options."""


def by_options(message: str, context: typer.Context) -> str:
    """A message with the options and arguments of a command in place of the names of inputs."""
    names = {str(parameter.name): _name(parameter) for parameter in context.command.params}
    return INPUT.sub(lambda match: names.get(match[0], match[0]), message)


class CheckedCommand(TyperCommand):
    """A command that names everything wrong on its command line in one error, not one per run."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments.

        Raises:
            UsageError: values are missing or wrong; its message is one sentence on all of them.
        """
        ctx.default_map = self._defaults(ctx)
        given = list(args)
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            first = error
        problems = list(dict.fromkeys(self._problems(ctx, given))) or [first.format_message()]
        ctx.fail("; ".join(problems))
        raise first

    def _defaults(self, ctx: Any) -> dict[str, Any]:
        """The values of the file of options, by the names of parameters."""
        names = {_plain(option): one.name for one in self.params for option in one.opts}
        defaults = {}
        for name, value in (ctx.default_map or {}).items():
            if name not in names:
                ctx.fail(f"the file of --options has {name!r:.60}, and this command no such option")
            defaults[names[name]] = value
        return defaults

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help: options in groups where there are many; it ends with examples."""
        _, _, command = ctx.command_path.partition(" ")
        self.epilog = epilogue(command)
        options: list[Any] = [one for one in self.params if isinstance(one, TyperOption)]
        of_names = groups(command, [str(one.name) for one in options])
        for option in options:
            option.rich_help_panel = of_names.get(str(option.name))
        super().format_help(ctx, formatter)

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Raises:
            AmersError, RequestRefused: as the command raises it, with options in place of the names of
                inputs.
        """
        try:
            return super().invoke(ctx)
        except Exception as error:
            if is_refusal(error):
                error.args = (by_options(str(error), ctx), *error.args[1:])
            raise

    def _problems(self, ctx: Any, args: list[str]) -> Iterator[str]:
        """What is missing, then what is wrong with each value."""
        values, _, _ = self.make_parser(ctx).parse_args(args=args)
        missing, wrong = [], []
        for parameter in self.get_params(ctx):
            for value, error in _errors_of(parameter, ctx, values):
                if type(error) is typer.BadParameter:
                    wrong.append(f"{_name(parameter)}: {_words(value, error)}")
                else:
                    missing.append(_name(parameter))
        if missing:
            yield f"{_listed(missing)} {'is' if len(missing) == 1 else 'are'} missing"
        yield from wrong


def _errors_of(
    parameter: Any, ctx: Any, values: dict[str, Any]
) -> Iterator[tuple[object, typer.BadParameter]]:
    """The errors of one parameter with the values that they are about."""
    given = values.get(parameter.name)
    alone = [[value] for value in given] if isinstance(given, list | tuple) and given else [given]
    for one in alone:
        try:
            parameter.handle_parse_result(ctx, {**values, parameter.name: one}, [])
        except typer.BadParameter as error:
            yield (one[0] if isinstance(one, list) and one else one), error


def _words(value: object, error: typer.BadParameter) -> str:
    """What is wrong with a value: the value, and what was expected."""
    message = error.message.removeprefix("Value error, ").rstrip(".")
    shown = f"{value!r:.100}"
    return message if shown in message else f"{shown} found; {message[:1].lower()}{message[1:]}"


def _name(parameter: Any) -> str:
    """The longest name of an option, or the name of an argument as the help has it."""
    if parameter.param_type_name == "option":
        return str(max(parameter.opts, key=len))
    return str(parameter.name).upper()


def _listed(names: list[str]) -> str:
    """Names as a list in words."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _plain(option: str) -> str:
    """The name of an option as a file has it."""
    return option.strip("-").replace("-", "_")
