"""Behind nginx and Caddy, with TLS and a sub-path: clients that people have, which know the public
address only.

The configurations are those of the documentation, with the ports and the certificate of the test.
"""

import hashlib
import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pyogrio
import pytest
import rasterio
from owslib.ogcapi.features import Features
from playwright.sync_api import Browser, expect
from pystac_client import Client as Catalog
from tusclient.client import TusClient

from amers.app.api.connect import RECIPES
from amers.app.client import Client
from tests.app.flat_world import SIGMA_M, FlatWorld
from tests.journeys.map_page import registered, until_drawn
from tests.links import POST_ALONE, kind_of, urls_of
from tests.proxy_process import (
    EXAMPLES,
    HOST,
    Certificate,
    Ports,
    caddy,
    make_certificate,
    nginx,
    program_of,
)
from tests.service_process import Service, free_port, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

ROOT = Path(__file__).parents[2]
TUS_JS = ROOT / "web" / "node_modules" / "tus-js-client"
UPLOAD_BY_NODE = """
const { readFileSync } = require("node:fs");
const [, module, endpoint, path] = process.argv;
const tus = require(module);
const headers = { Authorization: `Bearer ${process.env.TOKEN}` };
const metadata = { filename: "node.tif" };
const upload = new tus.Upload(readFileSync(path), {
  endpoint, headers, metadata, chunkSize: 1000000,
  onSuccess: () => console.log(upload.url),
  onError: (error) => { console.error(String(error)); process.exit(1); },
});
upload.start();
"""
PROXIES = ("nginx, path passed on", "nginx, path removed", "Caddy")
one_proxy = pytest.mark.parametrize("address", PROXIES[:1], indirect=True)
"""For what takes long; shorter tests cover the others."""
POINTS = 40
most_replies = 500
half_px = 300_000


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    return make_certificate(tmp_path_factory.mktemp("certificate"))


@pytest.fixture(scope="module")
def tls_port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def public(tls_port: int) -> str:
    """The public address, the only one that clients know."""
    return f"https://{HOST}:{tls_port}/amers/"


@pytest.fixture(scope="module")
def service(installation: Path, public: str) -> Iterator[Service]:
    settings = {"AMERS_PUBLIC_URL": public, "AMERS_TRUSTED_PROXIES": HOST}
    with Service(installation / "data", **settings) as service:
        yield service


@pytest.fixture(scope="module")
def job(service: Service, secret: str, world: FlatWorld) -> str:
    """The registration of a scene."""
    return registered(service, secret, world)


