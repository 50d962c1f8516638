"""The view of a registration: arrows with a scale, criteria, what stands under the divider, failures."""

import io
import re
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
import rasterio
from matplotlib.image import imread
from playwright.sync_api import Locator, Page, expect

from tests.app.flat_world import FlatWorld
from tests.journeys.map_page import (
    ARTEFACTS,
    PHONE,
    WIDE,
    assert_readable,
    poll_ms,
    registered,
    until_drawn,
)
from tests.service_process import Service, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

an_outline_px = 40
"""By which an outline is larger than the part of the image that has points."""
brown = 30.0
"""Green above blue: more than any ground of the map has, less than the dashes of an outline."""
a_visible_difference = 5.0
as_good_as_equal = 1.0
"""Mean differences of grey values from 0 to 255."""
scale_px = (14.0, 71.0)
"""Lengths of the arrow of the legend: a round number of metres, at most as long as it may be."""
LEFT = np.s_[160:-120, 100:450]
"""A part of the map on the left of the divider, without the field and the legend."""


@pytest.fixture(scope="module")
def job(service: Service, secret: str, world: FlatWorld) -> str:
    return registered(service, secret, world, "arrows.tif")


@pytest.fixture(scope="module")
def client(service: Service, secret: str) -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        yield client


def grey_map(page: Page) -> np.ndarray:
    """What the map shows, as grey values from 0 to 255."""
    page.wait_for_timeout(poll_ms)
    until_drawn(page)
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))
    return picture[:, :, :3].mean(axis=2) * 255.0


def section_of(page: Page) -> Locator:
    """The section of the image on the map, once the image is there."""
    section = page.get_by_role("region", name="Image on the map")
    expect(section.get_by_label("Both, with a divider")).to_be_visible()
    return section


def test_the_arrows_have_a_scale_that_follows_the_map(visit, secret, job):
    """One zoom nearer, the same number of metres takes twice the pixels, or a smaller one is shown."""
    page = visit(f"#/job/{job}", secret, WIDE)
    legend = page.get_by_role("note", name="Legend of the arrows")
    expect(legend).to_contain_text(re.compile(r"Residuals, \d.* times longer; grey: not used"))

    def metres_per_px() -> float:
        until_drawn(page)
        number, unit = re.search(r"([\d.]+)\s(mm|m)\b", legend.inner_text()).groups()  # type: ignore[union-attr]
        box = legend.locator(".arrow").bounding_box()
        assert box
        assert scale_px[0] <= box["width"] <= scale_px[1]
        return float(number) / (1000.0 if unit == "mm" else 1.0) / box["width"]

    far = metres_per_px()
    assert_readable(page, "registration-arrows")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")
    page.reload()
    far = metres_per_px()
    page.get_by_role("button", name="Zoom in").click()
    page.wait_for_timeout(poll_ms)
    assert metres_per_px() == pytest.approx(far / 2.0, rel=0.1)


def test_a_criterion_has_one_row_with_its_limits_for_good_and_usable(visit, secret, job, client):
    criteria = client.get(f"/jobs/{job}/results/report.json").json()["criteria"]
    page = visit(f"#/job/{job}", secret, WIDE)
    table = page.get_by_role("table")
    heads = table.get_by_role("columnheader")
    expect(heads).to_have_text(["Criterion", "Value", "Good", "Usable"])
    names = {one["name"] for one in criteria}
    assert len(names) < len(criteria), "some criteria have two levels"
    expect(table.locator("tbody tr")).to_have_count(len(names))
    good = sum(one["needed_for"] == "good" for one in criteria)
    limits = table.locator("tbody td:nth-child(3)").filter(has_text=re.compile("[≥≤]"))
    expect(limits).to_have_count(good)
    missed = sum(not one["met"] for one in criteria)
    expect(table.locator("td.missed")).to_have_count(missed)
    table.scroll_into_view_if_needed()
    page.screenshot(path=ARTEFACTS / "registration-criteria.png")


