"""The distribution of the client alone: the files of app/client, which need httpx alone."""

import ast
import sys
import tomllib
from pathlib import Path

import pytest

import amers
from amers.app.cli.exit_status import REFUSED
from amers.app.cli.failures import failure

ROOT = Path(__file__).parent.parent
CLIENT = ROOT / "client"
MODULES = sorted((ROOT / "app" / "client").glob("*.py"))


def project(folder: Path) -> dict:
    return tomllib.loads((folder / "pyproject.toml").read_text())["project"]


def test_it_has_the_files_and_the_version_of_amers():
    assert (CLIENT / "amers_client").resolve() == ROOT / "app" / "client"
    assert project(CLIENT)["version"] == project(ROOT)["version"]
    assert set(project(CLIENT)["dependencies"]) <= set(project(ROOT)["dependencies"])
    assert [name for name in project(CLIENT)["dependencies"] if not name.startswith("httpx")] == []


@pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)
def test_a_module_imports_its_folder_httpx_and_the_standard_library(module: Path):
    nodes = list(ast.walk(ast.parse(module.read_text())))
    absolute = [node.module for node in nodes if isinstance(node, ast.ImportFrom) and not node.level]
    plain = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    packages = {str(name).partition(".")[0] for name in (*absolute, *plain)}
    assert packages <= {"httpx", *sys.stdlib_module_names}
    assert {node.level for node in nodes if isinstance(node, ast.ImportFrom)} <= {0, 1}


def test_a_refusal_of_a_service_ends_a_command_as_other_input_that_cannot_be_used():
    from amers.app.client import RequestRefused

    refusal = RequestRefused("http://a: saliencyy: no such property", 400, "InvalidParameter")
    assert isinstance(refusal, amers.ServiceError)
    assert failure(refusal) == ("http://a: saliencyy: no such property", REFUSED)
