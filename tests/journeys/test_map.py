"""The map of the page: its land, its background, how points fared, and what blocks do on it."""

import io
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import psycopg
import pytest
from matplotlib.image import imread, imsave
from playwright.sync_api import Browser, Page, Route, expect

from amers.app.db.cluster.embedded import DATABASE
from tests.app.flat_world import FlatWorld
from tests.factories import make_block
from tests.journeys.map_page import ARTEFACTS, PHONE, WIDE, assert_readable, tab_to, until_drawn
from tests.service_process import Service, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

points_of_the_block = 40
enough_px = 50
visible = 0.1
"""Difference of a colour, of 1."""
poll_ms = 100
BEST_CLASS = np.array([0x0B, 0x4F, 0x5E])
UNTRIED = np.array([0x6B, 0x74, 0x78])
"""Colours of points in light, as in web/source/style.ts."""
BACKGROUND = np.array([200, 60, 200])
TILES = "https://tiles.example/{z}/{x}/{y}.png"
ATTRIBUTION = "Imagery: example <agency>"
MAKER_OF_TOWNS = "Towns: GeoNames, CC BY 4.0"
NEAR_AIX = "43.53, 5.45"
TOWNS = re.compile(r"/map/towns\.json$")
LAND = re.compile(r"/map/(land-\w+\.json)$")


def pixels_drawn(page: Page, colour: np.ndarray) -> int:
    """Pixels of the map in a colour."""
    page.wait_for_timeout(poll_ms)
    until_drawn(page)
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3]
    return int((np.abs(picture * 255 - colour) < 3).all(axis=2).sum())


def test_the_land_is_loaded_as_fine_as_the_scale_needs_it(visit, secret):
    """Coarse land with the page, the finest only where somebody looks closely."""
    page = visit("#/access", secret, WIDE)
    until_drawn(page)
    page.wait_for_timeout(poll_ms)
    loaded: list[str] = page.evaluate(
        "performance.getEntriesByType('resource').map(entry => entry.name)"
    )
    land = {match[1] for match in map(LAND.search, loaded) if match}
    assert "land-10m.json" not in land
    page.screenshot(path=ARTEFACTS / "map-world.png")
    field = page.get_by_label("Go to")
    with page.expect_response(lambda reply: reply.url.endswith("/map/land-10m.json")):
        field.fill("43.25, 5.25")
        field.press("Enter")
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "map-coast.png")


def test_towns_are_named_once_the_map_is_close(visit, secret):
    """Their names are what the map shows more than without the file of towns."""

    def near(page: Page) -> np.ndarray:
        field = page.get_by_label("Go to")
        field.fill(NEAR_AIX)
        field.press("Enter")
        page.wait_for_timeout(poll_ms)
        until_drawn(page)
        return imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3]

    nameless = visit("#/access", secret, WIDE)
    nothing = json.dumps({"type": "FeatureCollection", "features": []})
    nameless.route(TOWNS, lambda route: route.fulfill(body=nothing, content_type="application/json"))
    page = visit("#/access", secret, WIDE)
    until_drawn(page)
    expect(page.locator(".attribution")).to_have_count(0)
    names = np.abs(near(page) - near(nameless)).max(axis=2) > visible
    assert names.sum() > enough_px
    expect(page.locator(".attribution")).to_have_text(MAKER_OF_TOWNS)
    assert_readable(page, "map-towns")


def test_the_map_goes_to_a_town_by_its_name_without_accents(visit, secret):
    page = visit("#/access", secret, WIDE)
    tab_to(page, "Go to")
    page.keyboard.type("sao paulo")
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_have_text("The map shows São Paulo.")
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "map-town.png")


def test_points_are_coloured_by_how_they_fared_in_registrations(visit, secret, service):
    """Before any registration no point has been tried; then those that served are in the best class."""
    page = visit("#/points", secret, WIDE)
    expect(page.locator(".count")).to_have_text(f"{points_of_the_block} points")
    page.get_by_label("Points coloured by").select_option(label="health in registrations")
    classes = page.get_by_role("list", name="Colours of the points").get_by_role("listitem")
    expect(classes).to_have_text(
        [
            "0.95 or more",
            "0.75 to 0.95",
            "0.5 to 0.75",
            "less than 0.5: proposed for suspension",
            "not tried yet",
        ]
    )
    until_drawn(page)
    assert until(lambda: pixels_drawn(page, UNTRIED) >= enough_px)
    assert pixels_drawn(page, BEST_CLASS) < enough_px
    serve_in_a_scene(service, points_of_the_block - 5)
    page.reload()
    expect(page.locator(".count")).to_have_text(f"{points_of_the_block} points")
    page.get_by_label("Points coloured by").select_option(label="health in registrations")
    until_drawn(page)
    assert until(lambda: pixels_drawn(page, BEST_CLASS) >= enough_px)
    assert_readable(page, "points-by-health")


