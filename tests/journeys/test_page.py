"""The map page in a real browser: tasks of users, and requests only to the service."""

import io
import json
import os
import shutil
import signal
from pathlib import Path

import httpx
import numpy as np
import pytest
import shapely
from matplotlib.image import imread
from playwright.sync_api import Locator, Page, Request, Route, expect

from amers.services.geodesy import metres_per_degree
from tests.app.flat_world import CENTRE, GROUND_H, GSD_M
from tests.factories import make_block
from tests.journeys.map_page import (
    ARTEFACTS,
    AXE,
    DESKTOP,
    PHONE,
    WIDE,
    assert_readable,
    poll_ms,
    registered,
    tab_to,
    until_drawn,
)
from tests.service_process import Service, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

chip_px = 101
piece_bytes = 8 * 1024 * 1024
"""Size of a piece of an upload in web/source/upload.ts."""
points_of_the_block = 40
vector_colour = np.array([0xB3, 0x26, 0x1E])
class_colours = np.array(
    [[0x0B, 0x4F, 0x5E], [0x2F, 0x8F, 0xB0], [0xC0, 0x7A, 0x00], [0xA3, 0x19, 0x5B]]
)
"""Of points in light, from the best class to the worst, as in web/source/style.ts."""
enough_px = 50
a_third_of_a_pixel_m = GSD_M / 3.0
a_hundredth_px = 0.01
a_scene_deg = 0.005
a_visible_difference = 5.0
as_good_as_equal = 1.0
"""Mean differences of grey values from 0 to 255."""


def pixels_drawn(page: Page, colour: np.ndarray) -> int:
    """Pixels of the map in a colour."""
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))[:, :, :3]
    return int((np.abs(picture * 255 - colour) < 2).all(axis=2).sum())


def vectors_drawn_px(page: Page) -> int:
    """Pixels of the map in the colour of the residuals."""
    return pixels_drawn(page, vector_colour)


def test_a_scene_goes_from_upload_to_report_with_the_keyboard_alone(visit, world, secret, service):
    page = visit()
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    look(page, "journey-1-sign-in")
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
    look(page, "journey-2-scene")
    tab_to(page, "Upload and register")
    page.keyboard.press("Enter")

    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    report = report_of(page, service, secret)
    figures = page.locator("dl.facts").last.inner_text()
    assert_accuracy_shown(page, report)
    expect(page.get_by_text(f"Verdict: {report['verdict']}, {report['verdict_scope']}")).to_be_visible()
    found = report["point_counts"]
    assert f"{found['visible']}, {found['matched']}, {found['active']}" in figures
    assert page.locator(".badge").first.inner_text() == report["verdict"]
    names = {one["name"] for one in report["criteria"]}
    assert page.locator("tbody tr").count() == len(names)
    share = report["coverage"]["percent"]
    expect(page.get_by_text("Accuracy is stated for the shaded part")).to_contain_text(f"{share:.2g}")
    assert until(lambda: vectors_drawn_px(page) >= enough_px)
    until_drawn(page)
    look(page, "journey-3-registered")

    tab_to(page, "Open the report")
    with page.context.expect_page() as opened:
        page.keyboard.press("Enter")
    opened.value.wait_for_load_state()
    expect(opened.value.locator("body")).to_contain_text(report["verdict"])
    look(opened.value, "journey-4-report")


def look(page: Page, step: str) -> None:
    """Check a step of the journey at both widths, light and dark, and keep its pictures; then go on."""
    page.evaluate("window.focused = document.activeElement")
    assert_readable(page, step)
    assert page.evaluate("document.activeElement === window.focused"), "the focus stays where it was"
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(DESKTOP)


def assert_accuracy_shown(page: Page, document: dict) -> None:
    """Check that the first facts of a page are the two accuracies of a document, in their order."""
    stated = [document["relative_to_control_points"], document["on_the_earth"]]
    shown = page.locator("dl.facts").first
    assert shown.locator("dt").all_inner_texts() == [one["label"] for one in stated]
    assert shown.locator("dd").all_inner_texts() == [one["words"] for one in stated]


