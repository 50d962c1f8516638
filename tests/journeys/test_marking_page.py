"""Marks that a person sets on the page: in the raw image and on the map, with pointer and keys."""

import json
import re
import time
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from playwright.sync_api import Locator, Page, expect

from amers.services.formats.sensor_models.rpc_text import format_rpc_text, parse_rpc_text
from amers.services.sensors.correction import ImageCorrection, fold_into_rpc, no_correction
from amers.services.types import Array
from tests.app.flat_world import GROUND_H, FlatWorld
from tests.journeys.map_page import ARTEFACTS, WIDE, assert_readable, poll_ms, tab_to, until_drawn
from tests.journeys.ties import KnownGround
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

PICKED = np.array(
    [
        *[[150.0, 200.0], [180.0, 1000.0], [1000.0, 250.0], [950.0, 920.0], [600.0, 550.0]],
        *[[350.0, 700.0], [800.0, 400.0], [300.0, 420.0], [700.0, 850.0], [1050.0, 600.0]],
    ]
)
OFF_PX = np.array([24.0, -32.0])
a_pixel = 1.0
a_third_of_a_pixel = 1.0 / 3.0
half_a_pixel = 0.5
a_blunder_px = 40
a_hundredth_px = 0.01
long_step_px = 12
most_keys_of_the_first = 40
most_keys_of_others = 5
EXPECTED = re.compile(r"expected in the circle of (\d+) px, at line (-?\d+\.\d), sample (-?\d+\.\d)")


def uploaded(service: Service, secret: str, world: FlatWorld) -> str:
    """The id of the scene of the world, whose model is off by 17 px."""
    headers = {"Authorization": f"Bearer {secret}"}
    address = f"{service.url}/scenes?name=marked.tif&sigma_m=6"
    sent = httpx.post(address, headers=headers, content=world.tagged.read_bytes())
    scene: str = sent.raise_for_status().json()["id"]
    return scene


def opened(page: Page) -> Locator:
    """The raw image, once its tiles are drawn and the map has the scene."""
    image = page.get_by_role("application")
    expect(image).to_have_attribute("aria-busy", "false")
    expect(page.get_by_role("heading", name="Mark M1")).to_be_visible()
    until_drawn(page)
    return image


def off_expected(page: Page, image: Locator, line_sample: Array) -> Array:
    """How far below and right of the middle of the image a place is, screen pixels.

    The place that the page expects is in the middle.
    """
    prompt = page.locator(".prompt")
    expect(prompt).to_have_text(EXPECTED)
    radius, line, sample = map(float, EXPECTED.search(prompt.inner_text()).groups())
    box = image.bounding_box()
    scale = min(0.3 * min(box["width"], box["height"]) / max(radius, 60), 4.0)
    return np.asarray((line_sample - [line, sample]) * scale)


def choose_in_image(page: Page, image: Locator, line_sample: Array) -> None:
    """Click a place near the one that the page expects, which is in the middle of the image."""
    down, right = off_expected(page, image, line_sample)
    box = image.bounding_box()
    image.click(position={"x": box["width"] / 2 + right, "y": box["height"] / 2 + down})


def choose_with_keys(page: Page, line_sample: Array) -> None:
    """Move the crosshair from the expected place by screen pixels, as near as these are, and set it."""
    off = off_expected(page, page.get_by_role("application"), line_sample)
    for steps, back, on in zip(
        np.round(off).astype(int).tolist(),
        ("ArrowUp", "ArrowLeft"),
        ("ArrowDown", "ArrowRight"),
        strict=True,
    ):
        for _ in range(abs(steps)):
            page.keyboard.press(f"Shift+{on if steps > 0 else back}")
    page.keyboard.press("Enter")


def keys_to(page: Page, line_sample: Array) -> int:
    """Move the crosshair by long and by short steps to a place and set it; returns the keys pressed."""
    pressed = 1
    off = np.round(off_expected(page, page.get_by_role("application"), line_sample)).astype(int)
    for distance, ways in zip(off.tolist(), (("Up", "Down"), ("Left", "Right")), strict=True):
        long, short = divmod(abs(distance), long_step_px)
        for prefix, count in (("", long), ("Shift+", short)):
            for _ in range(count):
                page.keyboard.press(f"{prefix}Arrow{ways[distance > 0]}")
        pressed += long + short
    page.keyboard.press("Enter")
    return pressed


def rows(page: Page) -> Locator:
    return page.get_by_role("region", name="List of marks").locator("tbody tr")


def ground_text(world: FlatWorld, line_sample: Array, *, height: bool = True) -> str:
    lon, lat, h = world.true_model.locate(line_sample[None], np.array([GROUND_H]))[0].tolist()
    return f"{lon:.8f}, {lat:.8f}" + (f", {h:.2f}" if height else "")