def serve_in_a_scene(service: Service, points: int) -> None:
    """Record a registration in which the first points of the first block served."""
    with psycopg.connect(service.cluster.dsn(DATABASE)) as store:
        store.execute(
            "insert into registration (id, block_versions, options, report, verdict, files, scene_key,"
            " counted) values (gen_random_uuid(), '[]', '{}', '{}', 'good', '{}', 'a scene', true)"
        )
        store.execute(
            "insert into point_history (point_id, attempts, successes, expected, matched)"
            " select id, 1, 1, 1, 1 from point order by id limit %s",
            [points],
        )


def test_a_view_without_points_says_where_points_are_and_every_view_has_a_title(visit, secret):
    page = visit("#/points", secret, WIDE)
    hint = page.get_by_text("Move the map to the outline of a block")
    expect(page.locator(".count")).to_have_text(f"{points_of_the_block} points")
    expect(hint).to_be_hidden()
    field = page.get_by_label("Go to")
    field.fill("-40, -20")
    field.press("Enter")
    expect(page.locator(".count")).to_have_text("0 points")
    expect(hint).to_be_visible()
    expect(page).to_have_title("Control points · Amers")
    hint.get_by_role("link", name="blocks").click()
    expect(page).to_have_title("Blocks · Amers")
    expect(page.locator("#panel h1")).to_be_focused()
    page.get_by_role("link", name="flat").click()
    expect(page).to_have_title("Test block flat · Amers")


def test_the_keyboard_keeps_its_place_in_the_list_of_points_when_the_map_moves(visit, secret):
    """The list is drawn again: the same point has the focus, or the first when it has left the view."""
    page = visit("#/points", secret, WIDE)
    listed = page.get_by_role("list", name="Points in view").get_by_role("link")
    expect(listed).to_have_count(points_of_the_block)
    until_drawn(page)
    focused = listed.nth(points_of_the_block // 2)
    name = focused.inner_text()
    focused.focus()
    turn_the_wheel(page, 200)
    expect(page.get_by_role("link", name=name, exact=True)).to_be_focused()
    while name in listed.all_inner_texts():
        turn_the_wheel(page, -100)
    expect(listed.first).to_be_focused()


def turn_the_wheel(page: Page, down: int) -> None:
    """Zoom by the wheel over the middle of the map, until the points in view are listed again."""
    page.locator(".list a").evaluate_all("links => links.forEach((link) => (link.className = 'before'))")
    box = page.locator("#map").bounding_box()
    assert box
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.wheel(0, down)
    expect(page.locator(".list a.before")).to_have_count(0)


def test_a_withdrawal_asks_first_and_the_keyboard_can_refuse_it(visit, administrator):
    page = visit("#/block/1", administrator, WIDE)
    state = page.locator(".badge")
    expect(state).to_have_text("published")
    tab_to(page, "Withdraw")
    page.keyboard.press("Enter")
    dialog = page.get_by_role("dialog", name="Withdraw flat@1?")
    expect(dialog).to_contain_text(f"no longer find its {points_of_the_block} points")
    assert_readable(page, "block-withdrawal")
    page.set_viewport_size(WIDE)
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(page.get_by_role("button", name="Withdraw")).to_be_focused()
    expect(state).to_have_text("published")
    page.keyboard.press("Enter")
    dialog.get_by_role("button", name="Withdraw the block").click()
    expect(state).to_have_text("withdrawn")
    page.get_by_role("button", name="Publish").click()
    expect(state).to_have_text("published")


def test_a_new_block_is_drawn_as_soon_as_it_is_ingested(visit, administrator, tmp_path):
    """The map leaves the blocks that it has shown and moves to the new one, without another click."""
    made = make_block(tmp_path / "block", name="elsewhere")
    archive = Path(shutil.make_archive(str(tmp_path / "elsewhere"), "zip", made.folder))
    page = visit("#/blocks", administrator, WIDE)
    page.get_by_text("Add a block").click()
    page.get_by_label("Block").first.set_input_files(archive)
    with page.expect_response(
        lambda reply: reply.url.endswith("collections/blocks/items?limit=1000")
    ) as drawn:
        page.get_by_role("button", name="Upload and ingest").click()
        expect(page.get_by_role("link", name="See the block")).to_be_visible()
    names = [one["properties"]["id"] for one in drawn.value.json()["features"]]
    assert "elsewhere" in names
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "block-ingested.png")