def test_what_is_drawn_on_the_raw_image_appears_on_the_map_and_returns(
    visit, world, secret, service, ground, tmp_path
):
    """Registration, drawing with keys and pointer, the accuracy of each shape, and the way back."""
    page = visit(f"#/job/{registered(service, secret, world)}", secret)
    page.get_by_role("link", name="Draw on the image").click()
    image = page.get_by_role("application")
    expect(image).to_have_attribute("aria-busy", "false")
    page.screenshot(path=ARTEFACTS / "draw-empty.png")

    image.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Space")
    page.get_by_role("button", name="Polygon").click()
    box = image.bounding_box()
    corners = [(0.45, 0.3), (0.55, 0.35), (0.52, 0.6)]
    for x, y in corners:
        image.click(position={"x": x * box["width"], "y": y * box["height"]})
    page.screenshot(path=ARTEFACTS / "draw-begun.png")
    page.keyboard.press("Enter")
    drawn = page.get_by_role("list", name="Drawn").get_by_role("listitem")
    expect(drawn).to_have_count(2)
    page.get_by_label("Another terrain").set_input_files(ground)
    page.get_by_label("Vertical datum").fill("ellipsoid")
    page.get_by_role("button", name="Show on the map").click()
    expect(drawn.first).to_contain_text("CE90")
    assert until(lambda: vectors_drawn_px(page) >= enough_px)
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "draw-on-the-map.png")

    pixels, on_map = (read_download(page, name) for name in ("drawn.geojson", "on_the_map.geojson"))
    for in_image, there in zip(pixels["features"], on_map["features"], strict=True):
        corner = coordinates(in_image)
        truth = world.true_model.locate(corner[:, ::-1] - 0.5, np.full(len(corner), GROUND_H))
        east, north = metres_per_degree(CENTRE[1], GROUND_H)
        off_m = (coordinates(there)[:, :2] - truth[:, :2]) * [east, north]
        assert np.hypot(*off_m.T).max() < 2.0 * there["properties"]["ce90_m"]
        assert np.hypot(*off_m.T).max() < a_third_of_a_pixel_m

    map_file = tmp_path / "on_the_map.geojson"
    map_file.write_text(json.dumps(on_map), encoding="utf-8")
    page.get_by_label("GeoJSON").set_input_files(map_file)
    page.get_by_role("button", name="Show in the image").click()
    expect(page.get_by_text("2 features in the image; 0 outside, 0 with hidden")).to_be_visible()
    page.screenshot(path=ARTEFACTS / "draw-in-the-image.png")
    back = read_download(page, "in_the_image.geojson")
    for in_image, there in zip(pixels["features"], back["features"], strict=True):
        np.testing.assert_allclose(coordinates(there)[:, :2], coordinates(in_image), atol=a_hundredth_px)

    page.reload()
    expect(drawn).to_have_count(2)
    page.evaluate(AXE.read_text(encoding="utf-8"))
    findings = page.evaluate("axe.run().then((found) => found.violations)")
    assert [(found["id"], found["nodes"][0]["html"]) for found in findings] == []
    page.set_viewport_size(PHONE)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.screenshot(path=ARTEFACTS / "draw-phone.png")


