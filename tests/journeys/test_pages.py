"""The pages of the service beside the map, and the reports: accessible, and as wide as a phone."""

import json
from pathlib import Path

import pytest
import rasterio
from playwright.sync_api import Browser, expect

from tests.app.flat_world import FlatWorld
from tests.command_line import amers_here
from tests.journeys.conftest import Amers
from tests.journeys.map_page import assert_readable, tab_to
from tests.service_process import Service, installed_at

pytestmark = [pytest.mark.long, pytest.mark.thorough]

PAGES = {
    "landing": "/",
    "api": "/api",
    "connect": "/connect",
    "conformance": "/conformance",
    "collections": "/collections",
    "collection": "/collections/points",
    "points-table": "/collections/points/items",
    "blocks-table": "/collections/blocks/items",
}
"""Addresses of pages by the names of their pictures."""
PLAN = {
    "images": [
        {
            "name": name,
            "lon": lon,
            "lat": 43.3,
            "along_km": 10.0,
            "across_km": 10.0,
            "gsd_m": 2.0,
            "incidence_deg": 15.0,
            "azimuth_deg": azimuth_deg,
            "sigma_m": 6.0,
        }
        for name, lon, azimuth_deg in (("west", 5.4, 280.0), ("middle", 5.46, 100.0))
    ],
    "spacing_km": 1.0,
    "sites": [{"name": "harbour", "lon": 5.4, "lat": 43.31}],
    "candidates": {"spacing_km": 6.0},
}
"""Two images that see one place from both sides, one place that is known, and places that may be."""


@pytest.mark.parametrize("name", PAGES)
def test_a_page_of_the_service_is_readable(name, browser: Browser, service: Service, world, secret):
    with browser.new_context(http_credentials={"username": "any", "password": secret}) as context:
        page = context.new_page()
        page.goto(f"{service.url}{PAGES[name]}")
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        assert_readable(page, f"page-{name}")


@pytest.mark.parametrize("name", ["landing", "api"])
def test_a_request_is_tried_with_the_keyboard_alone(
    name, browser: Browser, service: Service, world, secret
):
    """From the page to a table of points, with nothing from another site."""
    with browser.new_context(http_credentials={"username": "any", "password": secret}) as context:
        asked: list[str] = []
        context.on("request", lambda request: asked.append(request.url))
        page = context.new_page()
        page.goto(f"{service.url}{PAGES[name]}")
        tab_to(page, "Box")
        page.keyboard.press("ControlOrMeta+a")
        page.keyboard.type("-10,35,30,60")
        tab_to(page, "Send the request")
        page.keyboard.press("Enter")
        expect(page.get_by_role("table")).to_be_visible()
        assert "bbox=-10" in page.url
        assert all(url.startswith(service.url) for url in asked)


def test_the_page_of_a_point_and_the_form_to_sign_in_are_readable(
    browser: Browser, service: Service, world, secret
):
    with browser.new_context(http_credentials={"username": "any", "password": secret}) as context:
        page = context.new_page()
        page.goto(f"{service.url}/collections/points/items?f=html")
        page.locator("table a").first.click()
        expect(page.get_by_role("img").first).to_be_visible()
        assert_readable(page, "page-point")
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{service.url}/sign-in")
        assert_readable(page, "page-sign-in")


@pytest.fixture(scope="module")
def reports(
    world: FlatWorld, installation: Path, amers: Amers, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Reports by the names of their pictures: of scenes, one of other ground, a block, a plan."""
    folder = tmp_path_factory.mktemp("reports")
    with rasterio.open(world.tagged) as scene:
        pixels, profile, model = scene.read(1), scene.profile, scene.rpcs
    for name, ground in (("right", pixels), ("wrong", pixels[:, ::-1].T)):
        with rasterio.open(folder / f"{name}.tif", "w", **profile) as copy:
            copy.write(ground, 1)
            copy.rpcs = model
    words = ("scene", "register", folder / "right.tif", folder / "wrong.tif", "-o", folder / "out")
    registered = amers_here((*words, "--sigma-m", "6"), installed_at(installation / "data"))
    assert registered.returncode != 0, "one of two scenes cannot be registered"
    amers("block", "quality", world.block, "-o", folder / "quality")
    (folder / "plan.json").write_text(json.dumps(PLAN))
    amers("production", "plan", folder / "plan.json", "-o", folder / "plan")
    return {
        "registration": folder / "out" / "right" / "report.html",
        "failure": folder / "out" / "wrong" / "report.html",
        "overview": folder / "out" / "overview.html",
        "block-quality": folder / "quality" / "block_quality.html",
        "plan": folder / "plan" / "report.html",
    }


@pytest.mark.parametrize("name", ["registration", "failure", "overview", "block-quality", "plan"])
def test_a_report_is_readable(name, browser: Browser, reports):
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(reports[name].as_uri())
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        assert_readable(page, f"report-{name}")


def test_the_residual_vectors_of_a_report_end_at_the_edges_of_the_image(browser: Browser, reports):
    """Styles of the drawing of a figure must not reach the drawing inside it, which cuts the vectors."""
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(reports["registration"].as_uri())
        vectors = page.locator("figure > svg > svg").first
        assert vectors.evaluate("drawing => getComputedStyle(drawing).overflow") == "hidden"
