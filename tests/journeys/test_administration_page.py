"""The administration on the map page: tasks of administrators, by pointer and by keyboard."""

from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from playwright.sync_api import Locator, Page, expect

from amers.app.db import engine
from amers.app.db.cluster.embedded import DATABASE
from tests.factories import make_block
from tests.journeys.map_page import ARTEFACTS, PHONE, WIDE, assert_readable, hold, tab_to, until_held
from tests.service_process import Service
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

PARTS = {
    "status": "Queue and storage",
    "tokens": "Tokens",
    "references": "References",
    "suspensions": "Suspensions",
    "audit": "Audit trail",
}
points_of_the_block = 40
page_of_changes = 50
"""As in web/source/audit.ts."""


@pytest.fixture(scope="module")
def api(service: Service, administrator: str):
    """A client of the service with the token of the administrator."""
    headers = {"Authorization": f"Bearer {administrator}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        yield client


def served(api: httpx.Client) -> int:
    """The number of points that are served."""
    reply = api.get("/collections/points/items").raise_for_status()
    return int(reply.json()["numberMatched"])


def row(page: Page, text: str) -> Locator:
    return page.get_by_role("listitem").filter(has_text=text)


def test_only_administrators_see_the_administration(visit, secret, administrator):
    page = visit("#/admin/tokens", secret)
    expect(page.locator("#panel")).to_contain_text("with a token of scope admin")
    expect(page.get_by_role("link", name="Admin", exact=True)).to_be_hidden()
    page = visit("#/points", administrator)
    page.get_by_role("link", name="Admin", exact=True).click()
    expect(page.locator("#panel h1")).to_have_text("Queue and storage")


def test_a_token_is_made_used_and_revoked_with_the_keyboard_alone(visit, administrator, service):
    page = visit("#/admin/tokens", administrator, WIDE)
    tab_to(page, "Create a token")
    page.keyboard.press("Enter")
    tab_to(page, "Name")
    page.keyboard.type("harbour office")
    tab_to(page, " register")
    page.keyboard.press("Space")
    tab_to(page, "Days")
    page.keyboard.type("30")
    tab_to(page, "Create")
    page.keyboard.press("Enter")
    made = page.get_by_label("Secret")
    expect(made).to_be_focused()
    page.screenshot(path=ARTEFACTS / "admin-token-made.png")
    headers = {"Authorization": f"Bearer {made.input_value()}"}
    own = httpx.get(f"{service.url}/tokens/self", headers=headers, timeout=30.0).json()
    assert (own["name"], own["scopes"]) == ("harbour office", ["read", "register"])

    tab_to(page, "Revoke")
    while "harbour office" not in (page.locator(":focus").get_attribute("aria-label") or ""):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name="Revoke harbour office?")
    expect(dialog).to_be_visible()
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(page.get_by_role("button", name="Revoke harbour office")).to_be_focused()
    page.keyboard.press("Enter")
    expect(dialog.get_by_role("button", name="Revoke")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_have_text("harbour office is revoked.")
    expect(page.locator("#panel h1")).to_be_focused()
    expect(made).to_have_count(0)
    refused = httpx.get(f"{service.url}/tokens/self", headers=headers, timeout=30.0)
    assert refused.status_code == 401
    page.get_by_text("Revoked or expired").click()
    ended = page.get_by_role("list", name="Revoked or expired tokens")
    expect(ended).to_contain_text("harbour office")


def test_a_token_that_cannot_be_made_is_refused_with_a_sentence(visit, administrator):
    page = visit("#/admin/tokens", administrator, refused=409)
    page.get_by_text("Create a token").click()
    page.get_by_label("Name").fill("Ada")
    page.get_by_role("button", name="Create", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("is named 'Ada' already")


def test_a_reference_is_added_and_removed(visit, administrator, service, api):
    folder = Path(service.environment["AMERS_REFERENCE_FOLDER"])
    grid = rasterio.transform.from_origin(5.4, 43.3, 1e-5, 1e-5)
    profile = {"driver": "GTiff", "width": 200, "height": 200, "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / "city.tif", "w", **profile, crs="EPSG:4326", transform=grid) as file:
        file.write(np.random.default_rng(3).integers(1, 255, (1, 200, 200), dtype=np.uint8))
    page = visit("#/admin/references", administrator, refused=422)
    expect(page.get_by_text("No references yet.")).to_be_visible()
    page.get_by_text("Add a reference").click()
    page.get_by_label("Name").fill("city")
    page.get_by_label("Ortho-image path").fill("town.tif")
    add = page.get_by_role("button", name="Add", exact=True)
    add.click()
    expect(page.get_by_role("alert")).to_contain_text("town.tif")
    page.get_by_label("Ortho-image path").fill("city.tif")
    page.get_by_label("Accuracy of the image").fill("0.5")
    add.click()
    expect(row(page, "city.tif")).to_contain_text("accuracy 0.5 m horizontal")
    expect(page.get_by_role("alert")).to_have_count(0)
    assert_readable(page, "admin-references")
    page.get_by_role("button", name="Remove city").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove").click()
    expect(page.get_by_text("No references yet.")).to_be_visible()
    assert api.get("/references").json() == {"references": []}


@pytest.fixture
def doubtful(service: Service, api: httpx.Client) -> int:
    """The id of a point that failed in twelve scenes where others served."""
    [point] = api.get("/collections/points/items?limit=1").json()["features"]
    with engine.connect(service.cluster.dsn(DATABASE)) as connection:
        sums = (
            "insert into point_history (point_id, attempts, successes, expected) values (%s, 12, 1, 11)"
        )
        run_sql(connection, sums, [point["id"]])
    return int(point["id"])


def test_a_proposed_point_is_suspended_with_a_reason_and_reinstated(visit, administrator, api, doubtful):
    page = visit("#/admin/suspensions", administrator)
    proposed = page.get_by_role("list", name="Proposed points")
    expect(proposed).to_contain_text("succeeded in 1 of 12 scenes, 11 expected")
    page.get_by_role("button", name=f"Suspend point {doubtful}").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_label("Reason")).to_have_value("succeeds in 1 of 12 scenes, 11 expected")
    assert_readable(page, "admin-suspend")
    dialog.get_by_role("button", name="Cancel").click()
    assert served(api) == points_of_the_block
    page.get_by_role("button", name=f"Suspend point {doubtful}").click()
    dialog.get_by_label("Reason").fill("a new building")
    dialog.get_by_role("button", name="Suspend").click()
    suspended = page.get_by_role("list", name="Suspended points")
    expect(suspended).to_contain_text("a new building")
    expect(proposed).to_have_count(0)
    assert served(api) == points_of_the_block - 1
    page.get_by_role("button", name=f"Reinstate point {doubtful}").click()
    dialog.get_by_role("button", name="Reinstate").click()
    expect(suspended).to_have_count(0)
    assert served(api) == points_of_the_block


def make_changes(api: httpx.Client, name: str, headers: dict[str, str] | None = None) -> None:
    """Make as many tokens as the page lists changes at once."""
    for number in range(page_of_changes):
        body = {"name": f"{name} {number}", "scopes": ["read"]}
        api.post("/tokens", json=body, headers=headers).raise_for_status()


def test_the_audit_trail_is_read_page_by_page_and_filtered(visit, administrator, api):
    body = {"name": "Bob", "scopes": ["admin"]}
    bob = {"Authorization": f"Bearer {api.post('/tokens', json=body).json()['secret']}"}
    make_changes(api, "program", bob)
    api.delete("/tokens/program 7", headers=bob).raise_for_status()
    page = visit("#/admin/audit", administrator)
    changes = page.get_by_role("list", name="Changes").get_by_role("listitem")
    expect(changes).to_have_count(page_of_changes)
    expect(changes.first).to_contain_text("revoked_at:")
    expect(changes.first).to_contain_text("Bob")

    page.get_by_label("Who").fill("Bob")
    page.get_by_label("What").select_option("token")
    page.get_by_role("button", name="Show").click()
    older = page.get_by_role("button", name="Older changes")
    expect(older).to_be_visible()
    older.focus()
    page.keyboard.press("Enter")
    expect(changes).to_have_count(page_of_changes + 1)
    expect(page.get_by_text("These are all changes.")).to_be_focused()
    expect(changes.last).to_contain_text("program 0")

    page.get_by_label("Who").fill("")
    page.get_by_label("What").select_option("block")
    page.get_by_label("Which").fill("flat@1")
    page.get_by_role("button", name="Show").click()
    expect(changes.first).to_contain_text("state: staged → published")
    expect(older).to_be_hidden()
    page.get_by_label("Which").fill("nothing")
    page.get_by_role("button", name="Show").click()
    expect(page.get_by_text("No changes.")).to_be_visible()


def test_a_page_of_an_earlier_list_that_arrives_late_is_not_added(visit, administrator, api):
    make_changes(api, "reader")
    page = visit("#/admin/audit", administrator)
    changes = page.get_by_role("list", name="Changes").get_by_role("listitem")
    older = page.get_by_role("button", name="Older changes")
    expect(changes).to_have_count(page_of_changes)

    late = hold(page, "/audit?limit=50&before=")
    older.click()
    page.get_by_label("Which").fill("flat@1")
    page.get_by_role("button", name="Show").click()
    expect(page.get_by_text("These are all changes.")).to_be_visible()
    of_the_block = changes.count()
    with page.expect_response(lambda reply: "before=" in reply.url):
        late[0].continue_()
    page.wait_for_load_state("networkidle")
    expect(changes).to_have_count(of_the_block)
    expect(older).to_be_hidden()


def test_an_older_page_is_asked_for_once_and_again_when_it_failed(visit, administrator, api):
    make_changes(api, "client")
    page = visit("#/admin/audit", administrator, refused=503)
    changes = page.get_by_role("list", name="Changes").get_by_role("listitem")
    expect(changes).to_have_count(page_of_changes)
    held = hold(page, "/audit?limit=50&before=")
    older = page.get_by_role("button", name="Older changes")
    older.dblclick()
    until_held(page, held).fulfill(status=503, json={"detail": "The database is away."})
    expect(page.get_by_text("The database is away.")).to_be_visible()
    expect(changes).to_have_count(page_of_changes)
    older.click()
    expect(changes.nth(page_of_changes)).to_be_visible()
    shown = changes.all_inner_texts()
    assert len(set(shown)) == len(shown)


def test_the_status_names_workers_storage_and_owners(visit, administrator, api):
    status = api.get("/status").json()
    page = visit("#/admin/status", administrator)
    figures = page.locator("dl.facts")
    expect(figures.first).to_contain_text("Workers alive1")
    expect(figures.last).to_contain_text(f"Points served{status['points_served']}")
    page.get_by_role("button", name="Refresh").click()
    expect(page.locator("#status")).to_have_text("The figures are new.")
    expect(page.locator("#panel h1")).to_be_focused()


@pytest.fixture
def withdrawn(service: Service, amers, tmp_path: Path) -> str:
    """A block of the service that was published and withdrawn."""
    made = make_block(tmp_path / "block", name="old", count=7)
    amers("block", "ingest", made.folder, "--publish")
    amers("block", "withdraw", "old@1")
    return "old@1"


def test_a_withdrawn_block_is_deleted_once_its_name_is_typed(visit, administrator, api, withdrawn):
    page = visit("#/blocks", administrator)
    row(page, withdrawn).get_by_role("link").click()
    page.get_by_role("button", name="Delete").click()
    dialog = page.get_by_role("dialog", name=f"Delete {withdrawn}?")
    delete = dialog.get_by_role("button", name="Delete")
    name = dialog.get_by_label("To confirm")
    expect(name).to_be_focused()
    for wrong in ("", "old", "old@2"):
        name.fill(wrong)
        expect(delete).to_be_disabled()
        page.keyboard.press("Enter")
        expect(dialog).to_be_visible()
    assert_readable(page, "admin-delete-block")
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="Delete")).to_be_focused()
    page.keyboard.press("Enter")
    page.keyboard.type(withdrawn)
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_have_text(f"{withdrawn} is deleted.")
    expect(page.locator("#panel h1")).to_have_text("Blocks")
    expect(row(page, withdrawn)).to_have_count(0)
    blocks = api.get("/collections/blocks/items").json()["features"]
    assert [block["properties"]["id"] for block in blocks] == ["flat"]


