"""A working folder as a hostile delivery unpacks it: modules that are named like those of commands."""

import sys
from importlib.metadata import packages_distributions
from pathlib import Path

MODULE = (
    "import os\nos.write(os.open({marker!r}, os.O_WRONLY | os.O_CREAT | os.O_APPEND), b'{name}\\n')\n"
)
"""It says that it was imported; what it should define is missing, so that the import of it fails."""
SETTINGS = {
    ".numba_config.yaml": "cache_dir: {folder}\ndisable_jit: 0\n",
    ".env": "AMERS_PORT=1\nAMERS_DATABASE_URL=postgresql://nobody@127.0.0.1:9/none\n",
    "alembic.ini": "[alembic]\nscript_location = {folder}/app\n",
    "pyproject.toml": "[tool.alembic]\nscript_location = '{folder}/app'\n",
    ".pgpass": "*:*:*:*:wrong\n",
    ".netrc": "default login wrong password wrong\n",
    "gdalrc": "[configoptions]\nGDAL_DRIVER_PATH={folder}\n",
    "path.pth": "import sitecustomize\n",
}
"""Files from which libraries take settings elsewhere."""


def fill_with_modules(folder: Path) -> Path:
    """Write modules of all names into a folder; each of them adds its name to the returned file."""
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder.with_name(f"{folder.name} was executed")
    ours = {"app", "services", "migrations", "tests", "sitecustomize", "usercustomize", "cv2", "numpy"}
    for name in sys.stdlib_module_names | packages_distributions().keys() | ours:
        if name.isidentifier():
            module = MODULE.format(marker=str(marker), name=name)
            (folder / f"{name}.py").write_text(module)
            (folder / name).mkdir()
            (folder / name / "__init__.py").write_text(module)
    for name, content in SETTINGS.items():
        (folder / name).write_text(content.format(folder=folder))
    return marker


def executed(marker: Path) -> list[str]:
    """The modules that were imported."""
    return sorted(set(marker.read_text().split())) if marker.exists() else []
