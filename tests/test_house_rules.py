"""What holds the house together: imports, and documents that name everything there is."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from amers.app.cli.main import app
from amers.app.config import Settings
from tests.command_line import amers_here
from tests.composed_sql import Source, read_sources

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
OPERATIONS = ROOT / "docs" / "operations.md"
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")])
FOLDERS = "amers|client|app|services|migrations|tests|docs|examples|benchmarks|scripts|web|qgis_plugin"
OLD_WORDS = (
    r"\bdoors?\b",
    r"homologous",
    r"\.passes\b|\bfine_passes\b|services[./]passes",
    r"\bmeasures_of\b|services[./]measures\b",
    r"\b(chip|point)_choice\b",
    r"\bmatching[./](middle|features|points|chips|dense)\b",
    r"\bshared_error\b",
    r"\blooks_of\b",
    r"\bsteady_weights\b",
    r"\bmin_edge_score\b",
    r"\bvotes?\b",
    r"\brival|another story",
    r"\bclass Equipment|\bcount_equipment\b|\.equipment\b|\"equipment\"",
    r"\bas_they_scatter\b|\bless_sure\b",
    r"\buntested_px\b",
    r"\b(FoundPoints|Question|Asked)\b(?! for)",
    r"usecases[./](ground_control|questions|cleaning)\b",
    r"\bjob_course\b|\bservice_time\b|\bn_superseded\b",
    r"\bapi[./](watch|documents|replies|origin)\b",
    r"\b(besieged|block_doors)\b",
    r"[\"'`]uncertain[\"'`]",
    r"(condition|collection)\.(beside|everything)\b",
    r"record of changes",
    r"\bsw(ing(s|ing)?|ung)\b",
    r"\bnobody (states|stated) (it|them|the)\b",
)
"""Words that the glossary has replaced; see `docs/glossary.md` for those in use."""
EXAMPLES_OF_NAMES = {"match_count", "reported_sigma_m"}
NAMELESS = {"utils", "helpers", "common", "manager", "base_service"}
LONGEST_FILE = 500


def modules() -> Iterator[Path]:
    for package in ("app", "services", "migrations"):
        yield from sorted((ROOT / package).rglob("*.py"))


@cache
def sources() -> tuple[Path, ...]:
    """Every text of the product and its tests that names things."""
    folders = [ROOT / folder for folder in FOLDERS.replace("docs|", "").split("|")]
    paths = [*ROOT.glob("*.yml"), *(path for folder in folders for path in folder.rglob("*"))]
    return tuple(
        path
        for path in paths
        if path.suffix in {".yml", ".py", ".sql", ".ts", ".html"}
        and not {"built", "node_modules"} & set(path.parts)
    )


@cache
def text_of(path: Path) -> str:
    return path.read_text()


def commands() -> list[str]:
    """Every command in words, such as `amers db upgrade`."""

    def below(command: object, words: str) -> Iterator[str]:
        inner = getattr(command, "commands", None)
        if inner is None:
            yield words
        else:
            for name, child in inner.items():
                yield from below(child, f"{words} {name}")

    assert isinstance(app, typer.Typer)
    return sorted(below(get_command(app), "amers"))


def test_imports_keep_to_their_layers():
    program = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_modules_of_tests_have_names_of_their_own():
    """Pytest knows them by their last name only."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(set(names)) == sorted(names)


def test_a_module_of_tests_states_its_marks_once():
    """A second list would replace the first, and its tests be run against their marks."""
    for path in (ROOT / "tests").rglob("test_*.py"):
        assert len(re.findall(r"^pytestmark\b", path.read_text(), re.MULTILINE)) <= 1, path


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_that_a_document_names_exists(document):
    text = document.read_text()
    links = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", text)
    assert [path for path in links if not (document.parent / path).exists()] == []
    paths = re.findall(rf"`((?:{FOLDERS})/[\w./-]+)`", text)
    real = [path for path in paths if not re.search("NAME|NNNN|built|results", path)]
    assert [path for path in real if not (ROOT / path).exists()] == []


def test_the_glossary_defines_a_term_once():
    terms = re.findall(r"^\| \*\*(.+?)\*\*", (ROOT / "docs" / "glossary.md").read_text(), re.MULTILINE)
    names = [name for term in terms for name in term.split(", ")]
    assert sorted(set(names)) == sorted(names)


def test_every_name_that_a_document_uses_exists_in_the_code():
    """Of columns, parameters, options: words in code style with an underscore."""
    words = set(re.findall(r"\w+", "\n".join(text_of(path) for path in sources())))
    for document in DOCUMENTS:
        code = " ".join(re.findall(r"`([^`\n]+)`", document.read_text()))
        names = set(re.findall(r"(?<![\w/.-])[a-z]+(?:_[a-z0-9]+)+(?!\w)", code))
        assert names - words - EXAMPLES_OF_NAMES == set(), document


@pytest.mark.parametrize("word", OLD_WORDS)
def test_a_word_that_was_replaced_is_gone(word):
    places = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in (*sources(), *DOCUMENTS)
        if path not in {Path(__file__), ROOT / "CHANGELOG.md"} and re.search(word, text_of(path))
        for number, line in enumerate(text_of(path).splitlines(), 1)
        if re.search(word, line)
    ]
    assert places == []


@pytest.mark.parametrize("name", Settings.model_fields)
def test_a_setting_is_documented(name):
    assert f"AMERS_{name.upper()}" in OPERATIONS.read_text()


