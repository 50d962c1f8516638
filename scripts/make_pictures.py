"""Make the pictures of the documents from a folder of `make demo`: report, map and marks.

    python scripts/make_pictures.py FOLDER [PICTURES]

PICTURES is the folder to write into, by default docs/pictures.
Chromium draws them (`scripts/ensure-chromium`); the map needs the page (`make page`).
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from playwright.sync_api import Page, sync_playwright

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
SIZE = {"width": 1120, "height": 700}
WIDE = {"width": 1400, "height": 920}
QUALITY = 80
PATIENCE_S = 120.0
DRAWING_MS = 10_000.0
"""Time for the map to move and to draw, without a graphics card."""
MARKS = 6
WRONG_PX = 25.0


def main(folder: Path, pictures: Path = PICTURES) -> None:
    """Write all pictures of a demonstration into a folder."""
    pictures.mkdir(exist_ok=True)
    with sync_playwright() as driver, service_of(folder / "block") as (address, secret):
        software_drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=software_drawing)
        page = browser.new_page(viewport=SIZE, color_scheme="light")
        page.goto((folder / "registered" / "report.html").absolute().as_uri())
        keep(page, pictures / "report.jpg")
        points = httpx.get(f"{address}/collections/points/items", params={"limit": 1}).json()
        page.goto(f"{address}/map#/points")
        page.get_by_role("link", name=str(points["features"][0]["id"])).click()
        page.wait_for_load_state("networkidle")
        page.wait_for_timeout(DRAWING_MS)
        keep(page, pictures / "map.jpg")
        page.set_viewport_size(WIDE)
        mark(page, address, secret, folder)
        keep(page, pictures / "marks.jpg")
        browser.close()


def mark(page: Page, address: str, secret: str, folder: Path) -> None:
    """Set marks on control points, one of them wrong, and choose another point on the map."""
    headers = {"Authorization": f"Bearer {secret}"}
    image = (folder / "images" / "scene.tif").read_bytes()
    sent = httpx.post(
        f"{address}/scenes?name=scene.tif&sigma_m=30", headers=headers, content=image, timeout=60.0
    )
    text = (folder / "registered" / "control_points.geojson").read_text(encoding="utf-8")
    points = [one for one in json.loads(text)["features"] if one["properties"]["status"] == "active"]
    page.evaluate(f"sessionStorage.setItem('amers-token', {json.dumps(secret)})")
    page.goto(f"{address}/map#/mark/{sent.raise_for_status().json()['id']}")
    page.reload()
    points = points[:: len(points) // (MARKS + 1)]
    for number, point in enumerate(points[:MARKS]):
        found = point["properties"]
        wrong_px = WRONG_PX if number == MARKS - 1 else 0.0
        page.get_by_label("Place in the image").fill(f"{found['line']}, {found['sample'] + wrong_px}")
        page.get_by_label("Place on the ground").fill(
            ", ".join(map(str, point["geometry"]["coordinates"]))
        )
        page.get_by_role("button", name="Set").click()
        page.get_by_role("button", name=f"Show M{number + 1}").wait_for()
    lon, lat = points[MARKS]["geometry"]["coordinates"][:2]
    page.get_by_label("Go to").fill(f"{lat}, {lon}")
    page.get_by_label("Go to").press("Enter")
    page.wait_for_timeout(DRAWING_MS)
    page.locator("#map canvas").click()
    page.wait_for_timeout(DRAWING_MS)


def keep(page: Page, path: Path) -> None:
    """Write what a page shows as a small picture."""
    page.screenshot(path=path, type="jpeg", quality=QUALITY)
    print(f"{path.name}: {path.stat().st_size / 1024.0:.0f} KiB")


@contextmanager
def service_of(block: Path) -> Iterator[tuple[str, str]]:
    """Address and token of a service with public points and one block, for the `with`."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    amers = [sys.executable, "-m", "amers"]
    with tempfile.TemporaryDirectory() as data:
        # Started by root, the database server runs as another user, who has to enter the folder.
        Path(data).chmod(0o711)
        environment = {**os.environ, "AMERS_DATA_FOLDER": data, "AMERS_PUBLIC_POINTS": "true"}
        subprocess.run([*amers, "block", "ingest", str(block), "--publish"], env=environment, check=True)
        create = [*amers, "token", "create", "pictures", "--scope", "register", "--json"]
        token = json.loads(subprocess.check_output(create, env=environment))
        service = subprocess.Popen([*amers, "serve", "--port", str(port)], env=environment)
        try:
            address = f"http://127.0.0.1:{port}"
            wait_for(address)
            yield address, token["secret"]
        finally:
            service.terminate()
            service.wait()


def wait_for(address: str) -> None:
    """Wait until a service answers.

    Raises:
        TimeoutError: it does not.
    """
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        try:
            if httpx.get(f"{address}/readyz", timeout=30.0).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.5)
    raise TimeoutError(f"{address} is not ready after {PATIENCE_S:g} s")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:]))