def test_the_divider_compares_with_chips_and_with_another_registered_scene(
    visit, world, secret, service, job
):
    """Of the same ground: a registered scene looks the same as the other one, and unlike the raw one."""
    registered(service, secret, world, "the-other.tif")
    page = visit(f"#/job/{job}/map", secret, WIDE)
    section = section_of(page)
    section.get_by_label("Points and residuals over the image").uncheck()
    expect(page.get_by_role("note", name="Legend of the arrows")).to_have_count(0)
    raw = grey_map(page)
    left = section.get_by_label("Left of the divider")
    left.select_option(label="This scene, registered")
    expect(section.get_by_role("radio").nth(1)).to_have_accessible_name("Registered")
    own = grey_map(page)
    left.select_option(label="Scene the-other.tif, registered")
    expect(page.get_by_role("slider", name="Divider between the-other.tif")).to_be_visible()
    assert until(lambda: bool(np.abs(grey_map(page)[LEFT] - own[LEFT]).mean() < as_good_as_equal))
    assert np.abs(raw[LEFT] - own[LEFT]).mean() > a_visible_difference
    assert_readable(page, "image-beside-another")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")

    left.select_option(label="Chips of the points")
    expect(page.get_by_role("slider", name="Divider between Chips")).to_be_visible()
    page.wait_for_timeout(10 * poll_ms)
    with_chips = grey_map(page)
    section.get_by_label("Opacity").fill("0")
    without = grey_map(page)
    assert np.abs(with_chips[LEFT] - without[LEFT]).mean() > as_good_as_equal
    page.screenshot(path=ARTEFACTS / "image-beside-chips.png")
    page.goto(f"{service.url}/map#/points")
    expect(page.get_by_role("slider", name="Divider")).to_have_count(0)


def test_the_outline_on_the_map_is_that_of_the_pixels_that_are_shown(visit, secret, job, client):
    """The outlines of both models are drawn, the one around both is not."""
    page = visit(f"#/job/{job}/map", secret, WIDE)
    section_of(page)
    newest = client.get("/jobs?processID=map-scene&limit=1").json()["jobs"][0]["jobID"]
    outlines = client.get(f"/jobs/{newest}/results").json()["outlines"]
    assert sorted(outlines) == ["raw", "registered"]
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "image-outlines.png")
    accent = np.array([0x8A, 0x4B, 0x08])
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3] * 255
    dashes = (np.abs(picture - accent) < 3).all(axis=2)
    assert dashes.any(axis=0).sum() > WIDE["width"] / 10


def outline_extent_px(page: Page) -> int:
    """Height of what the map shows in the brown of outlines and of the edge of the part with points."""
    page.wait_for_timeout(10 * poll_ms)
    until_drawn(page)
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3] * 255
    rows = np.flatnonzero((picture[:, :, 1] - picture[:, :, 2] > brown).any(axis=1))
    return int(np.ptp(rows)) if len(rows) else 0


def test_the_outline_of_a_scene_is_shown_once_that_of_its_pixels_is_known(
    visit, secret, service, world, client
):
    """The one over all heights of the ground is never drawn: it lies beside the pixels."""
    job = registered(service, secret, world, "outlined.tif")
    scene = client.get(f"/jobs/{job}").json()["inputs"]["scene"]
    page = visit(f"#/job/{job}", secret, WIDE)
    places = {f"#/job/{job}": page.get_by_role("table"), f"#/scene/{scene}": page.locator(".facts")}

    def drawn_px() -> list[int]:
        found = []
        for place, part in places.items():
            page.goto(f"{service.url}/map{place}")
            page.reload()
            expect(part.first).to_be_visible()
            found.append(outline_extent_px(page))
        return found

    before = drawn_px()
    page.screenshot(path=ARTEFACTS / "outline-unknown.png")
    inputs = {"scene": scene, "registration": job}
    drawing = client.post("/processes/map-scene/execution", json={"inputs": inputs}).json()["jobID"]
    assert until(lambda: client.get(f"/jobs/{drawing}").json()["status"] == "successful")
    after = drawn_px()
    page.screenshot(path=ARTEFACTS / "outline-known.png")
    gained = np.subtract(after, before)
    assert before[1] == 0
    assert (gained > an_outline_px).all(), (before, after)


