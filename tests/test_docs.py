"""The documentation site."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

pytestmark = pytest.mark.long

ROOT = Path(__file__).parent.parent
FIRST_RESULTS = 3
patience_ms = 60_000
settled_ms = 500
"""After which a list of results no longer changes."""
QUESTIONS = {
    "pick gcp automatically from ortho image": "questions.html#can-ground-control-points-be-picked",
    "does bundle adjustment change rpc coefficients": "questions.html#does-bundle-adjustment-change",
    "apply corrected rpc to image": "questions.html#how-do-i-apply-a-corrected-rpc",
    "gcp hundreds of pixels off datum": "questions.html#gcp-are-hundreds-of-pixels-off",
    "small residuals check points held out": "questions.html#residuals-of-the-control-points-are-small",
    "clouds shadows mask image": "questions.html#how-do-clouds",
    "holes in surface over water": "questions.html#the-surface-has-holes",
    "too few tie points found": "questions.html#too-few-tie-points",
    "shift larger than search radius": "questions.html#my-image-is-shifted-by-more",
    "different sensors and resolutions": "questions.html#does-it-work-between-sensors",
    "image resampled pixel values": "questions.html#is-the-image-resampled",
    "local shifts remain jitter": "questions.html#local-shifts-remain",
    "read control points of another tool": "questions.html#can-i-use-tie-points-or-control-points",
    "ortho image shifted geoid ellipsoid": "questions.html#the-ortho-image-is-shifted",
    "gdal ignores gcp with rpc": "questions.html#gdal-ignores-my-gcps",
    "half a pixel between tools": "questions.html#there-is-half-a-pixel",
    "how many control points are needed rms": "questions.html#what-is-the-rms-error",
    "rigorous model or rpc": "questions.html#should-i-use-the-rigorous",
    "cropped image tiles of product": "questions.html#which-tiles-cropped-images",
    "gcp_list.txt vertical datum": "questions.html#in-which-vertical-datum",
    "drone images frame camera": "questions.html#are-drone-images-supported",
    "backup and restore": "operations.html#backup-and-restore",
}
"""What people type, and the beginning of the place that answers; after issues of other projects."""


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


@pytest.mark.thorough
def test_the_site_shows_the_pictures_of_the_readme(site):
    page = (site / "index.html").read_text()
    pictures = re.findall(r'<img[^>]* src="([^"]+)"', page)
    assert [Path(picture).name for picture in pictures] == ["report.jpg", "map.jpg"]
    for picture in pictures:
        assert 10_000 < (site / picture).stat().st_size < 200_000


@pytest.mark.thorough
def test_a_formula_is_mathml_and_needs_no_script(site):
    page = (site / "methods/block_adjustment.html").read_text()
    assert "<math" in page
    assert "arithmatex" not in page


@pytest.mark.thorough
def test_the_site_asks_nothing_of_the_network(site):
    for page in site.rglob("*.html"):
        for kind in ('src="http', 'rel="stylesheet" href="http', "fonts.googleapis"):
            assert kind not in page.read_text(), page


@pytest.mark.thorough
def test_a_link_to_the_code_leads_to_its_reference(site):
    page = (site / "methods/rpc.html").read_text()
    assert 'href="../library/sensors.html#amers.services.sensors.rpc"' in page


@pytest.fixture(scope="module")
def searched(site: Path) -> Iterator[Page]:
    """The site opened from its folder, in a browser without a network."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium: the search cannot be tried: run `make chromium`")
    with sync_playwright() as driver:
        nowhere = "--host-resolver-rules=MAP * ~NOTFOUND"
        browser = driver.chromium.launch(executable_path=chromium, args=[nowhere])
        page = browser.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto((site / "index.html").as_uri())
        page.get_by_role("textbox", name="Search").click()
        # It says so once it has read the index.
        ready = page.locator(".md-search-result__meta")
        expect(ready).to_have_text("Type to start searching", timeout=patience_ms)
        yield page
        browser.close()
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []


@pytest.mark.thorough
@pytest.mark.parametrize("question", QUESTIONS)
def test_the_search_from_disk_finds_an_answer_in_the_first_results(question, searched: Page, site):
    field = searched.get_by_role("textbox", name="Search")
    field.fill("")
    searched.wait_for_timeout(settled_ms)
    field.press_sequentially(question)
    found = searched.locator(".md-search-result__item > a")
    expect(found.first).to_be_visible(timeout=patience_ms)
    searched.wait_for_timeout(settled_ms)
    links = [str(link.get_attribute("href")) for link in found.all()[:FIRST_RESULTS]]
    places = [re.sub(r"\?[^#]*", "", link.removeprefix(f"{site.as_uri()}/")) for link in links]
    assert any(place.startswith(QUESTIONS[question]) for place in places), places


def test_every_question_of_other_users_has_a_heading_of_its_own():
    headings = re.findall(r"^### (.+)$", (ROOT / "docs/questions.md").read_text(), re.MULTILINE)
    assert len(headings) >= 20
    assert all(heading.endswith(("?", ".")) for heading in headings)
