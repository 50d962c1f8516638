"""What a slow service answers when the user has gone on: it is shown where it belongs, or not at all."""

import pytest
from playwright.sync_api import expect

from tests.journeys.map_page import hold, registered, until_drawn, until_held

pytestmark = [pytest.mark.long, pytest.mark.thorough]

points_of_the_block = 40
without_points = "-40, -20"


def test_points_of_a_view_that_the_map_has_left_are_not_listed(visit, secret):
    page = visit("#/points", secret)
    count = page.locator(".count")
    expect(count).to_have_text(f"{points_of_the_block} points")
    until_drawn(page)
    held = hold(page, "points/items?bbox=")
    page.get_by_role("button", name="Zoom out").click()
    late = until_held(page, held)
    field = page.get_by_label("Go to")
    field.fill(without_points)
    field.press("Enter")
    expect(count).to_have_text("0 points")
    with page.expect_response(lambda reply: reply.url == late.request.url):
        late.continue_()
    page.wait_for_load_state("networkidle")
    expect(count).to_have_text("0 points")
    expect(page.get_by_role("list", name="Points in view").get_by_role("listitem")).to_have_count(0)


def test_a_shape_is_not_given_the_accuracy_of_one_that_was_removed_meanwhile(
    visit, world, secret, service, ground
):
    page = visit(f"#/job/{registered(service, secret, world)}", secret)
    page.get_by_role("link", name="Draw on the image").click()
    image = page.get_by_role("application")
    expect(image).to_have_attribute("aria-busy", "false")
    image.focus()
    page.keyboard.press("Space")
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("Space")
    drawn = page.get_by_role("list", name="Drawn").get_by_role("listitem")
    expect(drawn).to_have_count(2)
    page.get_by_label("Another terrain").set_input_files(ground)
    page.get_by_label("Vertical datum").fill("ellipsoid")
    held = hold(page, "vectors.geojson")
    page.get_by_role("button", name="Show on the map").click()
    late = until_held(page, held)
    drawn.first.get_by_role("button").click()
    late.continue_()
    expect(page.get_by_role("heading", name="On the map")).to_be_visible()
    expect(drawn).to_have_count(1)
    expect(drawn).to_contain_text("1 vertex")
    page.get_by_role("button", name="Show on the map").click()
    expect(drawn).to_contain_text("CE90")
