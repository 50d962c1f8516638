"""Every button of the map page, reached with the Tab key and pressed with Enter."""

import json
import os
import re
import signal
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect

from tests.app.flat_world import CENTRE, GROUND_H, FlatWorld
from tests.journeys.map_page import ROOT, WIDE, registered, until_drawn
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SOURCE = ROOT / "web" / "source"
BUTTON = re.compile(r'h\("(?:button|summary)", \{.*?\}, (?P<label>[^\n]*)')
WORDS = re.compile(r'"([A-Z][^"$]*)"')
most_tabs = 200
more_than_two_pages = 45
"""Scenes, so that the second page of the list leads back and on."""
ELSEWHERE = {
    "Cancel": "test_map.py::test_a_withdrawal_asks_first_and_the_keyboard_can_refuse_it",
    "Publish": "test_map.py::test_a_withdrawal_asks_first_and_the_keyboard_can_refuse_it",
    "Delete": "test_administration_page.py::test_a_withdrawn_block_is_deleted_once_its_name_is_typed",
    "Older changes": "test_administration_page.py::"
    "test_the_audit_trail_is_read_page_by_page_and_filtered",
    "Show heights": "test_surface_page.py::test_a_surface_is_seen_with_its_heights_and_a_profile",
    "Change": "test_marking_page.py::"
    "test_ten_marks_are_set_with_pointer_and_keys_and_saved_as_the_command_reads_them",
    "Register": "test_page.py::test_a_scene_tells_its_state_and_is_registered_again_with_other_options",
}
"""Buttons of states that need more than a view, and the journeys that press them."""
WATCH = """() => {
  window.pressed = [];
  addEventListener('click', (event) => {
    const button = event.target.closest('button, summary, [role=button]');
    if (!button) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    window.pressed.push(button.dataset.number);
  }, true);
}"""
NUMBER = """() => {
  for (const part of document.querySelectorAll('details')) part.open = true;
  const all = [...document.querySelectorAll('button, summary, [role=button]')];
  const seen = all.filter((one) => one.checkVisibility() && !one.disabled);
  seen.forEach((one, at) => (one.dataset.number = String(at)));
  return seen.map((one) => one.textContent.trim());
}"""
"""Opens all parts of a view and numbers its buttons, of which those that may be pressed are returned."""


