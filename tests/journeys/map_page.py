"""The map page in tests: sizes of windows, waiting, the keyboard, and what every view has to be."""

from pathlib import Path

import httpx
from playwright.sync_api import ConsoleMessage, Page, Route, ViewportSize, expect

from tests.app.flat_world import FlatWorld
from tests.service_process import Service, until

ROOT = Path(__file__).parents[2]
BUILT = ROOT / "app" / "web" / "built" / "index.html"
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
ARTEFACTS = ROOT / "tests" / "artefacts"
DESKTOP: ViewportSize = {"width": 1280, "height": 800}
WIDE: ViewportSize = {"width": 1440, "height": 900}
PHONE: ViewportSize = {"width": 390, "height": 844}
patience_ms = 90_000
most_stops = 80
poll_ms = 100
tallest_picture_px = 8_000
"""Chromium draws a page again from its beginning where a picture is taller than a texture, 8192 px."""


def is_error(message: ConsoleMessage, refused: int) -> bool:
    """Whether a message is an error, violations of the policy included, but no reply of one status."""
    return message.type == "error" and f"status of {refused}" not in message.text


def tab_to(page: Page, name: str) -> None:
    """Press the Tab key until the control with a name, once it is there, has the focus."""
    expect(page.get_by_text(name).first).to_be_visible()
    for _ in range(most_stops):
        page.keyboard.press("Tab")
        focused = page.evaluate(
            "(document.activeElement.labels?.[0] ?? document.activeElement).textContent"
        )
        if focused.startswith(name):
            return
    raise AssertionError(f"the Tab key does not lead to {name}")


def until_drawn(page: Page) -> None:
    """Wait until the map has drawn all of its data."""
    expect(page.locator("#map")).to_have_attribute("aria-busy", "false")


def assert_readable(page: Page, view: str) -> None:
    """Check that a view is accessible and fits a phone; pictures of it are for people."""
    has_map = page.locator("#map").count() > 0
    for size in (WIDE, PHONE):
        page.set_viewport_size(size)
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            page.wait_for_timeout(poll_ms)
            if has_map:
                until_drawn(page)
            name = f"{view}-{size['width']}-{scheme}"
            if has_map:
                page.screenshot(path=ARTEFACTS / f"{name}.png")
            else:
                keep_whole_page(page, name)
            page.evaluate(AXE.read_text(encoding="utf-8"))
            findings = page.evaluate("axe.run().then((found) => found.violations)")
            assert [(found["id"], found["nodes"][0]["html"]) for found in findings] == [], view
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"], view


def keep_whole_page(page: Page, name: str) -> None:
    """Keep pictures of a page that is longer than its window, in parts where one would repeat itself."""
    width, height = page.evaluate("[document.body.scrollWidth, document.documentElement.scrollHeight]")
    for part, top in enumerate(range(0, height, tallest_picture_px), 1):
        of_page = {"x": 0, "y": top, "width": width, "height": min(tallest_picture_px, height - top)}
        path = ARTEFACTS / (f"{name}.png" if part == 1 else f"{name}-{part}.png")
        page.screenshot(path=path, full_page=True, clip=of_page)


def registered(service: Service, secret: str, world: FlatWorld, name: str = "drawn-on.tif") -> str:
    """The job that registered the scene of the world."""
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        sent = client.post(f"/scenes?name={name}", content=world.tagged.read_bytes())
        inputs = {"inputs": {"scene": sent.raise_for_status().json()["id"]}}
        asked = client.post("/processes/register-scene/execution", json=inputs)
        job: str = asked.raise_for_status().json()["jobID"]
        assert until(lambda: client.get(f"/jobs/{job}").json()["status"] == "successful")
    return job


def hold(page: Page, part: str) -> list[Route]:
    """Keep the next request for an address with some part unanswered; it is put here."""
    held: list[Route] = []
    page.route(lambda url: part in url, lambda route: held.append(route), times=1)
    return held


def until_held(page: Page, held: list[Route]) -> Route:
    """The request that is kept, once the page has sent it."""
    assert until(lambda: bool(page.wait_for_timeout(poll_ms) or held))
    return held[0]