def residuals_shown(page: Page) -> Array:
    """Residuals (n, 2) in the table."""
    texts = [row.locator("td").nth(5).inner_text() for row in rows(page).all()]
    return np.array(
        [[float(part.replace("\N{MINUS SIGN}", "-")) for part in text.split()] for text in texts]
    )


def places_shown(page: Page) -> Array:
    """Lines and samples (n, 2) in the table."""
    texts = [row.locator("td").all_inner_texts()[:2] for row in rows(page).all()]
    return np.array(texts, dtype=np.float64)


def until_adjusted(page: Page) -> None:
    expect(page.locator(".summary")).to_have_attribute("aria-busy", "false")


def type_ground(page: Page, text: str) -> None:
    page.get_by_label("Place on the ground").fill(text)
    page.keyboard.press("Enter")


def test_ten_marks_are_set_with_pointer_and_keys_and_saved_as_the_command_reads_them(
    visit, world, secret, service, amers, tmp_path
):
    """Without a terrain of the service: heights are typed, or those of control points."""
    scene = uploaded(service, secret, world)
    page = visit(f"#/scene/{scene}", secret, WIDE)
    page.get_by_role("link", name="Mark points").click()
    image = opened(page)
    expect(page.get_by_text("give the heights")).to_be_visible()
    for place in PICKED[:4]:
        type_ground(page, ground_text(world, place))
        expect(image).to_be_focused()
        choose_in_image(page, image, place)
        expect(page.locator(".prompt")).to_have_text("Choose a place in the image or on the map.")
        until_adjusted(page)
    expect(rows(page)).to_have_count(4)

    type_ground(page, ", ".join(ground_text(world, PICKED[4], height=False).split(", ")[::-1]))
    expect(page.get_by_role("alert")).to_contain_text("longitude and latitude are exchanged")

    for point in control_points(service, secret)[:2]:
        lon, lat, _ = point["geometry"]["coordinates"]
        field = page.get_by_label("Go to")
        field.fill(f"{lat}, {lon}")
        field.press("Enter")
        until_drawn(page)
        page.locator("#map canvas").click()
        expect(page.get_by_alt_text(f"Chip of control point {point['id']}")).to_be_visible()
        ground = np.array([point["geometry"]["coordinates"]])
        choose_in_image(page, image, world.true_model.project(ground)[0])
        until_adjusted(page)
    page.screenshot(path=ARTEFACTS / "marks-control-points.png")

    for place in PICKED[5:8]:
        tab_to(page, "Place on the ground")
        page.keyboard.type(ground_text(world, place))
        page.keyboard.press("Enter")
        expect(image).to_be_focused()
        choose_with_keys(page, place)
        until_adjusted(page)
    tab_to(page, "Go to where the next mark helps most")
    page.keyboard.press("Enter")
    expect(image).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#map canvas")).to_be_focused()
    expect(page.locator(".prompt")).to_contain_text("expected in the circle")
    page.keyboard.press("Shift+ArrowLeft")
    page.screenshot(path=ARTEFACTS / "marks-keys-on-map.png")
    page.keyboard.press("Enter")
    ground_field = page.get_by_label("Place on the ground")
    expect(ground_field).to_be_focused()
    expect(page.locator(".prompt")).to_contain_text("The height is missing")
    page.keyboard.type(f", {GROUND_H}")
    page.keyboard.press("Enter")
    expect(ground_field).to_have_value("")
    until_adjusted(page)
    expect(rows(page)).to_have_count(10)
    assert np.abs(residuals_shown(page)).max() < a_pixel
    expect(rows(page).get_by_text("used", exact=True)).to_have_count(10)
    assert_readable(page, "marks-ten")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")

    before = residuals_shown(page)
    type_ground(page, ground_text(world, PICKED[5]))
    choose_in_image(page, image, PICKED[5] + [0.0, a_blunder_px])
    expect(rows(page).last).to_contain_text("rejected")
    expect(page.get_by_text(re.compile("Mark M11 is not used"))).to_be_visible()
    assert_readable(page, "marks-blunder")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")
    image.focus()
    page.keyboard.press("Control+z")
    page.keyboard.press("Control+z")
    expect(rows(page)).to_have_count(10)
    until_adjusted(page)
    np.testing.assert_array_equal(residuals_shown(page), before)

    marks, out = save_marks(page, tmp_path / "marks.csv"), tmp_path / "out"
    amers("scene", "register", world.tagged, "--sigma-m", "6", "--control", marks, "-o", out)
    assert_same_residuals(json.loads((out / "report.json").read_text()), before)

    for _ in range(10):
        page.get_by_role("button", name="Remove M").first.click()
    expect(rows(page)).to_have_count(0)
    page.get_by_label("Open marks").set_input_files(marks)
    expect(rows(page)).to_have_count(10)
    until_adjusted(page)
    np.testing.assert_array_equal(residuals_shown(page), before)

    page.get_by_role("button", name="Register with these marks").click()
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    job = page.url.rsplit("/", 1)[1]
    headers = {"Authorization": f"Bearer {secret}"}
    results = httpx.get(f"{service.url}/jobs/{job}/results", headers=headers).json()
    report = httpx.get(results["report.json"]["href"], headers=headers).json()
    assert_same_residuals(report, before)