def test_an_image_is_compared_on_the_map_before_and_after_its_registration(
    visit, world, secret, service
):
    """Either model, or both beside a divider that keys move; residual vectors stay on top."""
    page = visit(f"#/job/{registered(service, secret, world, 'on-the-map.tif')}", secret, WIDE)
    tab_to(page, "Show the image on the map")
    page.keyboard.press("Enter")
    section = page.get_by_role("region", name="Image on the map")
    expect(section.get_by_label("Both, with a divider")).to_be_focused()
    expect(section).to_contain_text("The registration moved the middle of the image by 8.3")
    expect(section).to_contain_text("CE90")
    expect(section).to_contain_text("interpolated between")
    assert until(lambda: vectors_drawn_px(page) >= enough_px)
    assert_readable(page, "image-on-map")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")

    both = grey_map(page)
    raw, after = (shown_alone(page, section, name) for name in ("Raw", "Registered"))
    assert np.abs(raw - after).mean() > a_visible_difference
    left, right = np.s_[120:-120, 100:500], np.s_[120:-120, -500:-100]
    assert np.abs(both[left] - raw[left]).mean() < as_good_as_equal
    assert np.abs(both[right] - after[right]).mean() < as_good_as_equal

    section.get_by_label("Both, with a divider").check()
    divider = page.get_by_role("slider", name="Divider")
    divider.focus()
    page.keyboard.press("Home")
    assert np.abs(grey_map(page)[left] - after[left]).mean() < as_good_as_equal
    page.keyboard.press("End")
    assert np.abs(grey_map(page)[right] - raw[right]).mean() < as_good_as_equal
    page.screenshot(path=ARTEFACTS / "image-on-map-end.png")

    box = page.locator("#map").bounding_box()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
    lat, _, lon, _ = page.locator(".pointer").inner_text().replace("°", "").split()
    assert np.hypot(*(np.array([float(lon), float(lat)]) - CENTRE)) < a_scene_deg
    page.screenshot(path=ARTEFACTS / "image-on-map-pointer.png")

    section.get_by_label("Opacity").fill("0")
    blank = grey_map(page)
    assert np.abs(blank[right] - raw[right]).mean() > a_visible_difference
    page.goto(f"{service.url}/map#/scenes")
    expect(divider).to_have_count(0)


def shown_alone(page: Page, section: Locator, name: str) -> np.ndarray:
    """The map with the image through one of its models."""
    section.get_by_label(name, exact=True).check()
    return grey_map(page)


def grey_map(page: Page) -> np.ndarray:
    """What the map shows, as grey values from 0 to 255."""
    page.wait_for_timeout(poll_ms)
    until_drawn(page)
    picture = imread(io.BytesIO(page.locator("#map").screenshot()))
    return picture[:, :, :3].mean(axis=2) * 255.0


def test_a_scene_tells_its_state_and_is_registered_again_with_other_options(
    visit, world, secret, service, tmp_path
):
    lon, lat, h = world.true_model.locate(np.array([[600.0, 600.0]]), np.array([GROUND_H]))[0].tolist()
    marks = tmp_path / "marks.csv"
    head = "# pixel-origin=centre heights=ellipsoid\nid,lon,lat,height_m,line,sample\n"
    marks.write_text(f"{head}GCP,{lon!r},{lat!r},{h!r},600,600\n")
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        new = client.post("/scenes?name=new.tif", content=world.tagged.read_bytes()).json()["id"]
        job = registered(service, secret, world, "again.tif")
        made = client.get(f"/jobs/{job}").json()
        page = visit("#/scenes", secret)
        rows = page.get_by_role("listitem").filter(has_text="again.tif")
        figures = f"CE90 {made['amers:relative_to_control_points']['ce90_m']:.2g}"
        for row, state in ((rows.first, "successful"), (rows.last, "registered")):
            expect(row).to_contain_text(state)
            expect(row).to_contain_text(f"verdict {made['amers:verdict']}")
            expect(row).to_contain_text(figures)
            expect(row).to_contain_text("on the Earth")
        expect(page.get_by_role("listitem").filter(has_text="new.tif")).to_contain_text(
            "not registered yet"
        )
        assert_readable(page, "scenes")
        rows.last.get_by_role("link").click()
        expect(page.get_by_role("link", name="See the results")).to_have_attribute(
            "href", f"#/job/{job}"
        )
        assert_readable(page, "scene")
        page.get_by_text("Register again").first.click()
        page.get_by_label("Accuracy of the model").fill("20")
        page.get_by_label("Correction").select_option("drift")
        page.get_by_label("Registered on").select_option("points")
        page.get_by_text("Bands, mask, check points").click()
        page.get_by_label("Bands", exact=False).first.fill("1")
        assert_readable(page, "scene-form")
        page.get_by_role("button", name="Register again").click()
        expect(page.get_by_role("link", name="Open the report")).to_be_visible()
        again = client.get(f"/jobs/{page.url.rsplit('/', 1)[1]}").json()
        inputs = again["inputs"]
        assert (inputs["sigma_m"], inputs["method"], inputs["bands"]) == (20, "points", "1")
        assert inputs["options"]["adjustment"]["order"] == "drift"
        report = report_of(page, service, secret)
        assert report["correction"]["order"] == "drift"
        page.goto(f"{service.url}/map#/scene/{new}")
        expect(page.get_by_role("button", name="Register", exact=True)).to_be_visible()
        page.locator("#marks").set_input_files(marks)
        page.get_by_label("Registered on").select_option("marks")
        page.get_by_role("button", name="Register", exact=True).click()
        expect(page.get_by_role("link", name="Open the report")).to_be_visible()
        assert [mark["name"] for mark in report_of(page, service, secret)["marks"]["marks"]] == ["GCP"]
        page.goto(f"{service.url}/map#/scene/{inputs['scene']}")
        expect(page.locator(".story li")).to_have_count(2)


