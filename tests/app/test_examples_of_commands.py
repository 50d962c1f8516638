"""Every command has examples, which its parser takes as they are, and its help shows them."""

import shlex

import pytest

from amers.app.cli.commands import COMMANDS
from amers.app.cli.examples import EXAMPLES
from amers.app.cli.on_demand import Group, _load
from tests.app.wiring import commands
from tests.command_line import amers_here


def test_every_command_has_two_examples() -> None:
    assert set(EXAMPLES) == {" ".join(words) for words in commands()}
    alike = [command for command, (one, other) in EXAMPLES.items() if one == other]
    assert alike == ["worker"], "it has no options"


@pytest.mark.parametrize("command", EXAMPLES)
def test_examples_are_what_the_command_takes(command: str) -> None:
    words, entry = command.split(), COMMANDS
    for word in words[:-1]:
        group = entry[word]
        assert isinstance(group, Group)
        entry = group.commands
    loaded = _load(words[-1], entry[words[-1]])
    names = {option for one in loaded.params for option in (*one.opts, *one.secondary_opts)}
    for example in EXAMPLES[command]:
        given = shlex.split(example)
        unknown = [word for word in given if word.startswith("-") and word not in names]
        assert unknown == []
        loaded.make_parser(loaded.make_context(command, given, resilient_parsing=True)).parse_args(given)


def test_help_shows_the_examples() -> None:
    done = amers_here(("scene", "register", "--help"), {})
    assert done.returncode == 0, done.stderr
    assert "amers scene register scene.tif --block my-block -o registered" in " ".join(
        done.stdout.split()
    )
