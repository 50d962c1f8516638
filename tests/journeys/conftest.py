"""Fixtures of the journeys: a running service, the command line beside it, and a browser on its page."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

import numpy as np
import pytest
import rasterio
from playwright.sync_api import (
    Browser,
    ConsoleMessage,
    Page,
    ViewportSize,
    expect,
    sync_playwright,
)

from amers.app.db.cluster.embedded import Cluster
from tests.app.flat_world import CENTRE, GROUND_H, FlatWorld, make_flat_world
from tests.command_line import amers_here
from tests.journeys.map_page import ARTEFACTS, BUILT, DESKTOP, is_error, patience_ms
from tests.service_process import Service, installed_at

Amers = Callable[..., Any]
Visit = Callable[..., Page]


@pytest.fixture(scope="module")
def installation(open_folder: Path) -> Iterator[Path]:
    """The folder of an installation with an empty store, whose database runs also without a service."""
    folder = open_folder / uuid4().hex[:8]
    (folder / "references").mkdir(parents=True)
    folder.chmod(0o755)
    try:
        with Cluster(folder / "data" / "postgres", durable=False).lease():
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def service(installation: Path) -> Iterator[Service]:
    """A running service on the installation."""
    references = str(installation / "references")
    with Service(installation / "data", AMERS_REFERENCE_FOLDER=references) as service:
        yield service


@pytest.fixture(scope="module")
def amers(installation: Path) -> Amers:
    """Runs a command on the installation, beside the service where there is one; returns its JSON."""
    environment = installed_at(installation / "data")

    def run(*words: str | Path) -> Any:
        done = amers_here((*words, "--json"), environment)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture(scope="module")
def secret(amers: Amers) -> str:
    """A token that may register scenes."""
    return str(amers("token", "create", "journey", "--scope", "register")["secret"])


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Debian's Chromium without a network beyond this machine."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("there is no chromium: the page cannot be looked at: run `make chromium`")
    if not BUILT.is_file():
        pytest.skip("the page is not built: run `make page`")
    ARTEFACTS.mkdir(exist_ok=True)
    expect.set_options(timeout=patience_ms)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=chromium,
            args=[
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
            ],
        )
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def world(amers, tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A scene and a published block to register it on."""
    world = make_flat_world(tmp_path_factory.mktemp("world"))
    amers("block", "ingest", world.block, "--publish")
    return world


@pytest.fixture(scope="module")
def administrator(amers) -> str:
    return str(amers("token", "create", "Ada", "--scope", "admin")["secret"])


@pytest.fixture
def visit(browser: Browser, service: Service, world: FlatWorld) -> Iterator[Visit]:
    """Opens the page; then checks that requests went to the service and no error was logged.

    `refused` is the status of replies that the test provokes.
    """
    requested_urls: list[str] = []
    errors: list[str] = []
    contexts = []

    def open_page(
        where: str = "",
        secret: str | None = None,
        size: ViewportSize = DESKTOP,
        scheme: Literal["light", "dark"] = "light",
        refused: int = 401,
    ) -> Page:
        def note(message: ConsoleMessage) -> None:
            if is_error(message, refused):
                errors.append(message.text)

        context = browser.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")
        context.set_default_timeout(patience_ms)
        contexts.append(context)
        context.on("request", lambda request: requested_urls.append(request.url))
        context.on("weberror", lambda error: errors.append(str(error.error)))
        context.on("console", note)
        if secret is not None:
            keep = f"sessionStorage.setItem('amers-token', {json.dumps(secret)})"
            context.add_init_script(f"if (location.protocol === 'http:') {keep}")
        page = context.new_page()
        page.goto(f"{service.url}/map{where}")
        return page

    yield open_page
    for context in contexts:
        context.close()
    inside = (f"{service.url}/", f"blob:{service.url}/", "data:")
    assert requested_urls
    assert [url for url in requested_urls if not url.startswith(inside)] == []
    assert errors == []


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flat ground below the scene."""
    path = tmp_path_factory.mktemp("ground") / "ground.tif"
    west, north = CENTRE + [-0.01, 0.01]
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "dtype": "float32"}
    grid = rasterio.transform.from_origin(west, north, 0.0005, 0.0005)
    with rasterio.open(path, "w", **profile, crs="EPSG:4326", transform=grid) as file:
        file.write(np.full((40, 40), GROUND_H, dtype=np.float32), 1)
    return path
