"""Lists of the map page that are longer than a page of the service."""

import httpx
import pytest
from playwright.sync_api import Page, Route, expect

from tests.journeys.conftest import Visit
from tests.journeys.map_page import ARTEFACTS, assert_readable
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

HEAD_OF_A_TIFF = b"II*\0" + bytes(100)
scenes_of_a_page = 3


@pytest.fixture(scope="module")
def seven_scenes(service: Service, secret: str) -> None:
    headers = {"Authorization": f"Bearer {secret}"}
    for number in range(7):
        sent = httpx.post(
            f"{service.url}/scenes?name=IMG_{number}.tif", headers=headers, content=HEAD_OF_A_TIFF
        )
        sent.raise_for_status()


def in_short_pages(page: Page, path: str) -> None:
    """Let the service answer a list with short pages, as it does where the list is long."""

    def shortened(route: Route) -> None:
        route.continue_(url=f"{route.request.url.split('?')[0]}?limit={scenes_of_a_page}")

    page.route(lambda url: f"/{path}?limit=500" in url, shortened)


def test_the_list_of_scenes_loads_older_ones_until_the_last(
    visit: Visit, service: Service, secret: str, seven_scenes: None
) -> None:
    page = visit("", secret)
    in_short_pages(page, "scenes")
    page.goto(f"{service.url}/map#/scenes")
    rows = page.get_by_role("list", name="List of scenes").get_by_role("listitem")
    older = page.get_by_role("button", name="Load older scenes")
    expect(rows).to_have_count(3)
    page.screenshot(path=ARTEFACTS / "long-list.png", full_page=True)
    older.click()
    expect(rows).to_have_count(6)
    expect(page.get_by_text("6 scenes, the newest of all")).to_be_visible()
    page.get_by_label("Filter scenes").fill("IMG_0")
    expect(page.get_by_text("No scene has these words")).to_be_visible()
    older.click()
    expect(rows).to_have_count(1)
    expect(older).to_be_hidden()
    page.get_by_label("Filter scenes").fill("")
    expect(rows).to_have_count(7)
    assert_readable(page, "long-list")


def test_a_page_that_does_not_arrive_can_be_asked_for_again(
    visit: Visit, service: Service, secret: str, seven_scenes: None
) -> None:
    page = visit("", secret, refused=503)
    in_short_pages(page, "scenes")
    page.goto(f"{service.url}/map#/scenes")
    older = page.get_by_role("button", name="Load older scenes")
    expect(older).to_be_visible()
    busy = {"status": 503, "body": '{"detail": "The service is busy."}'}
    page.route(lambda url: "after=" in url, lambda route: route.fulfill(**busy), times=1)
    older.click()
    expect(page.get_by_text("The service is busy.")).to_be_visible()
    older.click()
    expect(page.get_by_text("The service is busy.")).to_be_hidden()
    rows = page.get_by_role("list", name="List of scenes").get_by_role("listitem")
    expect(rows).to_have_count(6)