def read_download(page: Page, name: str) -> dict:
    """The content of a file that the page offers."""
    with page.expect_download() as download:
        page.locator(f'a[download="{name}"]').click()
    return dict(json.loads(download.value.path().read_text(encoding="utf-8")))


def coordinates(feature: dict) -> np.ndarray:
    return shapely.get_coordinates(shapely.geometry.shape(feature["geometry"]))


def test_an_upload_resumes_where_it_stopped_when_the_page_is_opened_again(
    visit, world, secret, tmp_path
):
    """The connection stalls after the first piece; the user reloads the page and sends it again."""
    image = tmp_path / "large.tif"
    image.write_bytes(world.tagged.read_bytes().ljust(piece_bytes + piece_bytes // 2, b"\0"))
    page = visit("#/scenes", secret)
    pieces: list[Request] = []
    begun: list[Request] = []

    def note(request: Request) -> None:
        (pieces if request.method == "PATCH" else begun if request.method == "POST" else []).append(
            request
        )

    def hang(route: Route) -> None:
        if route.request.headers.get("upload-offset", "0") == "0":
            route.continue_()

    page.on("request", note)
    page.route("**/uploads/*", hang)
    upload(page, "Image", image)
    assert until(lambda: page.wait_for_timeout(poll_ms) or len(pieces) == 2)
    assert pieces[1].headers["upload-offset"] == str(piece_bytes)
    page.screenshot(path=ARTEFACTS / "upload-hangs.png")

    page.reload()
    page.unroute("**/uploads/*")
    pieces.clear()
    begun.clear()
    upload(page, "Image", image)
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    assert [piece.headers["upload-offset"] for piece in pieces] == [str(piece_bytes)]
    assert [request.url for request in begun if request.url.endswith("/uploads")] == []


def upload(page: Page, label: str, file: Path) -> None:
    """Choose a file in the form and submit it."""
    page.get_by_label(label).first.set_input_files(file)
    page.locator("form button[type=submit]").click()


def test_a_waiting_job_shows_its_place_in_the_queue(visit, world, secret, service):
    """The worker is stopped, so that the job has to wait."""
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        sent = client.post("/scenes?name=waits.tif", content=world.tagged.read_bytes())
        inputs = {"inputs": {"scene": sent.raise_for_status().json()["id"]}}
        workers = service.workers()
        for worker in workers:
            os.kill(worker, signal.SIGSTOP)
        try:
            asked = client.post("/processes/register-scene/execution", json=inputs)
            page = visit(f"#/job/{asked.raise_for_status().json()['jobID']}", secret)
            expect(page.get_by_text("number 1 in the queue")).to_be_visible()
            page.screenshot(path=ARTEFACTS / "queue.png")
        finally:
            for worker in workers:
                os.kill(worker, signal.SIGCONT)
        expect(page.get_by_role("link", name="Open the report")).to_be_visible()


def test_an_administrator_uploads_a_block_which_is_ingested_and_staged(
    visit, administrator, secret, tmp_path
):
    made = make_block(tmp_path / "block", name="uploaded")
    archive = Path(shutil.make_archive(str(tmp_path / "uploaded"), "zip", made.folder))
    assert visit("#/blocks", secret).get_by_text("Add a block").count() == 0

    page = visit("#/blocks", administrator)
    page.get_by_text("Add a block").click()
    page.screenshot(path=ARTEFACTS / "block-upload.png")
    upload(page, "Block", archive)
    expect(page.locator(".badge")).to_have_text("successful")
    expect(page.locator("header a[aria-current=page]")).to_have_text(["Blocks"])
    page.screenshot(path=ARTEFACTS / "block-uploaded.png")
    page.get_by_role("link", name="See the block").click()
    expect(page.get_by_role("button", name="Publish")).to_be_visible()
    page.get_by_role("link", name="Blocks").first.click()
    row = page.get_by_role("listitem").filter(has_text="uploaded@1")
    expect(row.locator(".badge")).to_have_text("staged")


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
    expect(state).to_have_count(1)
    expect(state).to_have_text("published")
    assert served() == points_of_the_block
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "block.png")
    page.get_by_role("button", name="Withdraw").click()
    page.get_by_role("button", name="Withdraw the block").click()
    expect(state).to_have_text("withdrawn")
    assert served() == 0
    page.screenshot(path=ARTEFACTS / "block-withdrawn.png")
    page.get_by_role("button", name="Publish").click()
    expect(state).to_have_text("published")
    assert served() == points_of_the_block


def test_an_administrator_has_the_quality_of_a_block_assessed(visit, administrator):
    page = visit("#/block/1", administrator)
    page.get_by_text("Assess its quality").click()
    page.get_by_label("Required density").fill("100000")
    page.screenshot(path=ARTEFACTS / "block-assess.png")
    page.get_by_role("button", name="Assess").click()
    expect(page.locator(".badge")).to_have_text("successful")
    expect(page.get_by_text("Specification: missed.")).to_be_visible()
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    page.screenshot(path=ARTEFACTS / "block-assessed.png")
    page.get_by_role("link", name="Blocks").first.click()
    expect(page.locator("#panel h1")).to_have_text("Blocks")


def test_only_administrators_see_the_buttons_to_publish_and_to_assess(visit, secret):
    page = visit("#/block/1", secret)
    expect(page.locator(".badge")).to_have_text("published")
    assert page.get_by_role("button", name="Withdraw").count() == 0
    assert page.get_by_text("Assess its quality").count() == 0


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


def test_the_map_goes_to_a_country_or_a_coordinate_with_the_keyboard(visit, secret):
    """The map moves, the message names where it is; a wrong text is refused and moves nothing."""
    page = visit("#/points", secret, WIDE)
    count, status, field = page.locator(".count"), page.locator("#status"), page.get_by_label("Go to")
    expect(count).to_have_text(f"{points_of_the_block} points")
    tab_to(page, "Go to")
    page.keyboard.type("norw")
    page.keyboard.press("Enter")
    expect(status).to_have_text("The map shows Norway.")
    expect(count).to_have_text("0 points")
    assert_readable(page, "map-country")

    field.fill(f"{CENTRE[1]:.5f}, {CENTRE[0]:.5f}")
    field.press("Enter")
    expect(status).to_contain_text("The map shows")
    expect(count).to_have_text(f"{points_of_the_block} points")
    until_drawn(page)
    before = grey_map(page)
    for wrong in ("nowhere at all", "91, 0", "10 N, 20 S"):
        field.fill(wrong)
        field.press("Enter")
        expect(page.get_by_role("alert")).to_contain_text(f"“{wrong}” is no country")
    page.screenshot(path=ARTEFACTS / "map-go-to-refused.png")
    below_the_field = np.s_[WIDE["height"] // 4 :]
    moved = np.abs(grey_map(page) - before)[below_the_field]
    assert moved.mean() < as_good_as_equal


def classes_drawn(page: Page) -> list[bool]:
    """Which classes of points the map shows, from the best to the worst."""
    page.wait_for_timeout(poll_ms)
    until_drawn(page)
    return [pixels_drawn(page, colour) >= enough_px for colour in class_colours]


def test_points_are_coloured_by_their_accuracy_or_their_views(visit, secret):
    """All points of the block have few views and one accuracy: each choice draws its class alone."""
    page = visit("#/points", secret, WIDE)
    expect(page.locator(".count")).to_have_text(f"{points_of_the_block} points")
    for _ in range(2):
        until_drawn(page)
        page.get_by_role("button", name="Zoom in").click()
    classes = page.get_by_role("list", name="Colours of the points")
    expect(classes).to_have_count(0)
    for choice, words, count in (
        ("number of views", "1 or 2", 4),
        ("horizontal standard deviation", "all points in view have about the same", 1),
    ):
        page.get_by_label("Points coloured by").select_option(label=choice)
        expect(classes.get_by_role("listitem")).to_have_count(count)
        expect(classes).to_contain_text(words)
        expected = [choice != "number of views", False, False, choice == "number of views"]
        assert until(lambda expected=expected: classes_drawn(page) == expected), classes_drawn(page)
        assert_readable(page, f"points-by-{choice.split()[0]}")
        page.emulate_media(color_scheme="light")
        page.set_viewport_size(WIDE)


def test_an_invalid_token_is_refused_with_the_message_of_the_service(visit):
    page = visit("#/access")
    page.get_by_label("Token").fill("wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("unknown, expired or revoked")


def test_a_password_that_the_browser_keeps_serves_no_other_site(
    browser, service, world, administrator, secret
):
    """The browser answers the challenge with the token; then another site posts a form."""
    elsewhere = "http://elsewhere.example/"
    withdraw = f"{service.url}/blocks/flat/withdraw"
    attack = (
        f'<form method="post" action="{withdraw}" enctype="text/plain"><input name="x"></form>'
        "<script>document.forms[0].submit()</script>"
    )
    password = {"username": "ada", "password": administrator, "origin": service.url}
    headers = {"Authorization": f"Bearer {secret}"}
    with browser.new_context(http_credentials=password) as context:
        context.route(
            f"{elsewhere}*", lambda route: route.fulfill(body=attack, content_type="text/html")
        )
        page = context.new_page()
        reply = page.goto(f"{service.url}/collections/blocks/items?f=html")
        assert reply is not None
        assert reply.status == 200
        expect(page.get_by_role("heading", name="Blocks")).to_be_visible()
        with page.expect_response(withdraw) as attacked:
            page.goto(elsewhere)
        assert attacked.value.status == 403, "401 would be a request without the password"
        items = httpx.get(f"{service.url}/collections/points/items", headers=headers).json()
        assert items["numberMatched"] == points_of_the_block

        page.goto(f"{service.url}/map")
        post = "address => fetch(address, {method: 'POST'}).then(reply => reply.status)"
        assert page.evaluate(post, withdraw) == 200
        assert page.evaluate(post, withdraw.replace("withdraw", "publish")) == 200


VIEWS = {
    "points": "Control points",
    "scenes": "Scenes",
    "blocks": "Blocks",
    "block/1": "Test block flat",
    "access": "Signed in",
}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_view_fits_a_phone_and_is_accessible(visit, administrator, scheme):
    """No horizontal scrolling, and no violation that axe-core finds: contrast, names, roles, order."""
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