@pytest.fixture(scope="module", params=PROXIES)
def address(
    request: pytest.FixtureRequest,
    service: Service,
    job: str,
    public: str,
    tls_port: int,
    certificate: Certificate,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[str]:
    """The public address, behind one of the proxies, of a service with points and a registered scene."""
    folder = tmp_path_factory.mktemp("proxy")
    ports = Ports(tls_port, free_port(), service.port)
    if request.param == "Caddy":
        proxy = caddy(folder, certificate, ports)
    else:
        proxy = nginx(folder, certificate, ports, removes_path=request.param.endswith("removed"))
    with pytest.MonkeyPatch.context() as patch, proxy:
        for name in (
            "CURL_CA_BUNDLE",
            "GDAL_CURL_CA_BUNDLE",
            "NODE_EXTRA_CA_CERTS",
            "REQUESTS_CA_BUNDLE",
            "SSL_CERT_FILE",
        ):
            patch.setenv(name, str(certificate.path))
        yield public


@pytest.fixture
def me(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


@pytest.fixture
def http(address: str, me: dict[str, str]) -> Iterator[httpx.Client]:
    """A caller who asks for compressed replies; every address in every reply is a public one."""

    def check(reply: httpx.Response) -> None:
        reply.read()
        asked = str(reply.request.url)
        others = [url for url in urls_of(reply, asked) if not f"{url}/".startswith(address)]
        assert others == [], asked

    with httpx.Client(
        base_url=address, headers=me, timeout=60.0, event_hooks={"response": [check]}
    ) as http:
        yield http


# Links


def test_every_link_is_public_and_answers(http: httpx.Client, address: str, job: str):
    waiting, seen, asked = deque([address, f"{address}?f=html", f"{address}jobs/{job}"]), set(), []
    while waiting:
        url = waiting.popleft()
        asked.append(url)
        reply = http.get(url)
        assert reply.status_code < 400, (url, reply.text)
        for named in urls_of(reply, url):
            kind = kind_of(named)
            if kind not in seen and not named.endswith(POST_ALONE):
                seen.add(kind)
                waiting.append(named)
        assert len(seen) < most_replies
    assert f"{address}jobs/{job}/results" in asked
    assert f"{address}map/page.js" in asked


def test_the_deployment_of_the_example_is_right(http: httpx.Client, address: str):
    assert http.get("readyz").json()["parts"]["address"] == {"status": "ok"}
    forged = {"X-Forwarded-Prefix": "/evil", "X-Forwarded-Proto": "http", "X-Forwarded-Host": "evil"}
    asked = http.get("readyz", headers=forged).json()
    assert asked["parts"]["address"] == {"status": "ok"}, "the proxy sets what a caller states"
    redirected = http.get(address.rstrip("/"))
    assert (redirected.status_code, redirected.headers["location"]) in (
        (301, address),
        (301, "/amers/"),
    )


def test_a_compressed_tile_that_the_client_has_is_not_sent_again(http: httpx.Client, world: FlatWorld):
    landing = http.get("collections/points/tiles/WebMercatorQuad").json()
    template = next(link["href"] for link in landing["links"] if link["rel"] == "item")
    places = {"{tileMatrix}": "12", "{tileRow}": "1501", "{tileCol}": "2107"}
    url = re.sub(r"\{\w+\}", lambda place: places[place[0]], template)
    tile = http.get(url)
    assert tile.status_code == 200
    tag = tile.headers["etag"]
    again = http.get(url, headers={"If-None-Match": tag})
    assert again.status_code == 304
    if tile.headers["server"].startswith("nginx"):
        assert (tile.headers["content-encoding"], tag[:2]) == ("gzip", "W/")


def test_browsers_sign_in_below_the_path(http: httpx.Client, address: str, secret: str):
    reply = http.post("sign-in", data={"token": secret}, headers={"Origin": address[:-7]})
    assert (reply.status_code, reply.headers["location"]) == (303, address)
    words = {word.strip().lower() for word in reply.headers["set-cookie"].split(";")}
    assert {"path=/amers/", "secure", "httponly"} <= words
    assert reply.headers["strict-transport-security"] == "max-age=31536000"


# Clients


def test_gdal_reads_layers_and_ranges_of_images(
    http: httpx.Client, address: str, secret: str, job: str, tmp_path: Path
):
    header = tmp_path / "header"
    header.write_text(f"Authorization: Bearer {secret}")
    options = {"GDAL_HTTP_HEADER_FILE": str(header), "GDAL_CURL_CA_BUNDLE": os.environ["SSL_CERT_FILE"]}
    pyogrio.set_gdal_config_options(options)
    try:
        frame = pyogrio.read_dataframe(f"OAPIF:{address}", layer="points", PAGE_SIZE=7)
        assert len(frame) == POINTS
    finally:
        pyogrio.set_gdal_config_options(dict.fromkeys(options))
    links = {link.get("title"): link["href"] for link in http.get(f"jobs/{job}").json()["links"]}
    item = http.get(links["scene"].replace("/scenes/", "/collections/scenes/items/")).json()
    with rasterio.Env(**options), rasterio.open(f"/vsicurl/{item['assets']['image']['href']}") as image:
        assert image.read(1).shape == (1200, 1200)


def test_owslib_reads_collections_and_items(address: str, me: dict[str, str]):
    service = Features(address, headers=me)
    assert {"points", "blocks", "density"} <= set(service.feature_collections())
    page = service.collection_items("points", limit=5)
    assert (page["numberReturned"], page["numberMatched"]) == (5, POINTS)
    assert "saliency" in service.collection_queryables("points")["properties"]


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_pystac_client_searches_and_gets_assets(
    http: httpx.Client, address: str, me: dict[str, str], job: str, method: str
):
    catalog = Catalog.open(address, headers=me)
    assert {collection.id for collection in catalog.get_collections()} >= {"points", "scenes"}
    pages = list(catalog.search(collections=["scenes"], method=method, limit=1).pages())
    items = [item for page in pages for item in page]
    assert len(items) == len(pages) >= 1
    assert any("report" in item.assets for item in items)
    for asset in items[-1].assets.values():
        assert asset.href.startswith(address)
        assert http.get(asset.href).status_code == 200


def test_qgis_s_requests_follow_links_from_page_to_page(http: httpx.Client, address: str):
    """The landing page leads to the description, the classes and the collections; then pages follow."""

    def get(url: str, accept: str) -> Any:
        reply = http.get(url, headers={"Accept": accept})
        assert reply.status_code == 200, url
        return reply.json()

    landing = get(address, "application/json")
    links = {link["rel"]: link["href"] for link in landing["links"] if "html" not in link["type"]}
    description = get(links["service-desc"], "application/vnd.oai.openapi+json;version=3.0, */*;q=0.1")
    assert [f"{server['url']}/" for server in description["servers"]] == [address]
    get(links["conformance"], "application/json")
    get(f"{links['data']}/points", "application/json")
    get(f"{links['data']}/points/queryables", "application/schema+json")
    url, ids = f"{links['data']}/points/items?limit=9", []
    while url:
        page = get(url, "application/geo+json, application/json")
        ids += [feature["id"] for feature in page["features"]]
        url = next((link["href"] for link in page["links"] if link["rel"] == "next"), None)
    assert len(set(ids)) == len(ids) == POINTS


def test_tuspy_uploads(http: httpx.Client, address: str, me: dict[str, str], world: FlatWorld):
    tus = TusClient(f"{address}uploads", headers=me)
    uploader = tus.uploader(str(world.image), chunk_size=1_000_000, metadata={"filename": "tuspy.tif"})
    uploader.upload()
    assert_arrived(http, uploader.url, world.image)


def test_tus_js_client_uploads(http: httpx.Client, address: str, secret: str, world: FlatWorld):
    if shutil.which("node") is None or not TUS_JS.is_dir():
        pytest.skip("there is no Node.js or no tus-js-client: run `make page`")
    done = subprocess.run(
        ["node", "-e", UPLOAD_BY_NODE, str(TUS_JS), f"{address}uploads", str(world.image)],
        env={**os.environ, "TOKEN": secret},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert_arrived(http, done.stdout.strip(), world.image)


def assert_arrived(http: httpx.Client, upload: str, image: Path) -> None:
    document = http.get(upload).raise_for_status().json()
    assert document["state"] == "finished"
    scene = http.get(f"scenes/{document['scene']}").json()
    assert scene["sha256"] == hashlib.sha256(image.read_bytes()).hexdigest()


def test_what_has_arrived_of_an_upload_that_breaks_off_is_kept(
    http: httpx.Client, address: str, me: dict[str, str], world: FlatWorld
):
    """A proxy that keeps a body until it is whole would keep it from the service."""
    image = world.image.read_bytes()
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(image))}
    begun = http.post("uploads", headers=headers | {"Upload-Metadata": "filename YS50aWY="})
    url = begun.headers["location"]
    port = int(address.split(":")[2].partition("/")[0])
    context = ssl.create_default_context(cafile=os.environ["SSL_CERT_FILE"])
    with (
        socket.create_connection((HOST, port), timeout=30) as plain,
        context.wrap_socket(plain, server_hostname=HOST) as line,
    ):
        head = {
            "Host": f"{HOST}:{port}",
            **me,
            "Tus-Resumable": "1.0.0",
            "Content-Type": "application/offset+octet-stream",
            "Upload-Offset": "0",
            "Content-Length": str(len(image)),
        }
        lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
        path = url.removeprefix(f"https://{HOST}:{port}")
        line.sendall(f"PATCH {path} HTTP/1.1\r\n{lines}\r\n".encode() + image[:half_px])
        arrived = until(lambda: offset_of(http, url) > 0)
    assert arrived
    assert until(lambda: http.get(url).json()["offset"] <= half_px)


def offset_of(http: httpx.Client, url: str) -> int:
    return int(http.head(url, headers={"Tus-Resumable": "1.0.0"}).headers.get("Upload-Offset", 0))


@one_proxy
def test_the_python_client_registers(address: str, secret: str, world: FlatWorld, tmp_path: Path):
    with Client(address, secret) as client:
        assert len(list(client.points())) == POINTS
        scene = client.upload_scene(world.image, sigma_m=SIGMA_M)
        client.upload_file(scene, world.rpc_text)
        job = client.wait(client.execute("register-scene", {"scene": scene}), timeout_s=90)
        assert job.verdict in ("good", "usable")
        assert (tmp_path / "report.json") in client.download(job, tmp_path)


def test_the_lines_of_the_page_connect_run(
    http: httpx.Client, address: str, secret: str, tmp_path: Path
):
    page = http.get("connect").text
    base = address.rstrip("/")
    for recipe in RECIPES:
        if recipe.client not in ("curl", "OWSLib", "pystac-client"):
            continue
        text = "\n".join(lines.at(base) for lines in recipe.steps)
        assert text.splitlines()[-1].split('"')[0] in page.replace("&#34;", '"')
        (tmp_path / "amers-header").write_text(f"Authorization: Bearer {secret}")
        is_shell = recipe.steps[0].language == "bash"
        shell = ["bash", "-euc"] if is_shell else [sys.executable, "-c"]
        done = subprocess.run(
            [*shell, text],
            cwd=tmp_path,
            env={**os.environ, "TOKEN": secret},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr


def test_curl_speaks_http_2_with_the_proxy(address: str):
    program = program_of("curl", "apt-get install curl")
    command = [program, "-sf", "--http2", "-o", os.devnull, "-w", "%{http_version}", address]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "2"


# The map page


@one_proxy
def test_the_map_page_signs_in_uploads_and_shows_a_scene(
    browser: Browser, address: str, secret: str, world: FlatWorld, job: str
):
    requested: list[str] = []
    faults: list[str] = []
    replies: list[tuple[int, str]] = []
    with browser.new_context(ignore_https_errors=True, reduced_motion="reduce") as context:
        context.on("request", lambda request: requested.append(request.url))
        context.on("weberror", lambda error: faults.append(str(error.error)))
        context.on("response", lambda reply: replies.append((reply.status, reply.url)))
        page = context.new_page()
        page.goto(f"{address}map")
        expect(page.get_by_role("heading", name="Sign in")).to_be_visible()
        page.get_by_label("Token").fill(secret)
        page.keyboard.press("Enter")
        expect(page.get_by_role("heading", name="Control points")).to_be_visible()
        until_drawn(page)
        page.get_by_role("link", name="Scenes").click()
        page.locator("#image").set_input_files(world.image)
        page.locator("#models").set_input_files(world.rpc_text)
        page.get_by_label("Accuracy").fill("6")
        page.get_by_role("button", name="Upload and register").click()
        expect(page.get_by_role("link", name="Open the report")).to_be_visible()
        until_drawn(page)
        page.goto(f"{address}map#/scenes")
        expect(page.get_by_text("scene.tif").first).to_be_visible()
    inside = (address, f"blob:https://{HOST}", "data:")
    assert [url for url in requested if not url.startswith(inside)] == []
    assert any("/tiles/WebMercatorQuad/" in url for url in requested)
    # Before its user has signed in the page asks for what may be public.
    assert faults == [reply for reply in replies if reply[0] >= 400 and reply[0] != 401] == []


# The examples


@pytest.mark.parametrize("name", ["nginx.conf", "Caddyfile"])
def test_an_example_states_the_settings_that_belong_to_it(name: str):
    text = (EXAMPLES / name).read_text()
    for line in ("AMERS_PUBLIC_URL=https://gcp.example.org/amers/", "AMERS_TRUSTED_PROXIES=127.0.0.1"):
        assert line in text
        assert line in (ROOT / "docs" / "operations.md").read_text()
