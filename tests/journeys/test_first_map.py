"""From `amers demo` to its scene beside its raw state on the map: one more command and one click."""

import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from tests.command_line import amers_here
from tests.service_process import free_port, installed_at, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]


@dataclass(frozen=True)
class Terminal:
    """`amers serve` on a terminal.

    Attributes:
        process: that ends on SIGINT.
        address: that it printed.
        service: where the service answers.
    """

    process: "subprocess.Popen[bytes]"
    address: str
    service: str


@pytest.fixture(scope="module")
def store(open_folder: Path) -> Path:
    """The store that the demonstration leaves."""
    made = amers_here(("demo", "-o", open_folder / "demo-output"), os.environ)
    assert made.returncode == 0, made.stderr
    command = re.search(r"amers serve --data (\S+)", made.stdout)
    assert command is not None, made.stdout
    return Path(command[1])


@pytest.fixture
def terminal(store: Path) -> Iterator[Terminal]:
    """A service of that store, started as a person does."""
    port, (own, its) = free_port(), pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "amers", "serve", "--port", str(port), "--data", str(store)],
        env=installed_at(store.parent / "elsewhere"),
        stdout=its,
        stderr=subprocess.DEVNULL,
    )
    said = b""
    try:
        while b"\n" not in said:
            said += os.read(own, 4096)
        address = said.split()[-1].decode()
        service = f"http://127.0.0.1:{port}"
        assert address.startswith(f"{service}/map#token=")
        assert until(lambda: _is_ready(service))
        yield Terminal(process, address, service)
    finally:
        process.terminate()
        process.wait(60)
        os.close(own)
        os.close(its)


def _is_ready(service: str) -> bool:
    try:
        return httpx.get(f"{service}/readyz").status_code == 200
    except httpx.TransportError:
        return False


def test_the_address_opens_the_scene_before_and_after(terminal: Terminal, browser: Browser) -> None:
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.goto(terminal.address)
    expect(page.get_by_role("radio", name="Both, with a divider")).to_be_checked(timeout=30_000)
    expect(page.get_by_text("Good").first).to_be_visible()
    assert "token" not in page.url
    expect(page.locator("#access")).to_have_text(re.compile("^amers serve "))
    if folder := os.environ.get("AMERS_PICTURES"):
        page.wait_for_timeout(3_000)
        page.screenshot(path=Path(folder) / "first_map.png")
    page.close()


def test_the_token_ends_with_the_command(terminal: Terminal, store: Path) -> None:
    secret = re.search(r"token=([^&]+)", terminal.address)
    assert secret is not None
    with httpx.Client(headers={"Authorization": f"Bearer {secret[1]}"}) as caller:
        assert caller.get(f"{terminal.service}/tokens/self").json()["scopes"] == ["admin"]
    terminal.process.terminate()
    terminal.process.wait(60)
    with Cluster(store / "postgres").lease() as dsn, engine.connect(dsn) as connection:
        valid = connection.exec_driver_sql(
            "select count(*) from token where name like 'amers serve %%' and revoked_at is null"
        )
        assert valid.scalar() == 0


def test_elsewhere_the_address_signs_nobody_in(terminal: Terminal, browser: Browser) -> None:
    """A link of somebody else to a service on another machine."""
    page, elsewhere = browser.new_page(), "http://maps.test"
    page.route(
        f"{elsewhere}/**",
        lambda route: route.fulfill(
            response=route.fetch(url=route.request.url.replace(elsewhere, terminal.service))
        ),
    )
    page.goto(terminal.address.replace(terminal.service, elsewhere))
    expect(page.locator("h1").first).to_be_visible()
    expect(page.locator("#access")).not_to_have_text(re.compile("^amers serve "))
    assert page.evaluate("sessionStorage.length") == 0
    page.unroute_all(behavior="ignoreErrors")
    page.close()
