"""What a person at a terminal sees of a command: groups of options, completion, figures with units."""

import inspect
import os
import re
from pathlib import Path

import pytest

from amers.app.cli.commands import COMMANDS
from amers.app.cli.on_demand import Command, Group, Tree
from amers.app.cli.option_groups import FEWEST, FIRST, group_of
from amers.app.cli.recorded import recorded
from amers.app.cli.scene_rows import show_outcome
from tests.command_line import amers_here
from tests.imports import COMMAND, beyond_budget, imported_by

MOST_FIRST = 5
PANEL = re.compile(r"╭─ (.+?) ─+╮")


def functions(tree: Tree = COMMANDS, words: tuple[str, ...] = ()) -> dict[str, str]:
    """The functions of all commands by their words."""
    found: dict[str, str] = {}
    for name, entry in tree.items():
        if isinstance(entry, Group):
            found |= functions(entry.commands, (*words, name))
        else:
            assert isinstance(entry, Command)
            found[" ".join((*words, name))] = entry.function
    return found


def options_of(function: str) -> list[str]:
    """Names of the options of a command in Python."""
    shown = recorded(function)
    assert shown is not None
    parameters = inspect.signature(shown).parameters.values()
    return [one.name for one in parameters if "OptionInfo" in repr(one.annotation)]


def test_every_command_with_many_options_names_the_five_that_come_first() -> None:
    many = {
        words: names
        for words, function in functions().items()
        if len(names := options_of(function)) >= FEWEST
    }
    assert sorted(FIRST) == sorted(many)
    for words, names in many.items():
        assert set(FIRST[words]) <= set(names), words
        assert len(FIRST[words]) == MOST_FIRST, words
        rest = {group_of(words, name) for name in names} - {None}
        assert len(rest) >= 2, words


def test_the_help_shows_the_first_options_before_all_groups() -> None:
    done = amers_here(("scene", "register", "--help"), {**os.environ, "COLUMNS": "120", "LINES": "50"})
    assert done.returncode == 0, done.stderr
    panels = PANEL.findall(done.stdout)
    assert panels[:2] == ["Arguments", "Options"]
    assert {"Heights", "Reference", "Marked control", "Output", "Computing"} <= set(panels)
    first = done.stdout.split("╭─ Options")[1].split("╰")[0]
    assert re.findall(r"│ --([a-z-]+)", first) == [
        *("block", "reference", "control", "sigma-m", "output"),
        "help",
    ]


def test_a_name_in_brackets_is_shown_in_the_help() -> None:
    done = amers_here(("--help",), {**os.environ, "COLUMNS": "120"})
    assert "[scene.register]" in done.stdout


def completed(line: str, shell: str = "bash") -> list[str]:
    """What a shell is offered for the last word of a line."""
    words = line.split(" ")
    asked = {
        "_AMERS_COMPLETE": f"complete_{shell}",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
        "_TYPER_COMPLETE_ARGS": line,
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    return amers_here((), {**os.environ, **asked}).stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("amers sce", ["scene"]),
        ("amers scene reg", ["register", "register-many"]),
        (
            "amers scene register --ref",
            ["--reference", "--reference-sigma-m", "--reference-sigma-up-m"],
        ),
        ("amers production run --control-d", None),
    ],
)
def test_a_shell_completes_commands_and_options(line: str, offered: list[str] | None) -> None:
    found = completed(line)
    assert found == offered if offered else all(one.startswith("--control-d") for one in found)
    assert found


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_shell_has_a_script_of_its_own(shell: str) -> None:
    script = amers_here((), {**os.environ, "_AMERS_COMPLETE": f"source_{shell}"})
    assert f"complete_{shell}" in script.stdout
    assert "register" in "".join(completed("amers scene reg", shell))


def test_a_completion_imports_nothing_of_the_science() -> None:
    """It answers while a person types; of the command it reads what its help reads."""
    line = "amers scene register --ref"
    asked = {"_AMERS_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": "3"}
    assert not beyond_budget(imported_by(COMMAND, **asked), {"importlib.metadata"})


def test_figures_of_one_scene_have_axes_and_units_and_no_exit_status(
    capsys: pytest.CaptureFixture[str],
) -> None:
    outcome = {
        "scene": Path("scene.tif"),
        "verdict": "good",
        "verdict_scope": "",
        "reason": "Every criterion is met.",
        "exit_status": 0,
        "visible": 50,
        "shift_px": [-22.56, -43.17],
        "shift_m": 48.7,
        "residual_rms_px": 0.197,
        "refined_model_error_px": 0.01,
    }
    show_outcome(outcome, as_json=False)
    shown = capsys.readouterr().out
    assert "exit" not in shown
    assert re.search(r"^shift in line, sample \(px\) +-22\.560, -43\.170$", shown, re.MULTILINE)
    assert re.search(r"^shift on the ground \(m\) +48\.7$", shown, re.MULTILINE)
    assert re.search(r"^residual in the image, rms \(px\) ", shown, re.MULTILINE)
    show_outcome(outcome, as_json=True)
    assert '"exit_status": 0' in capsys.readouterr().out