def test_marks_on_a_reference_image_take_heights_of_its_terrain(
    visit, world, secret, service, administrator, installation, tmp_path
):
    """With the pointer alone, but for what finds a place on the map; one is held out, one changed."""
    add_reference(service, administrator, installation / "references", world)
    page = visit(f"#/mark/{uploaded(service, secret, world)}", secret, WIDE)
    image = opened(page)
    expect(page.get_by_text("are those of the terrain of land")).to_be_visible()
    expect(page.get_by_label("Reference image on the map")).to_have_value("land")
    began = time.monotonic()
    for place in PICKED:
        lon, lat, _ = ground_text(world, place).split(", ")
        field = page.get_by_label("Go to")
        field.fill(f"{lat}, {lon}")
        field.press("Enter")
        page.wait_for_timeout(poll_ms)
        until_drawn(page)
        page.locator("#map canvas").click()
        choose_in_image(page, image, place)
        until_adjusted(page)
    print(f"ten marks in {time.monotonic() - began:.0f} s")
    expect(rows(page).get_by_text("used", exact=True)).to_have_count(len(PICKED))
    assert np.abs(residuals_shown(page)).max() < a_pixel
    np.testing.assert_allclose(places_shown(page), PICKED, atol=a_third_of_a_pixel)
    before = residuals_shown(page)
    marks = save_marks(page, tmp_path / "marks.csv")
    fields = [line.split(",") for line in marks.read_text().splitlines()[1:]]
    assert fields[0][3:6] == ["height_m", "sigma_horizontal_m", "sigma_up_m"]
    assert {tuple(row[4:6]) for row in fields[1:]} == {("", "0.5")}
    page.get_by_label("Open marks").set_input_files(marks)
    expect(page.locator("#status")).to_have_text("10 marks opened.")
    until_adjusted(page)
    np.testing.assert_array_equal(residuals_shown(page), before)
    other = tmp_path / "other.csv"
    other.write_text(marks.read_text().replace("sigma_px", "colour"))
    page.get_by_label("Open marks").set_input_files(other)
    expect(page.get_by_role("alert")).to_contain_text("colour")
    assert {row.locator("td").nth(4).inner_text() for row in rows(page).all()} == {f"{GROUND_H:.2f}"}
    page.get_by_role("button", name="Show M5").click()
    until_drawn(page)
    assert_readable(page, "marks-on-reference")
    page.set_viewport_size(WIDE)
    page.emulate_media(color_scheme="light")
    page.get_by_label("M2 is a check point").check()
    expect(rows(page).nth(1)).to_contain_text("check")
    page.get_by_role("button", name="Change M5").click()
    page.get_by_label("Place in the image").fill("10, 20")
    page.keyboard.press("Enter")
    expect(rows(page).last).to_contain_text("rejected")
    expect(rows(page).last.get_by_label("Name of M5")).to_be_visible()
    page.get_by_role("button", name="Change M9").click()
    expect(rows(page)).to_have_count(9)
    page.get_by_label("Place in the image").fill("1200, 20")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("the image has 1200 lines")
    page.get_by_role("button", name="Give up").click()
    expect(rows(page)).to_have_count(10)
    until_adjusted(page)
    before = residuals_shown(page)
    page.reload()
    expect(rows(page)).to_have_count(10)
    until_adjusted(page)
    np.testing.assert_array_equal(residuals_shown(page), before)
    page.get_by_label("Reference image on the map").select_option("none")
    until_drawn(page)
    page.screenshot(path=ARTEFACTS / "marks-without-reference.png")


def test_ten_marks_take_few_keys_each_without_a_pointer(visit, world, secret, service):
    """Ground positions are pasted; what else a mark needs is counted."""
    page = visit(f"#/mark/{uploaded(service, secret, world)}", secret, WIDE)
    image = opened(page)
    keys = []
    for number, place in enumerate(PICKED, 1):
        ground, pressed = page.get_by_label("Place on the ground"), 1
        while not ground.evaluate("field => field === document.activeElement"):
            page.keyboard.press("Shift+Tab" if number > 1 else "Tab")
            pressed += 1
        page.keyboard.insert_text(ground_text(world, place))
        page.keyboard.press("Enter")
        expect(image).to_be_focused()
        pressed += 1 + keys_to(page, place)
        keys.append(pressed)
        expect(rows(page)).to_have_count(number)
        until_adjusted(page)
    print(f"keys of each mark: {keys}")
    expect(rows(page).get_by_text("used", exact=True)).to_have_count(len(PICKED))
    assert np.abs(residuals_shown(page)).max() < a_pixel
    assert keys[0] <= most_keys_of_the_first  # the model is 17 px off
    assert max(keys[1:]) <= most_keys_of_others


