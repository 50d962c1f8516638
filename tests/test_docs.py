"""The documentation site."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    result = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return folder


@pytest.mark.thorough
def test_the_site_has_the_guide_the_methods_and_the_library(site):
    pages = (
        "index",
        "guide",
        "glossary",
        "methods/registration",
        "library/registration",
        "contributing",
    )
    assert [page for page in pages if not (site / f"{page}.html").is_file()] == []


def test_the_site_shows_the_pictures_of_the_readme(site):
    page = (site / "index.html").read_text()
    pictures = re.findall(r'<img[^>]* src="([^"]+)"', page)
    assert [Path(picture).name for picture in pictures] == ["report.jpg", "map.jpg"]
    for picture in pictures:
        assert 10_000 < (site / picture).stat().st_size < 200_000


def test_a_formula_is_mathml_and_needs_no_script(site):
    page = (site / "methods/block_adjustment.html").read_text()
    assert "<math" in page
    assert "arithmatex" not in page


def test_the_site_asks_nothing_of_the_network(site):
    for page in site.rglob("*.html"):
        for kind in ('src="http', 'rel="stylesheet" href="http', "fonts.googleapis"):
            assert kind not in page.read_text(), page


def test_a_link_to_the_code_leads_to_its_reference(site):
    page = (site / "methods/rpc.html").read_text()
    assert 'href="../library/sensors.html#amers.services.sensors.rpc"' in page