def test_a_failed_job_leads_to_its_scene(visit, secret, world, client, tmp_path):
    noise = tmp_path / "noise.tif"
    with rasterio.open(world.tagged) as image:
        profile = {"driver": "GTiff", "width": image.width, "height": image.height, "count": 1}
        with rasterio.open(noise, "w", **profile, dtype="uint8", rpcs=image.rpcs) as file:
            pixels = np.random.default_rng(5).integers(1, 255, (1, image.height, image.width))
            file.write(pixels.astype(np.uint8))
    scene = client.post("/scenes?name=noise.tif&sigma_m=3", content=noise.read_bytes()).json()["id"]
    asked = client.post("/processes/register-scene/execution", json={"inputs": {"scene": scene}})
    page = visit(f"#/job/{asked.json()['jobID']}", secret, WIDE)
    expect(page.locator(".badge")).to_have_text("failed")
    expect(page.locator("#panel h1")).to_have_text("noise.tif")
    expect(page.locator(".maplibregl-ctrl-scale")).to_have_text(re.compile(r"^\d+\s+m$"))
    assert_readable(page, "job-failed")
    page.set_viewport_size(WIDE)
    page.get_by_role("link", name="Go to the scene").click()
    expect(page.locator("#panel h1")).to_have_text("noise.tif")
    expect(page.get_by_role("link", name="Mark points")).to_be_visible()
    assert page.url.endswith(f"#/scene/{scene}")


def test_scenes_and_jobs_are_filtered_sorted_and_seen_page_by_page(visit, secret, client, job):
    """Names of files, dates and places: no id of a scene is shown."""
    for number in range(25):
        client.post(f"/scenes?name=flight-{number:02}.tif", content=b"II*\0").raise_for_status()
    page = visit("#/scenes", secret, WIDE)
    rows = page.get_by_role("list", name="List of scenes").get_by_role("listitem")
    expect(rows).to_have_count(20)
    expect(rows.first).to_contain_text("flight-24.tif")
    page.get_by_role("button", name="Next scenes").click()
    expect(page.get_by_text(re.compile(r"^21 to \d+ of \d+ scenes$"))).to_be_visible()
    page.get_by_label("Filter scenes").fill("flight-0")
    expect(rows).to_have_count(10)
    page.get_by_label("Sort by").last.select_option(label="name")
    expect(rows.first).to_contain_text("flight-00.tif")
    assert_readable(page, "scenes-filtered")
    page.get_by_label("Filter scenes").fill("no such scene")
    expect(page.get_by_text("No scene has these words")).to_be_visible()
    page.get_by_label("Filter scenes").fill("arrows.tif")
    expect(rows).to_have_count(1)
    expect(rows.first).to_contain_text(re.compile("near |° N"))
    text = page.locator("#panel").inner_text()
    assert not re.search(r"[0-9a-f]{8}-[0-9a-f]{4}-", text)


def test_a_long_name_of_a_token_is_shown_whole(visit, amers):
    name = "Laboratory of photogrammetry, second floor"
    page = visit("#/points", str(amers("token", "create", name, "--scope", "read")["secret"]), WIDE)
    shown = page.locator("#access")
    expect(shown).to_have_text(name)
    for size in (WIDE, PHONE):
        page.set_viewport_size(size)
        assert shown.evaluate("one => one.scrollWidth <= one.clientWidth + 1")
        expect(shown).to_be_in_viewport(ratio=1)
    page.screenshot(path=ARTEFACTS / "long-name-390.png")


def test_the_administration_takes_the_whole_page(visit, administrator):
    page = visit("#/admin/tokens", administrator, WIDE)
    expect(page.locator("#panel h1")).to_have_text("Tokens")
    expect(page.locator("#map")).to_be_hidden()
    box = page.locator("#panel").bounding_box()
    assert box
    assert box["width"] == WIDE["width"]
    page.screenshot(path=ARTEFACTS / "admin-whole.png")
    page.get_by_role("link", name="Points").click()
    expect(page.locator("#map")).to_be_visible()
