"""The map page in a real browser: what people do there, and that nothing leaves the machine."""

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from matplotlib.image import imread
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

from tests.app.flat_world import FlatWorld, make_flat_world
from tests.serving import Service, until

ROOT = Path(__file__).parents[2]
BUILT = ROOT / "app" / "web" / "built" / "index.html"
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
ARTEFACTS = ROOT / "tests" / "artefacts"
DESKTOP = {"width": 1280, "height": 800}
PHONE = {"width": 390, "height": 844}
patience_ms = 90_000
chip_px = 101
points_of_the_block = 40
vector_colour = np.array([0xB3, 0x26, 0x1E])
enough_px = 50
most_stops = 80


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Debian's Chromium, which finds no machine but this one."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium: the page cannot be looked at (make test installs it)")
    if not BUILT.is_file():
        pytest.skip("the page is not built: run `make page`")
    ARTEFACTS.mkdir(exist_ok=True)
    expect.set_options(timeout=patience_ms)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=chromium,
            args=[
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
            ],
        )
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def world(amers, tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A scene, and the block it can be registered on, published."""
    world = make_flat_world(tmp_path_factory.mktemp("world"))
    amers("block", "ingest", world.block, "--publish")
    return world


@pytest.fixture(scope="module")
def administrator(amers) -> str:
    return str(amers("token", "create", "Ada", "--scope", "admin")["secret"])


Visit = Callable[..., Page]


@pytest.fixture
def visit(browser: Browser, service: Service, world: FlatWorld) -> Iterator[Visit]:
    """Opens the page; in the end, all requests must have gone to the service, without a complaint."""
    asked: list[str] = []
    complaints: list[str] = []
    contexts = []

    def open_page(where: str = "", secret: str | None = None, size=DESKTOP, scheme="light") -> Page:
        context = browser.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")
        context.set_default_timeout(patience_ms)
        contexts.append(context)
        context.on("request", lambda request: asked.append(request.url))
        context.on("weberror", lambda error: complaints.append(str(error.error)))
        context.on("console", lambda said: complaints.append(said.text) if is_complaint(said) else None)
        if secret is not None:
            keep = f"sessionStorage.setItem('amers-token', {json.dumps(secret)})"
            context.add_init_script(f"if (location.protocol === 'http:') {keep}")
        page = context.new_page()
        page.goto(f"{service.url}/map{where}")
        return page

    yield open_page
    for context in contexts:
        context.close()
    inside = (f"{service.url}/", f"blob:{service.url}/", "data:")
    assert asked
    assert [url for url in asked if not url.startswith(inside)] == []
    assert complaints == []


def is_complaint(said: ConsoleMessage) -> bool:
    """Errors, the refusals of the policy among them; that a stranger is refused is as it should be."""
    return said.type == "error" and "status of 401" not in said.text


def tab_to(page: Page, name: str) -> None:
    """Go on with the Tab key to the control of that name."""
    for _ in range(most_stops):
        page.keyboard.press("Tab")
        focused = page.evaluate(
            "(document.activeElement.labels?.[0] ?? document.activeElement).textContent"
        )
        if focused.startswith(name):
            return
    raise AssertionError(f"the Tab key does not lead to {name}")


def until_drawn(page: Page) -> None:
    """Wait for the map to have drawn all it has been given."""
    expect(page.locator("#map")).to_have_attribute("aria-busy", "false")


def vectors_drawn_px(page: Page) -> int:
    """Pixels of the map in the colour of the residuals."""
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3]
    return int((np.abs(picture * 255 - vector_colour) < 2).all(axis=2).sum())


def test_a_scene_goes_from_upload_to_report_with_the_keyboard_alone(visit, world, secret, service):
    page = visit()
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    page.screenshot(path=ARTEFACTS / "sign-in.png")
    tab_to(page, "Token")
    page.keyboard.type(secret)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Control points")).to_be_visible()

    tab_to(page, "Scenes")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Register a scene")).to_be_visible()
    tab_to(page, "Image")
    page.locator(":focus").set_input_files(world.image)
    tab_to(page, "Model files")
    page.locator(":focus").set_input_files(world.rpc_text)
    tab_to(page, "Accuracy")
    page.keyboard.type("6")
    page.screenshot(path=ARTEFACTS / "upload.png")
    tab_to(page, "Upload and register")
    page.keyboard.press("Enter")

    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    report = report_of(page, service, secret)
    figures = page.locator("dl.facts").inner_text()
    found = report["equipment"]
    assert f"{found['visible']}, {found['matched']}, {found['active']}" in figures
    assert page.locator(".badge").first.inner_text() == report["verdict"]
    assert page.locator("tbody tr").count() == len(report["criteria"])
    assert until(lambda: vectors_drawn_px(page) >= enough_px)
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "report.png")

    tab_to(page, "Open the report")
    with page.context.expect_page() as opened:
        page.keyboard.press("Enter")
    opened.value.wait_for_load_state()
    expect(opened.value.locator("body")).to_contain_text(report["verdict"])
    opened.value.screenshot(path=ARTEFACTS / "report-page.png")


def report_of(page: Page, service: Service, secret: str) -> dict:
    job = page.url.rsplit("/", 1)[1]
    headers = {"Authorization": f"Bearer {secret}"}
    reply = httpx.get(f"{service.url}/jobs/{job}/results/report.json", headers=headers, timeout=30.0)
    return dict(reply.raise_for_status().json())


def test_an_administrator_withdraws_a_block_and_publishes_it_again(
    visit, administrator, secret, service
):
    def served() -> int:
        headers = {"Authorization": f"Bearer {secret}"}
        reply = httpx.get(f"{service.url}/collections/points/items", headers=headers, timeout=30.0)
        return int(reply.raise_for_status().json()["numberMatched"])

    page = visit("#/blocks", administrator)
    page.get_by_role("link", name="flat").click()
    state = page.locator(".badge")
    expect(state).to_have_text("published")
    assert served() == points_of_the_block
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "block.png")
    page.get_by_role("button", name="Withdraw").click()
    expect(state).to_have_text("withdrawn")
    assert served() == 0
    page.screenshot(path=ARTEFACTS / "block-withdrawn.png")
    page.get_by_role("button", name="Publish").click()
    expect(state).to_have_text("published")
    assert served() == points_of_the_block


def test_only_an_administrator_is_offered_to_publish(visit, secret):
    page = visit("#/block/1", secret)
    expect(page.locator(".badge")).to_have_text("published")
    assert page.get_by_role("button", name="Withdraw").count() == 0


def test_a_point_shows_all_its_chips(visit, secret):
    page = visit("#/points", secret)
    points = page.get_by_role("list", name="Points in view").get_by_role("link")
    expect(points).to_have_count(points_of_the_block)
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "points.png")
    points.first.click()
    expect(page.get_by_role("heading", name="Point")).to_be_visible()
    chips = page.get_by_role("list", name="Chips").get_by_role("img")
    expect(chips).to_have_count(4)
    for chip in chips.all():
        expect(chip).to_have_js_property("naturalWidth", chip_px)
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "point.png")


def test_a_wrong_token_is_refused_in_the_words_of_the_service(visit):
    page = visit("#/access")
    page.get_by_label("Token").fill("wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("unknown, expired or revoked")


VIEWS = {
    "points": "Control points",
    "scenes": "Scenes",
    "blocks": "Blocks",
    "block/1": "Test block flat",
    "access": "Signed in",
}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_view_fits_a_phone_and_can_be_used_by_everybody(visit, administrator, scheme):
    """No sideways scrolling, and no finding of axe-core: contrast, names, roles, order."""
    page = visit("#/points", administrator, PHONE, scheme)
    for view, heading in VIEWS.items():
        page.evaluate(f"location.hash = '#/{view}'")
        expect(page.locator("#panel h1")).to_have_text(heading)
        until_drawn(page)
        page.screenshot(path=ARTEFACTS / f"phone-{view.replace('/', '-')}-{scheme}.png")
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"], view
        page.evaluate(AXE.read_text(encoding="utf-8"))
        findings = page.evaluate("axe.run().then((found) => found.violations)")
        assert [(found["id"], found["nodes"][0]["html"]) for found in findings] == [], view