@pytest.mark.real_data
def test_eight_marks_on_the_page_bring_back_a_real_view_whose_model_is_40_px_off(
    visit, secret, service, real_data, tmp_path
):
    """Ground and true places are those of ties with two other views."""
    ties = KnownGround.of_triplet(real_data)
    frame = no_correction(ties.shape)
    off = ImageCorrection(np.column_stack([OFF_PX, np.zeros((2, 2))]), frame.centre, frame.half_size)
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=60.0) as client:
        content = (real_data / "phr_calanques_triplet" / "img_02.tif").read_bytes()
        scene = client.post("/scenes?name=img_02.tif", content=content).raise_for_status().json()["id"]
        model = format_rpc_text(fold_into_rpc(ties.model, off))
        laid = client.put(f"/scenes/{scene}/files/img_02_RPC.TXT", content=model.encode())
        laid.raise_for_status()
    page = visit(f"#/mark/{scene}", secret, WIDE)
    image = opened(page)
    page.get_by_text("Accuracy of the marks").click()
    for label, value in (("Ground, horizontal", "0.1"), ("Ground, up", "0.1")):
        page.get_by_label(label).fill(value)
    inner = (np.abs(ties.shown / ties.shape - 0.5) < 0.4).all(axis=1)
    rows_of_ties = np.random.default_rng(7).permutation(np.flatnonzero(inner))
    for number, row in enumerate(rows_of_ties[:8]):
        type_ground(page, ", ".join(f"{value:.9f}" for value in ties.ground[row].tolist()))
        choose_in_image(page, image, ties.shown[row])
        expect(rows(page)).to_have_count(number + 1)
        until_adjusted(page)
    expect(rows(page).get_by_text("used", exact=True)).to_have_count(8)
    assert_readable(page, "marks-real")
    page.set_viewport_size(WIDE)
    page.get_by_role("button", name="Register with these marks").click()
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    job = page.url.rsplit("/", 1)[1]
    results = httpx.get(f"{service.url}/jobs/{job}/results", headers=headers).json()
    refined = tmp_path / "img_02_RPC.TXT"
    refined.write_bytes(httpx.get(results[refined.name]["href"], headers=headers).content)
    others = rows_of_ties[20:]
    computed = parse_rpc_text(refined.read_text()).project(ties.ground[others])
    off_px = np.hypot(*(ties.shown[others] - computed).mean(axis=0))
    print(f"off by {off_px:.2f} px")
    assert off_px < half_a_pixel


def add_reference(service: Service, administrator: str, folder: Path, world: FlatWorld) -> None:
    """The ground of the world as an ortho-image on the ellipsoid's degrees, and its terrain."""
    size = world.ground.shape[0]
    corners = np.array([[-0.5, -0.5], [size - 0.5, size - 0.5]])
    (west, north), (east, south) = world.true_model.locate(corners, np.full(2, GROUND_H))[:, :2]
    height_m = np.full((40, 40), GROUND_H, dtype=np.float32)
    for name, pixels in (("land", world.ground), ("heights", height_m)):
        rows, columns = pixels.shape
        grid = rasterio.transform.from_bounds(west, south, east, north, columns, rows)
        profile = {"driver": "GTiff", "width": columns, "height": rows, "count": 1, "crs": "EPSG:4326"}
        with rasterio.open(
            folder / f"{name}.tif", "w", **profile, dtype="float32", transform=grid
        ) as file:
            file.write(pixels, 1)
    files = {"image": "land.tif", "dem": "heights.tif", "vertical": "ellipsoid"}
    body = {"name": "land", **files, "sigma_m": 0.5, "sigma_up_m": 0.5}
    headers = {"Authorization": f"Bearer {administrator}"}
    httpx.post(f"{service.url}/references", json=body, headers=headers).raise_for_status()


def save_marks(page: Page, path: Path) -> Path:
    with page.expect_download() as download:
        page.get_by_role("button", name="Save as CSV").click()
    path.write_bytes(download.value.path().read_bytes())
    return path


def assert_same_residuals(report: dict, shown: Array) -> None:
    found = np.array([mark["residual_px"] for mark in report["marks"]["marks"]])
    np.testing.assert_allclose(found, shown, atol=a_hundredth_px)


def control_points(service: Service, secret: str) -> list[dict]:
    headers = {"Authorization": f"Bearer {secret}"}
    found = httpx.get(f"{service.url}/collections/points/items?limit=5", headers=headers)
    features: list[dict] = found.json()["features"]
    return features
