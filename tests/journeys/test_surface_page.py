"""A surface on the page: its colours with a legend, the height at a click, and a profile between two."""

import io
import re
import time

import httpx
import numpy as np
import pytest
from matplotlib.image import imread
from playwright.sync_api import Page, expect

from tests.app.surface_world import OPTIONS, write_pair
from tests.journeys.map_page import ARTEFACTS, WIDE, assert_readable, poll_ms, until_drawn
from tests.service_process import Service
from tests.services.surface.worlds import town

pytestmark = pytest.mark.thorough

OPEN_GROUND = town().centre_lon_lat + [0.0, -0.0004]
a_tenth_of_the_base_m = 0.3
patience_s = 300
a_visible_difference = 20.0


@pytest.fixture(scope="module")
def surface_job(service: Service, secret: str, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A job that made the surface of a pair."""
    with httpx.Client(
        base_url=service.url, headers={"Authorization": f"Bearer {secret}"}, timeout=60.0
    ) as client:
        ids = [
            client.post(f"/scenes?name={path.name}", content=path.read_bytes()).json()["id"]
            for path in write_pair(tmp_path_factory.mktemp("pair"))
        ]
        inputs = {"scenes": ids, "gsd_m": 1.0, "heights_m": list(OPTIONS.heights_m or ())}
        started = client.post("/processes/make-surface/execution", json={"inputs": inputs}).json()
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            job = client.get(f"/jobs/{started['jobID']}").json()
            if job["status"] not in ("accepted", "running"):
                break
            time.sleep(poll_ms / 1000.0)
        assert job["status"] == "successful", job
    return str(job["jobID"])


def coloured(page: Page) -> np.ndarray:
    until_drawn(page)
    return 255.0 * imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3]


def test_a_surface_is_seen_with_its_heights_and_a_profile(visit, secret, service, surface_job):
    page = visit(f"#/job/{surface_job}", secret, WIDE)
    section = page.get_by_role("region", name="Surface on the map")
    expect(section).to_contain_text("Sigma of the heights, median")
    expect(section.locator(".ramp-values span")).to_have_count(3)
    page.wait_for_timeout(10 * poll_ms)
    shown = coloured(page)
    page.screenshot(path=ARTEFACTS / "surface.png")
    section.get_by_label("Opacity").fill("0")
    bare = coloured(page)
    middle = np.s_[300:-300, 300:-300]
    assert np.abs(shown[middle] - bare[middle]).mean() > a_visible_difference
    section.get_by_label("Opacity").fill("100")

    lon, lat = OPEN_GROUND
    section.get_by_label("Place, or start of a profile").fill(f"{lat:.6f}, {lon:.6f}")
    page.keyboard.press("Enter")
    outcome = section.get_by_role("status")
    expect(outcome).to_contain_text("seen in 2 images")
    height_m = float(re.search(r"Height ([\d.]+) m", outcome.inner_text())[1])
    assert height_m == pytest.approx(
        float(town().height_m(OPEN_GROUND[None, :])[0]), abs=a_tenth_of_the_base_m
    )

    section.get_by_label("Place, or start of a profile").fill("")
    box = page.locator("#map").bounding_box()
    for share in (0.4, 0.6):
        page.mouse.click(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
        expect(outcome).to_contain_text("Height")
    chart = section.get_by_role("img", name="Profile of")
    expect(chart).to_be_visible()
    expect(outcome).to_contain_text("Lowest, highest")
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "surface-profile.png")
    assert_readable(page, "surface")

    page.set_viewport_size(WIDE)
    section.get_by_label("End of the profile").fill("somewhere")
    page.keyboard.press("Enter")
    expect(outcome).to_contain_text("is no coordinate")
    page.goto(f"{service.url}/map#/scenes")
    expect(section).to_have_count(0)