@pytest.fixture(scope="module")
def places(service: Service, administrator: str, world: FlatWorld) -> dict[str, str]:
    """Addresses of the views by what they show, in a store with scenes, jobs and a registration."""
    job = registered(service, administrator, world, "keys.tif")
    headers = {"Authorization": f"Bearer {administrator}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        scene = client.get(f"/jobs/{job}").json()["inputs"]["scene"]
        for number in range(more_than_two_pages):
            client.post(f"/scenes?name=row-{number}.tif", content=b"II*\0").raise_for_status()
    return {
        "points": "#/points",
        "scenes": "#/scenes",
        "scene": f"#/scene/{scene}",
        "job": f"#/job/{job}",
        "draw": f"#/draw/{job}",
        "mark": f"#/mark/{scene}",
        "blocks": "#/blocks",
        "block": "#/block/1",
        "access": "#/access",
        **{part: f"#/admin/{part}" for part in ("status", "tokens", "references", "audit")},
    }


@pytest.fixture(scope="module")
def pressed() -> set[str]:
    """The labels of all buttons that were pressed."""
    return set()


VIEWS = (
    *("points", "scenes", "scene", "job", "draw", "mark", "blocks", "block", "access"),
    *("status", "tokens", "references", "audit"),
)


@pytest.mark.parametrize("view", VIEWS)
def test_every_button_of_a_view_is_pressed_with_the_keyboard(
    view, visit, administrator, places, pressed
):
    """A click is noted and goes no further, so that no press changes what the next one finds."""
    page = visit(places[view], administrator, WIDE)
    # The title names the view once all of it is there.
    expect(page).to_have_title(re.compile(" · Amers$"))
    page.wait_for_load_state("networkidle")
    if view in {"draw", "mark"}:
        expect(page.get_by_role("application")).to_have_attribute("aria-busy", "false")
    elif view in {"scenes", "scene", "job", "blocks", "block"}:
        until_drawn(page)
    PREPARED.get(view, lambda page: None)(page)
    labels = press_all(page)
    assert labels or view in {"points", "audit"}, view
    pressed.update(labels)


def test_the_button_to_sign_in_is_pressed_with_the_keyboard(visit, pressed):
    page = visit("#/access", None, WIDE)
    expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
    pressed.update(press_all(page))


def set_marks(page: Page) -> None:
    """Two marks, of which the second is taken back: all buttons of the marks may then be pressed."""
    for number in range(2):
        page.get_by_label("Place in the image").fill(f"{300 + 100 * number}, 400")
        page.get_by_label("Place on the ground").fill(f"{CENTRE[0]}, {CENTRE[1]}, {GROUND_H}")
        page.get_by_role("button", name="Set", exact=True).press("Enter")
        expect(page.get_by_role("button", name=f"Show M{number + 1}")).to_be_visible()
    page.get_by_role("button", name="Undo").press("Enter")
    expect(page.get_by_role("button", name="Redo")).to_be_enabled()
    # The table is drawn again with the reply to the last change.
    expect(page.locator(".summary")).to_have_attribute("aria-busy", "false")
    page.wait_for_load_state("networkidle")


def draw_a_point(page: Page) -> None:
    image = page.get_by_role("application")
    image.focus()
    page.keyboard.press("Space")
    expect(page.get_by_role("list", name="Drawn").get_by_role("listitem")).to_have_count(1)


def turn_the_page(page: Page) -> None:
    page.get_by_role("button", name="Next scenes").press("Enter")
    expect(page.get_by_text(re.compile("^21 to 40 of"))).to_be_visible()


PREPARED = {"mark": set_marks, "draw": draw_a_point, "scenes": turn_the_page}
"""What makes the buttons of a view ready to be pressed."""


def test_a_job_that_waits_is_stopped_with_the_keyboard(
    visit, administrator, service, world, places, pressed
):
    """The worker is stopped, so that the job has to wait."""
    headers = {"Authorization": f"Bearer {administrator}"}
    workers = service.workers()
    with httpx.Client(base_url=service.url, headers=headers, timeout=30.0) as client:
        for worker in workers:
            os.kill(worker, signal.SIGSTOP)
        try:
            inputs = {"inputs": {"scene": places["scene"].rpartition("/")[2]}}
            asked = client.post("/processes/register-scene/execution", json=inputs)
            job = asked.raise_for_status().json()["jobID"]
            page = visit(f"#/job/{job}", administrator, WIDE)
            stop = page.get_by_role("button", name="Stop")
            stop.press("Enter")
            expect(page.locator(".badge")).to_have_text("dismissed")
            pressed.add("Stop")
        finally:
            for worker in workers:
                os.kill(worker, signal.SIGCONT)


def test_an_upload_is_held_with_the_keyboard(visit, administrator, world, pressed):
    page = visit("#/scenes", administrator, WIDE)
    page.route("**/uploads*", lambda route: None)
    page.get_by_label("Image").first.set_input_files(world.tagged)
    page.get_by_role("button", name="Upload and register").press("Enter")
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    pressed.update(press_all(page))
    page.unroute_all(behavior="ignoreErrors")


def press_all(page: Page) -> set[str]:
    """Press the Tab key until all buttons had the focus, and Enter on each; the labels of all."""
    labels: list[str] = page.evaluate(NUMBER)
    page.evaluate(WATCH)
    page.evaluate("document.body.tabIndex = -1; document.body.focus()")
    waiting = set(map(str, range(len(labels))))
    for _ in range(most_tabs):
        if not waiting:
            break
        page.keyboard.press("Tab")
        number = page.evaluate("document.activeElement.dataset?.number")
        if number in waiting:
            page.keyboard.press("Enter")
            assert page.evaluate("window.pressed.at(-1)") == number, labels[int(number)]
            waiting.discard(number)
    missed = [labels[int(number)] for number in waiting]
    assert missed == [], f"the Tab key does not lead to {missed}"
    return set(labels)


def test_no_button_of_the_source_is_left_out(pressed):
    """A new button appears in a view above, or a journey that presses it is named."""
    if not pressed:
        pytest.skip("the views were not visited in this run")
    written = {
        word.strip()
        for file in sorted(SOURCE.glob("*.ts"))
        for button in BUTTON.finditer(file.read_text(encoding="utf-8"))
        for word in WORDS.findall(button["label"].split("h(")[0])
    }
    assert written, json.dumps(str(SOURCE))
    for place in ELSEWHERE.values():
        file, _, name = place.partition("::")
        assert f"def {name}(" in (Path(__file__).parent / file).read_text(encoding="utf-8")
    assert sorted(written - pressed - set(ELSEWHERE)) == []
