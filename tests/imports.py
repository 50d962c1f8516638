"""Which packages of others a program imports, and who asks for them first."""

import json
import os
import subprocess
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = frozenset(
    """
    alembic cv2 fastapi geoalchemy2 httpx importlib.metadata jinja2 matplotlib numba numpy obstore
    pandas procrastinate prometheus_client psycopg pyarrow pydantic_settings pyogrio pyproj rasterio
    scipy scipy.spatial scipy.stats shapely sqlalchemy uvicorn
    """.split()  # noqa: SIM905
)
"""What takes long to import."""
CONNECTION = frozenset({"importlib.metadata", "psycopg", "pydantic_settings"})
"""What the settings and a connection of the driver need."""
LISTING = CONNECTION | {"numpy"}
"""What a list of blocks with their accuracy needs."""
PROGRAM = """
import atexit, json, sys

class Importers:
    "Notes which file first imports a package."
    first = {}

    def find_spec(self, name, path=None, target=None):
        if name not in self.first:
            frame = sys._getframe(1)
            while frame and "importlib" in frame.f_code.co_filename:
                frame = frame.f_back
            self.first[name] = f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame else ""

sys.meta_path.insert(0, Importers())
atexit.register(lambda: print(json.dumps(Importers.first)))
"""
COMMAND = "from amers.app.cli.main import main; main()"


def imported_by(statement: str, words: str = "", **environment: str) -> dict[str, str]:
    """The modules that a statement imports, each with the line that imported it first.

    Args:
        words: arguments of the program.
        environment: variables of the program, beside those of the tests.
    """
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM + statement, *words.split()],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    first: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return first


def beyond_budget(imported: Mapping[str, str], budget: Collection[str]) -> dict[str, str]:
    """Of modules with the lines that imported them first: those that take long and are in no budget."""
    return {name: line for name, line in imported.items() if name in PACKAGES and name not in budget}
