"""The code blocks of README and guide: each is run by a test, or read with its reason given here.

A block that is added to one of these documents fails a test until it stands in one of the lists; those
of `amers` commands in the guide are run by its journey. Every `amers` line of every block is parsed by
its command, so that its options exist.
"""

import ast
import re
import shlex

import pytest
import typer
from typer.main import get_command

from amers.app.cli.main import app
from tests.documents import ROOT, blocks_of, command_lines

DOCUMENTS = ("README.md", "docs/guide.md")
"""Those of *Connect* are the recipes of the service, all of which its test runs or names."""
BLOCKS = [block for document in DOCUMENTS for block in blocks_of(document)]
DEMO = "tests/journeys/test_demo.py"
FIRST_RUN = "test_the_first_run_of_the_readme_registers_the_scene_of_the_demo"
GUIDE = "tests/journeys/test_guide.py::test_a_command_of_the_guide_runs_as_it_is_written"
RUN = {
    ("README.md", ". .venv/bin/activate"): f"{DEMO}::{FIRST_RUN}",
    (
        "README.md",
        "import amers",
    ): f"{DEMO}::test_the_python_of_the_readme_prints_the_verdict",
    (
        "README.md",
        ".venv/bin/amers serve --data demo-output/store",
    ): "tests/journeys/test_demo.py::test_the_address_opens_the_scene_before_and_after",
    ("README.md", "gdalinfo registered/scene.tif"): f"{DEMO}::test_gdal_reads_what_the_readme_makes",
    ("docs/guide.md", "from os import environ"): f"{DEMO}::test_the_python_of_the_guide_runs_as_it_is",
    ("docs/guide.md", "import amers"): f"{DEMO}::test_the_python_of_the_guide_runs_as_it_is",
    **{
        block.key: f"{DEMO}::test_the_curl_lines_of_the_guide_register_a_scene_and_read_points"
        for block in BLOCKS
        if block.document == "docs/guide.md" and "curl " in block.text
    },
    **{
        block.key: GUIDE
        for block in BLOCKS
        if block.document == "docs/guide.md" and block.text.startswith("amers ")
    },
}
"""The test that runs a block, by document and first line of the block without its comment."""
MAKE = "its targets set up a machine; what they start is run by other tests"
READ = {
    ("README.md", "make demo"): MAKE,
    ("docs/guide.md", "make demo"): MAKE,
}
"""Why a block is not run, by document and first line of the block without its comment."""


def parse(words: list[str]) -> None:
    """Parse a command line without running it; an option that does not exist raises."""
    assert isinstance(app, typer.Typer)
    command = get_command(app)
    while hasattr(command, "commands"):
        name, *words = words
        command = command.commands[name]
    context = type(command).context_class(command)
    command.make_parser(context).parse_args(list(words))


COMMANDS = [words for block in BLOCKS for words in command_lines(block.text)]
INLINE = [
    shlex.split(text.replace("\n", " ").replace("…", "FILE"))[1:]
    for name in DOCUMENTS
    for text in re.findall(r"`(amers [^`]+)`", (ROOT / name).read_text())
]


def test_every_block_is_run_by_a_test_or_named_with_its_reason():
    assert sorted(block.key for block in BLOCKS) == sorted([*RUN, *READ])


@pytest.mark.parametrize("test", sorted(set(RUN.values())))
def test_the_test_that_runs_a_block_exists(test):
    path, name = test.split("::")
    functions = [
        node for node in ast.parse((ROOT / path).read_text()).body if isinstance(node, ast.FunctionDef)
    ]
    assert name in [function.name for function in functions]


@pytest.mark.parametrize("words", [*COMMANDS, *INLINE], ids=" ".join)
def test_the_options_of_a_command_exist(words):
    parse(words)


def test_an_option_that_does_not_exist_is_seen():
    assert len(COMMANDS) > 25
    with pytest.raises(Exception, match="--no-such-option"):
        parse(["scene", "register", "scene.tif", "--no-such-option", "1"])
    with pytest.raises(KeyError):
        parse(["scene", "regster", "scene.tif"])
