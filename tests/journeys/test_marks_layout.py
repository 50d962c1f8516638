"""The page of marks at several sizes of the window: nothing of the list of marks is cut."""

import json

import pytest
from playwright.sync_api import Page, expect

from tests.app.flat_world import FlatWorld
from tests.journeys.conftest import Visit
from tests.journeys.map_page import ARTEFACTS
from tests.journeys.test_marking_page import (
    PICKED,
    a_blunder_px,
    ground_text,
    opened,
    rows,
    type_ground,
    until_adjusted,
    uploaded,
)
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SIZES = ((1440, 900), (1400, 920), (1120, 700), (390, 844))
CUT = """() => {
    const panel = document.getElementById("panel");
    const list = document.querySelector(".marks-scroll");
    const controls = [...panel.querySelectorAll("button, input, td, select")];
    const right = Math.min(innerWidth, list.getBoundingClientRect().right) + 1;
    return [
        ...controls.filter((one) => list.contains(one) && one.getBoundingClientRect().right > right),
        ...controls.filter((one) => one.getBoundingClientRect().right > innerWidth + 1),
        ...[list, panel].filter((one) => one.scrollWidth > one.clientWidth + 1),
    ].map((one) => one.outerHTML.slice(0, 90));
}"""


def set_marks(page: Page, world: FlatWorld) -> None:
    """Set six marks, the last of them wrong: its state and its residuals are the widest."""
    for number, place in enumerate(PICKED[:6]):
        off = a_blunder_px if number == 5 else 0
        type_ground(page, ground_text(world, place))
        page.get_by_label("Place in the image").fill(f"{place[0]}, {place[1] + off}")
        page.keyboard.press("Enter")
        expect(rows(page)).to_have_count(number + 1)
    until_adjusted(page)
    expect(rows(page).last).to_contain_text("rejected")


def test_no_part_of_the_marks_is_cut_at_any_size(
    visit: Visit, world: FlatWorld, secret: str, service: Service
) -> None:
    page = visit(f"#/mark/{uploaded(service, secret, world)}", secret)
    opened(page)
    set_marks(page, world)
    cut = {}
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(300)
        page.get_by_role("button", name="Remove M1").scroll_into_view_if_needed()
        page.screenshot(path=ARTEFACTS / f"marks-at-{width}.png")
        cut[width] = page.evaluate(CUT)
    assert {width: found for width, found in cut.items() if found} == {}, json.dumps(cut, indent=1)