@pytest.mark.parametrize("words", commands())
def test_a_command_is_documented_and_explains_itself(words):
    assert words in README.read_text() + OPERATIONS.read_text()
    command = get_command(app)
    for word in words.split()[1:]:
        command = command.commands[word]
    assert command.help


def test_the_command_tells_its_version():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert amers_here(["--version"], os.environ).stdout == f"{stated}\n"


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda p: p.stem)
def test_a_benchmark_imports_names_that_exist(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("amers."):
            module = import_module(node.module)
            for name in node.names:
                assert hasattr(module, name.name) or find_spec(f"{node.module}.{name.name}"), name.name


def test_only_the_settings_read_the_environment():
    reading = re.compile(r"os\.(getenv|environ(\.get|\[))")
    assert [path for path in modules() if reading.search(path.read_text())] == [
        ROOT / "app" / "config.py"
    ]


def walks_over_errors(tree: ast.AST) -> list[int]:
    """The lines that follow links between errors, which can form a ring."""
    named = {"__cause__", "__context__"}
    return sorted(
        node.lineno
        for node in ast.walk(tree)
        if (isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load) and node.attr in named)
        or (isinstance(node, ast.Constant) and node.value in named)
    )


def test_one_module_walks_from_error_to_error():
    """`amers.services.errors` does, which meets each once; other code asks it."""
    folders = ("app", "services", "migrations", "scripts", "benchmarks", "qgis_plugin", "mutants")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    walking = {path for path in paths if walks_over_errors(ast.parse(path.read_text()))}
    assert walking == {ROOT / "services" / "errors.py"}


@pytest.mark.parametrize(
    "code",
    [
        "while error is not None:\n    error = error.__cause__",
        "one = error.__cause__ or error.__context__",
        "one = getattr(error, '__context__', None)",
        "one = attrgetter('__cause__')(error)",
    ],
)
def test_the_rule_finds_walks_over_errors(code):
    assert walks_over_errors(ast.parse(code)) != []


def test_the_rule_lets_an_error_get_its_cause():
    assert walks_over_errors(ast.parse("error.__cause__ = caught\nraise error from caught")) == []


def test_every_module_says_what_it_is_for_and_has_a_name_that_means_something():
    for path in modules():
        assert path.read_text()[:4].startswith(('"""', 'r"""')) or path.name == "__init__.py", path
        assert path.stem not in NAMELESS, path


def test_no_file_has_grown_out_of_one_sentence():
    long = {
        str(path): lines
        for path in modules()
        if (lines := len(path.read_text().splitlines())) > LONGEST_FILE
    }
    assert long == {}


def test_what_is_installed_beside_each_other_has_exact_versions_without_addresses():
    lines = (ROOT / "constraints.txt").read_text().split()
    assert lines == [
        line for line in lines if re.fullmatch(r"[A-Za-z0-9_.\-]+==[0-9][A-Za-z0-9.+]*", line)
    ]


def test_a_real_image_is_asked_for_by_its_marker():
    for path in (ROOT / "tests").rglob("test_*.py"):
        text = path.read_text()
        if re.search(r"\breal_data\b[,)]", text.replace("mark.real_data", "")):
            assert "mark.real_data" in text, path


def test_no_sql_is_put_together_out_of_strings():
    composed = {
        f"{path.relative_to(ROOT)}:{line}"
        for path, source in read_sources(ROOT, "app", "migrations").items()
        for line in source.violations()
    }
    assert composed == set()


@pytest.mark.parametrize(
    "module",
    [
        'connection.execute(f"select * from {table}")',
        'connection.execute("select * from %s" % table)',
        'connection.execute("select * from " + table)',
        'connection.execute(START + table)\nSTART = "select * from "',
        'connection.execute("select * from {}".format(table))',
        'connection.execute(" ".join(words))',
        'connection.exec_driver_sql(f"lock {table}".encode())',
        'text(f"select {column}")',
        'sql.SQL("select {}").format(column)\ncursor.copy(sql.SQL("copy {} to stdout").format(query))',
        'def read(table):\n    query = f"select * from {table}"\n    return cursor.execute(query)',
        'def read():\n    query = "select 1"\n    query += " from b"\n    return one.scalar(query)',
        'connection.execute(query("b"))\ndef query(table):\n    return f"select * from {table}"',
        'connection.execute(A if wide else B)\nA = "select 1"\nB = f"select {c}"',
    ],
)
def test_the_rule_finds_sql_that_is_put_together(module):
    assert Source(ast.parse(module)).violations() != []


@pytest.mark.parametrize(
    "module",
    [
        'connection.execute("select * from block where number = %s", [number])',
        "connection.execute(select(block.c.number + 1).where(block.c.id == name))",
        'connection.execute(QUERY)\nQUERY = text("select 1" " from block")',
        "numbers = values.copy()\nshutil.copy(folder / name, other)",
        'log.info(f"{count} rows")',
    ],
)
def test_the_rule_lets_sql_pass_that_is_not_put_together(module):
    assert Source(ast.parse(module)).violations() == []


def test_one_function_makes_the_command_of_a_python_process():
    """Another could look for modules in the working folder, where deliveries are unpacked."""
    starting = re.compile(
        r"sys\.executable|ProcessPoolExecutor\(|multiprocessing\.Process|os\.(exec|spawn)"
    )
    places = {str(path.relative_to(ROOT)) for path in modules() if starting.search(path.read_text())}
    assert places == {"app/child_processes.py", "app/usecases/executors.py"}
