"""Options in a file arrive as if typed; the command line counts more, and what is unknown is refused."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from amers.app.cli import block_quality
from amers.app.cli.main import app
from tests.command_line import Done, amers_here


def said(tmp_path: Path, text: str, *words: str, **environment: str) -> Done:
    file = tmp_path / "options.toml"
    file.write_text(text)
    given = () if environment else ("--options", str(file))
    variables = {name: value.format(file=file) for name, value in environment.items()}
    return amers_here((*given, *words), {**os.environ, **variables})


@pytest.fixture
def assessed(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What `block quality` asks for, each time that it is run."""
    found: list[Any] = []

    def note(_block: Path, references: Any, required: Any, _progress: Any) -> Any:
        found.append((references, required))
        return SimpleNamespace(verdict="met")

    monkeypatch.setattr(block_quality, "assess_folder", note)
    monkeypatch.setattr(block_quality, "_show_report", lambda *_arguments, **_named: None)
    return found


@pytest.mark.parametrize("name", ["points-per-km2", "--points-per-km2", "points_per_km2"])
def test_the_file_counts_where_the_command_line_says_nothing(
    assessed: list[Any], tmp_path: Path, name: str
) -> None:
    (tmp_path / "block.json").write_text("{}")
    (tmp_path / "o.toml").write_text(f"[block.quality]\n{name} = 7\nsite-sigma-m = 19.5\n")
    words = ["--options", str(tmp_path / "o.toml"), "block", "quality", str(tmp_path)]
    app(words, standalone_mode=False)
    app([*words, "--points-per-km2", "3"], standalone_mode=False)
    assert [required.points_per_km2 for _, required in assessed] == [7.0, 3.0]
    assert [references.site_sigma_m for references, _ in assessed] == [19.5, 19.5]


def test_the_variable_names_the_file_too(tmp_path: Path) -> None:
    done = said(tmp_path, "[block.list]\nnothing = 1", "block", "list", AMERS_OPTIONS="{file}")
    assert done.returncode == 2
    assert "the file of --options has 'nothing', and this command no such option" in done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[block.frobnicate]\na = 1", "'block frobnicate' found, the table of a command expected"),
        ("[weather]\na = 1", "'weather' found, the table of a command expected"),
        ("block = 3", "'block' found, the table of a command expected"),
        ("[block\n", "a TOML file expected"),
    ],
)
def test_what_is_no_option_of_a_command_is_refused(tmp_path: Path, text: str, message: str) -> None:
    done = said(tmp_path, text, "block", "list")
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


def test_a_value_of_the_wrong_kind_is_refused_by_its_option(tmp_path: Path) -> None:
    done = said(tmp_path, "[audit]\nlimit = 'many'", "audit")
    assert done.returncode == 2
    assert "--limit" in done.stderr