def test_a_published_block_has_no_button_to_delete_it(visit, administrator):
    page = visit("#/block/1", administrator)
    expect(page.get_by_role("button", name="Withdraw")).to_be_visible()
    expect(page.get_by_role("button", name="Delete")).to_have_count(0)


def test_every_part_fits_a_phone_and_is_accessible(visit, administrator, doubtful):
    page = visit("#/admin/audit", administrator, PHONE)
    for part, title in PARTS.items():
        page.get_by_role("navigation", name="Administration").get_by_role("link", name=title).click()
        expect(page.locator("#panel h1")).to_have_text(title)
        expect(page.locator("#panel h1")).to_be_focused()
        for closed in page.locator("details > summary").all():
            closed.click()
        assert_readable(page, f"admin-{part}")


def test_the_pages_of_the_api_have_an_icon_and_ask_for_nothing_that_is_missing(browser, service, world):
    """A browser asks for `/favicon.ico` where a page names no icon."""
    with browser.new_context() as context:
        page = context.new_page()
        statuses: dict[str, int] = {}
        page.on("response", lambda reply: statuses.update({reply.url: reply.status}))
        for path in ("/", "/sign-in", "/connect"):
            page.goto(f"{service.url}{path}")
            icon = page.locator("link[rel=icon]").get_attribute("href")
            assert icon is not None
            loaded = """address => new Promise(resolve => {
                const image = new Image();
                image.onload = () => resolve(true);
                image.onerror = () => resolve(false);
                image.src = address;
            })"""
            assert page.evaluate(loaded, icon), path
        assert set(statuses.values()) == {200}, statuses
