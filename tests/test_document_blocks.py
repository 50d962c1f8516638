"""The code blocks of README and guide: each is run by a test, or read with its reason given here.

A block that is added to one of these documents fails a test until it stands in one of the lists.
Every `amers` line of every block is parsed by its command, so that its options exist.
"""

import ast
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import pytest
import typer
from typer.main import get_command

from app.cli.main import app

ROOT = Path(__file__).parent.parent
DOCUMENTS = ("README.md", "docs/guide.md")
"""Those of *Connect* are the recipes of the service, all of which its test runs or names."""
DEMO = "tests/journeys/test_demo.py"
FIRST_RUN = "test_the_first_run_of_the_readme_registers_the_scene_of_the_demo"
RUN = {
    ("README.md", ". .venv/bin/activate"): f"{DEMO}::{FIRST_RUN}",
    (
        "README.md",
        "from pathlib import Path",
    ): f"{DEMO}::test_the_python_of_the_readme_prints_the_verdict",
    ("README.md", "gdalinfo registered/scene.tif"): f"{DEMO}::test_gdal_reads_what_the_readme_makes",
    ("docs/guide.md", "from os import environ"): f"{DEMO}::test_the_python_of_the_guide_runs_as_it_is",
    ("docs/guide.md", "from pathlib import Path"): f"{DEMO}::test_the_python_of_the_guide_runs_as_it_is",
}
"""The test that runs a block, by document and first line of the block without its comment."""
MAKE = "its targets set up a machine; what they start is run by other tests"
FILES = "works on files of the reader's own; its options are parsed here"
IDS = "has ids that replies give; the tests of the client and of the API send these requests"
READ = {
    ("README.md", "make demo"): MAKE,
    ("docs/guide.md", "make demo"): MAKE,
    **{
        ("docs/guide.md", f"amers {line}"): FILES
        for line in (
            "production run --images IMG_1.TIF --images IMG_2.TIF --gsd-m 0.5,2 -o my-block",
            "production ortho ortho.tif --dem dem.tif --vertical EGM2008 -o my-block",
            "production points gcplib.txt --vertical EGM96 --images ortho.tif --point-sigma-m 6,10"
            " -o my-block",
            "production points gcp_db.json --chips chips/ --vertical EGM2008 --point-sigma-m 4,8"
            " --frame-sigma-m 3 -o my-block",
            "production select catalogue.ndjson --area country.geojson --since 2021-01-01"
            " -o my-selection",
            "production run --selection my-selection --spacing-m 1400 -o my-block",
            "block ingest my-block --publish",
            "block quality my-block --site airport.tif --control-site harbour.tif --site-sigma-m 0.5 \\",
            "scene register scene.tif --sigma-m 50 -o registered",
            "scene register-many scenes/ --block my-block -o registered",
            "scene register scene.tif --reference ortho.tif --dem dem.tif --vertical EGM2008"
            " -o registered",
            "scene register scene.tif --check-points marks.geojson -o registered",
            "block renew my-block --image scene.tif",
            "scene ortho scene.tif --model registered/refined_RPC.TXT --dem dem.tif --vertical EGM2008"
            " -o ortho.tif",
            "vectors canvas scene.tif -o canvas.vrt",
            "vectors project map.gpkg --scene scene.tif --registration registered --dem dem.tif"
            " --vertical EGM2008 --clip -o on_image.gpkg",
            "serve",
        )
    },
    ("docs/guide.md", 'AUTH="Authorization: Bearer $TOKEN"'): IDS,
    (
        "docs/guide.md",
        'curl -H "$AUTH" -G "$URL/collections/points/items" -d bbox=5.39,43.59,5.41,43.61'
        " -d f=parquet \\",
    ): IDS,
}
"""Why a block is not run, by document and first line of the block without its comment."""


class Block(NamedTuple):
    """A code block of a document."""

    document: str
    language: str
    text: str

    @property
    def key(self) -> tuple[str, str]:
        """Document and first line without its comment."""
        return self.document, self.text.partition("\n")[0].split("  #")[0].rstrip()


BLOCKS = [
    Block(name, language, text)
    for name in DOCUMENTS
    for language, text in re.findall(
        r"^```(\w*)\n(.*?)^```$", (ROOT / name).read_text(), re.DOTALL | re.MULTILINE
    )
]


def command_lines(text: str) -> list[list[str]]:
    """The words of every `amers` command of a block, and of those inside `$( )`."""
    joined = text.replace("\\\n", " ")
    inner = re.findall(r"\$\((amers [^)]*)\)", joined)
    lines = [line.replace("…", "FILE") for line in joined.splitlines() if line.startswith("amers ")]
    return [shlex.split(line, comments=True)[1:] for line in (*lines, *inner)]


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
