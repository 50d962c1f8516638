"""The page of the architecture, the list of modules and the reading list of the README are true."""

import ast
import re
import subprocess
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from scripts.make_module_list import PAGE, module_list

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
ARCHITECTURE = (ROOT / "docs/architecture.md").read_text()
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]


class Step(NamedTuple):
    """A definition at the top of a module, or a method of a class there."""

    path: str
    name: str


ROUTES = {
    "app/usecases/registration/register.py": (
        Step("app/api/processes.py", "execute"),
        Step("app/usecases/jobs.py", "execute"),
        Step("app/usecases/jobs.py", "find_process"),
        Step("app/usecases/jobs.py", "PROCESSES"),
        Step("app/usecases/registration/job.py", "REGISTER_SCENE"),
        Step("app/usecases/registration/job.py", "_run"),
        Step("app/usecases/registration/register.py", "run_registration"),
    ),
    "services/registration/on_points.py": (
        Step("app/usecases/registration/register.py", "run_registration"),
        Step("app/usecases/registration/register.py", "_register_and_write"),
        Step("app/usecases/registration/register.py", "_register"),
        Step("services/registration/on_points.py", "register_scene"),
    ),
    "services/matching/correlate.py": (
        Step("services/registration/on_points.py", "register_scene"),
        Step("services/registration/on_points.py", "search_scene"),
        Step("services/registration/on_points.py", "_match"),
        Step("services/registration/on_points.py", "search_near"),
        Step("services/matching/control_points.py", "match_points"),
        Step("services/matching/control_points.py", "_match_point"),
        Step("services/matching/correlate.py", "find_chip"),
    ),
    "services/misfit/affine_fit.py": (
        Step("services/registration/on_points.py", "register_scene"),
        Step("services/registration/on_points.py", "search_scene"),
        Step("services/registration/search.py", "adjust_search"),
        Step("services/misfit/image_correction.py", "adjust_scene"),
        Step("services/misfit/affine_start.py", "affine_start"),
        Step("services/misfit/affine_start.py", "_magnitude"),
        Step("services/misfit/affine_fit.py", "AffineFit.solution"),
    ),
    "services/sensors/rpc.py": (
        Step("services/misfit/affine_start.py", "affine_start"),
        Step("services/misfit/control_observations.py", "declared_fit"),
        Step("services/sensors/rpc.py", "RpcModel.project"),
    ),
}
"""How each file of the reading list is reached from an earlier one, or from one that a route passed."""
FIRST = "app/api/processes.py"


def definition(step: Step) -> ast.AST:
    """The function, class, method or assignment of a step."""
    body: list[ast.stmt] = ast.parse((ROOT / step.path).read_text()).body
    *classes, name = step.name.split(".")
    for one in classes:
        body = next(node.body for node in body if isinstance(node, ast.ClassDef) and node.name == one)
    for node in body:
        targets = [*getattr(node, "targets", []), getattr(node, "target", None)]
        assigned = {target.id for target in targets if isinstance(target, ast.Name)}
        if getattr(node, "name", None) == name or name in assigned:
            return node
    raise LookupError(f"{step.path} defines no {step.name}")


def imported(path: str) -> dict[str, str]:
    """What the names that a module imports stand for, as dotted names below `amers`."""
    names = {}
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def leads(step: Step, following: Step) -> bool:
    """Whether a step uses the next one: by an imported name, in its module, or as a method."""
    definition(following)
    names, method = imported(step.path), following.name.rpartition(".")[2]
    wanted = f"amers.{following.path.removesuffix('.py').replace('/', '.')}.{following.name}"
    used = set()
    for node in ast.walk(definition(step)):
        match node:
            case ast.Call(func=ast.Attribute(attr=attribute)) if "." in following.name:
                used |= {wanted} if attribute == method else set()
            case ast.Attribute(value=ast.Name(id=module), attr=attribute):
                used.add(f"{names.get(module)}.{attribute}")
            case ast.Name(id=name):
                used.add(
                    names.get(name, wanted if step.path == following.path and name == method else "")
                )
    return wanted in used


def test_the_reading_list_of_the_readme_is_that_of_the_routes():
    section = README.split("## Six files that show the whole job")[1].split("\n## ")[0]
    listed = re.findall(r"^\d\. `([^`]+)`", section, re.MULTILINE)
    assert listed == [FIRST, *ROUTES]
    passed = {step.path for route in ROUTES.values() for step in route}
    assert set(re.findall(r"`((?:app|services)/[^`]+\.py)`", section)) <= passed | {FIRST}


@pytest.mark.parametrize("path", ROUTES)
def test_calls_lead_to_a_file_of_the_reading_list(path):
    route = ROUTES[path]
    assert route[-1].path == path
    earlier = list(ROUTES)[: list(ROUTES).index(path)]
    reached = {FIRST} | {step.path for one in earlier for step in ROUTES[one]}
    assert route[0].path in reached
    assert [(a, b) for a, b in pairwise(route) if not leads(a, b)] == []


def test_a_call_that_is_not_made_and_a_name_that_is_not_defined_are_seen():
    assert not leads(ROUTES["services/matching/correlate.py"][1], Step(FIRST, "execute"))
    assert not leads(Step("app/usecases/jobs.py", "execute"), ROUTES["services/sensors/rpc.py"][0])
    with pytest.raises(LookupError):
        definition(Step("app/api/scenes.py", "no_such_function"))


def test_the_list_of_modules_is_that_of_the_tree():
    assert PAGE.read_text() == module_list(), "run scripts/make_module_list.py"


def test_every_package_and_module_has_a_first_line():
    assert "|  |" not in PAGE.read_text()
    assert not re.search(r"^## .*\n\n\n", PAGE.read_text(), re.MULTILINE)


@pytest.mark.parametrize("package", ["app", "services"])
def test_the_layers_are_those_of_the_contracts(package):
    contract = next(one for one in CONTRACTS if one.get("containers") == [f"amers.{package}"])
    block = ARCHITECTURE.split(f"layers of `{package}`:\n\n```\n")[1].split("\n```")[0]
    assert block.splitlines() == contract["layers"]


@pytest.mark.parametrize("name", [contract["name"] for contract in CONTRACTS])
def test_a_contract_is_explained(name):
    assert f"**{name}**" in ARCHITECTURE


def test_the_tree_has_every_folder_of_the_project():
    tree = ARCHITECTURE.split("## The tree\n\n```\n")[1].split("\n```")[0]
    named = {line.split("/")[0] for line in tree.splitlines()}
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    if not listed:
        pytest.skip("not in a checkout")
    folders = {path.split("/")[0] for path in listed if "/" in path} | {"amers"}
    assert named == {folder for folder in folders if not folder.startswith(".")}


def test_every_package_of_the_science_has_a_file_to_read_first():
    table = ARCHITECTURE.split("| package | read first |")[1].split("\n\n")[0]
    packages = set(re.findall(r"^\| `(services/\w+)`", table, re.MULTILINE))
    assert packages == {
        f"services/{path.parent.name}" for path in (ROOT / "services").glob("*/__init__.py")
    }
