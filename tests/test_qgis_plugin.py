"""The zip of the QGIS plugin: whole, the same each time, and readable by the oldest QGIS it names.

What the plugin does in QGIS is tested by `make test-qgis`.
"""

import ast
import configparser
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree as ET
from zipfile import ZipFile

import pytest

from scripts.make_plugin import PLUGIN, ROOT, write_plugin

REQUIRED = ("name", "qgisMinimumVersion", "description", "about", "version", "author")
"""What QGIS and its repository of plugins ask for in `metadata.txt`."""
OF_QGIS = {"qgis", "osgeo"}
PYTHON_OF_QGIS_3_22 = (3, 9)
MODULES = sorted(PLUGIN.glob("*.py"))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """The texts in the zip, by name."""
    write_plugin(tmp_path / "plugin.zip")
    with ZipFile(tmp_path / "plugin.zip") as archive:
        return {name: archive.read(name).decode() for name in archive.namelist()}


def test_the_zip_has_one_folder_with_the_modules_the_licence_and_the_style_of_points(files):
    others = {"LICENSE", "README.md", "metadata.txt", "points.qml"}
    assert set(files) == {f"amers/{name}" for name in others | {path.name for path in MODULES}}
    assert "Apache License" in files["amers/LICENSE"]
    assert ET.fromstring(files["amers/points.qml"]).find("renderer-v2/ranges/range") is not None


def test_the_same_sources_make_the_same_zip(tmp_path):
    for name in ("one.zip", "two.zip"):
        write_plugin(tmp_path / name)
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()


def test_the_metadata_have_what_qgis_asks_for_and_the_version_of_amers(files):
    metadata = configparser.ConfigParser()
    metadata.read_string(files["amers/metadata.txt"])
    general = metadata["general"]
    assert [name for name in REQUIRED if not general.get(name)] == []
    assert general["qgisMinimumVersion"] == "3.22"
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (general["version"], general["license"]) == (stated["version"], stated["license"])


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.name)
def test_a_module_needs_nothing_but_qgis_and_its_python(path):
    tree = ast.parse(path.read_text(), feature_version=PYTHON_OF_QGIS_3_22)
    assert ast.get_docstring(tree)
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [str(node.module)]
        packages = {name.split(".")[0] for name in names}
        assert packages - OF_QGIS <= sys.stdlib_module_names