@pytest.fixture(scope="module")
def with_background(service: Service, world: FlatWorld) -> Iterator[Service]:
    """A second service on the same store, whose operator has chosen a background."""
    settings = {
        "AMERS_MAP_BACKGROUND": TILES,
        "AMERS_MAP_BACKGROUND_ATTRIBUTION": ATTRIBUTION,
        "AMERS_PUBLIC_POINTS": "true",
    }
    with Service(service.folder, "--no-worker", **settings) as second:
        yield second


def test_the_background_of_the_operator_is_drawn_with_who_made_it(
    browser: Browser, with_background: Service
):
    """The policy of the page lets tiles of that site in, and those of no other site."""
    picture = io.BytesIO()
    imsave(picture, np.broadcast_to(BACKGROUND.astype(np.uint8), (256, 256, 3)), format="png")
    elsewhere: list[str] = []
    errors: list[str] = []

    def answer(route: Route) -> None:
        elsewhere.append(route.request.url)
        allowed = {"Access-Control-Allow-Origin": "*"}
        route.fulfill(body=picture.getvalue(), content_type="image/png", headers=allowed)

    with browser.new_context(viewport=WIDE, reduced_motion="reduce") as context:
        context.route(re.compile("^https://"), answer)
        page = context.new_page()
        page.on("console", lambda one: errors.append(one.text) if one.type == "error" else None)
        page.goto(f"{with_background.url}/map")
        expect(page.get_by_text(ATTRIBUTION)).to_be_visible()
        assert until(lambda: pixels_drawn(page, BACKGROUND) >= enough_px)
        assert errors == []
        assert elsewhere
        assert all(re.fullmatch(r"https://tiles\.example/\d+/\d+/\d+\.png", url) for url in elsewhere)
        assert_readable(page, "map-background")
        other = json.dumps("https://other.example/0/0/0.png")
        assert page.evaluate(f"fetch({other}).then(() => 'let in', () => 'kept out')") == "kept out"
        page.set_viewport_size(PHONE)
        expect(page.get_by_text(ATTRIBUTION)).to_be_in_viewport()


def test_without_a_setting_there_is_no_background(visit, secret, service):
    page = visit("#/points", secret, WIDE)
    until_drawn(page)
    expect(page.locator(".attribution")).to_have_text(MAKER_OF_TOWNS)
    assert httpx.get(f"{service.url}/map/background.json").json() == {"tiles": None, "attribution": None}


def test_the_map_names_who_made_the_data_of_the_published_blocks_in_view(
    visit, secret, amers, tmp_path: Path
) -> None:
    made = make_block(tmp_path / "open", name="open", box=(7.0, 44.0, 7.1, 44.1))
    file = made.folder / "block.json"
    document = json.loads(file.read_text())
    document["amers:provenance"]["options"]["attribution"] = ATTRIBUTION
    file.write_text(json.dumps(document))
    number = amers("block", "ingest", made.folder)["block"]["number"]
    staged = visit("#/points", secret, WIDE)
    until_drawn(staged)
    expect(staged.get_by_text(ATTRIBUTION)).to_have_count(0)
    amers("block", "publish", str(number))
    page = visit("#/points", secret, WIDE)
    for place, count in (("44.05, 7.05", 1), ("-33.0, 151.0", 0)):
        field = page.get_by_label("Go to")
        field.fill(place)
        field.press("Enter")
        until_drawn(page)
        expect(page.locator(".attribution").get_by_text(ATTRIBUTION)).to_have_count(count)
    field.fill("44.05, 7.05")
    field.press("Enter")
    until_drawn(page)
    expect(page.locator(".attribution")).to_contain_text(f"{ATTRIBUTION} · {MAKER_OF_TOWNS}")
    assert_readable(page, "map-block-makers")
    page = visit(f"#/block/{number}", secret, WIDE)
    expect(page.locator(".facts").get_by_text(ATTRIBUTION)).to_be_visible()
