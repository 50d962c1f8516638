"""The modules in which a fault would hurt most, each with the tests that are about it, or import it."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

SHORT = "not (endurance or thorough or long)"
"""Tests that are tried of files that only import a module."""
ALL = "not endurance"
"""Tests that are tried of files that are about a module."""


@dataclass(frozen=True)
class Module:
    """A part of the code that gets a score of its own.

    Attributes:
        name: as the user gives it.
        sources: files and folders of the code.
        tests: files and folders of the tests that are about it.
        part: file or folder whose mutants are tried; empty for all.
        is_everywhere: whether so much imports it that the files that do are not tried.
    """

    name: str
    sources: tuple[str, ...]
    tests: tuple[str, ...]
    part: str = ""
    is_everywhere: bool = False

    def mutated_files(self, root: Path) -> list[str]:
        """Paths of the modules of the code whose mutants are tried."""
        return [path for path in self.source_files(root) if Path(path).is_relative_to(self.part)]

    def source_files(self, root: Path) -> list[str]:
        """Paths of the modules of the code, relative to the root."""
        return [path for path in _python_files(root, self.sources) if not path.endswith("__init__.py")]

    def test_files(self, root: Path) -> dict[str, str]:
        """Paths of the modules of tests, relative to the root, each with the marks of those tried."""
        about = [path for path in _python_files(root, self.tests) if "/test_" in path]
        beside = [] if self.is_everywhere else importing(root, self.source_files(root))
        return dict.fromkeys(beside, SHORT) | dict.fromkeys(about, ALL)


def importing(root: Path, sources: Iterable[str]) -> list[str]:
    """Modules of tests that import one of some files of the code."""
    imports = "|".join(
        rf"from {re.escape(name)} import|from {re.escape(package)} import [^\n]*\b{last}\b"
        for name in ("amers." + path.removesuffix(".py").replace("/", ".") for path in sources)
        for package, _, last in [name.rpartition(".")]
    )
    return [path for path in all_tests(root) if re.search(imports, (root / path).read_text())]


def all_tests(root: Path) -> list[str]:
    """All modules of tests of the service and of the science."""
    return [path for path in _python_files(root, ("tests/app", "tests/services")) if "/test_" in path]


def _of_science(name: str, *more_tests: str) -> Module:
    tests = (f"tests/services/{name}", "tests/services/test_all_figures.py", *more_tests)
    return Module(f"services/{name}", (f"services/{name}",), tests)


def _of_service(name: str, sources: str, tests: str) -> Module:
    return Module(
        f"app/{name}",
        tuple(f"app/{path}" for path in sources.split()),
        tuple(f"tests/app/test_{one}.py" for one in tests.split()),
    )


MODULES = (
    _of_science("quality"),
    _of_science("adjustment"),
    _of_science("misfit"),
    _of_science("matching"),
    _of_science("sensors"),
    _of_science("registration"),
    _of_science("production"),
    _of_science("orthorectification"),
    Module(
        "services/geodesy",
        tuple(f"services/{one}.py" for one in ("geodesy", "terrain", "lines_of_sight", "map_grid")),
        (
            *(f"tests/services/test_{one}.py" for one in ("geodesy", "terrain", "map_grid", "datums")),
            "tests/services/orthorectification/test_occlusion.py",
        ),
    ),
    _of_service(
        "auth",
        "auth.py api/access.py api/credentials.py api/deps.py",
        "replies basic_authentication sign_in tokens oidc access_matrix engine crowd",
    ),
    _of_service("tokens", "usecases/tokens.py db/tokens.py", "tokens replies oidc jobs sign_in"),
    _of_service("quotas", "usecases/quotas.py db/usage.py", "storage_quota jobs"),
    _of_service(
        "jobs",
        "usecases/jobs.py db/jobs worker/attempt.py",
        "job_states lost_attempts job_leases jobs job_progress fair_queue attempt_outcomes",
    ),
    _of_service(
        "superseding",
        "db/superseding.py db/density.py",
        "replies superseding renewal_density feature_formats reply_models documents unpublished blocks",
    ),
    _of_service(
        "points",
        "db/points.py db/point_detail.py db/history.py usecases/history.py usecases/features/points.py",
        "replies unpublished points history chips blocks reply_models documents",
    ),
    _of_service("uploads", "usecases/uploads.py db/uploads.py", "uploads upload_faults"),
    _of_service("storage", "storage", "storage storage_identity bucket"),
    _of_service(
        "cleaning",
        "usecases/garbage_collection.py usecases/retention.py worker/sweep.py",
        "sweep retention job_leases storage_identity storage",
    ),
    replace(_of_service("config", "config.py", "config wrong_use"), is_everywhere=True),
    _of_service(
        "cli",
        "cli",
        "wiring exit_statuses command_output options options_file recorded_help command_help wrong_use "
        "supervisor output_forms examples_of_commands select_command production_plan register_command",
    ),
)


def chosen_modules(names: Sequence[str]) -> list[Module]:
    """The modules of some names, all for none; a path inside a module chooses that part of it.

    Raises:
        SystemExit: a name means no module.
    """
    if not names:
        return list(MODULES)
    chosen = []
    for name in names:
        found = next((module for module in MODULES if _contains(module, name)), None)
        if found is None:
            known = ", ".join(module.name for module in MODULES)
            raise SystemExit(f"{name}: no such module; expected a path inside one of {known}")
        chosen.append(found if name == found.name else replace(found, name=name, part=name))
    return chosen


def _contains(module: Module, name: str) -> bool:
    return name == module.name or any(Path(name).is_relative_to(source) for source in module.sources)


def _python_files(root: Path, places: tuple[str, ...]) -> list[str]:
    found = []
    for place in places:
        path = root / place
        inside = sorted(path.rglob("*.py")) if path.is_dir() else [path]
        found += [str(one.relative_to(root)) for one in inside]
    return found
