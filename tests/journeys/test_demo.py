"""The demonstration as a new user runs it, its scene on the map, and what the README does with it."""

import json
import os
import pty
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import httpx
import pyarrow.parquet
import pytest
from playwright.sync_api import Browser, expect

from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import format_rpb
from tests.command_line import Done, amers_here, amers_process
from tests.documents import blocks_of
from tests.journeys.map_page import BUILT
from tests.service_process import Service, free_port, installed_at, until
from tests.similar_pictures import MOST_CHANGED, changed_share, grey

pytestmark = [pytest.mark.long, pytest.mark.thorough]

README = Path(__file__).parents[2] / "README.md"
GUIDE = README.parent / "docs" / "guide.md"
half_a_pixel = 0.5
injected_m = 50.0


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


def amers(*words: str | Path) -> Done:
    return amers_here(words, os.environ)


@pytest.fixture(scope="module")
def demo(open_folder: Path) -> dict:
    folder = open_folder / uuid4().hex[:8]
    folder.mkdir()
    folder.chmod(0o755)
    words = ("demo", "-o", folder / "demo-output", "--json")
    result = amers_process(words, os.environ)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_all_points_made_are_ingested_and_served(demo):
    assert demo["points_produced"] >= 100
    assert demo["points_ingested"] == demo["points_produced"]
    assert demo["points_served"] == demo["points_produced"]


def test_a_model_wrong_by_fifty_metres_comes_to_agree_with_the_block(demo):
    assert demo["ce90_delivered_on_the_earth_m"] == pytest.approx(injected_m, rel=0.05)
    assert demo["ce90_registered_in_frame_px"] < half_a_pixel
    assert demo["verdict"] == "good"
    assert 20 <= demo["points_active"] <= demo["points_matched"] <= demo["points_visible"]


def test_the_error_of_the_block_itself_is_shown_too(demo):
    assert len(demo["frame_error_east_north_up_m"]) == 3
    assert demo["ce90_registered_on_the_earth_m"] > 0.0


def test_the_report_is_at_the_printed_path(demo):
    report = Path(demo["report"])
    assert "<html" in report.read_text(encoding="utf-8")
    assert (report.parent / "refined_RPC.TXT").is_file()
    manifest = json.loads((report.parent / "manifest.json").read_text())
    files = {path.name for path in report.parent.iterdir()}
    assert files == {*manifest["files"], "manifest.json"}, "a whole result, as any registration leaves"


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium: run `make chromium`")
@pytest.mark.skipif(not BUILT.is_file(), reason="the page is not built: run `make page`")
def test_the_pictures_of_the_documents_show_the_pages_as_they_are(demo, tmp_path):
    folder = Path(demo["report"]).parents[1]
    program = README.parent / "scripts" / "make_pictures.py"
    environment = {**os.environ, "PYTHONPATH": str(README.parent)}
    words = [sys.executable, program, folder, tmp_path / "pictures"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    kept = sorted((README.parent / "docs" / "pictures").glob("*.jpg"))
    made = {
        path.name: changed_share(grey(path), grey(tmp_path / "pictures" / path.name)) for path in kept
    }
    changed = {name: f"{share:.1%}" for name, share in made.items() if share > MOST_CHANGED}
    assert not changed, f"{changed} of docs/pictures changed: run `make demo pictures`, look at them"


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused = amers("demo", "-o", tmp_path)
    assert refused.returncode == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--images", "one.tif"), "one.tif"),
        (("--images", "one.tif", "--images", "two.tif", "--gsd-m", "2"), "--gsd-m"),
        (("--images", "one.tif", "--images", "two.tif", "--gsd-m", "20,2"), "finer first"),
    ],
)
def test_an_impossible_production_states_the_reason_and_leaves_nothing(tmp_path, words, says):
    images = [tmp_path / "one.tif", tmp_path / "two.tif"]
    for image in images:
        image.touch()
    there = {image.name: image for image in images}
    refused = amers(
        "production", "run", *(there.get(word, word) for word in words), "-o", tmp_path / "block"
    )
    assert refused.returncode == 2
    assert says in refused.stderr
    assert "Traceback" not in refused.stderr
    assert sorted(tmp_path.iterdir()) == images


def test_a_block_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "block").mkdir()
    first, second = tmp_path / "a.tif", tmp_path / "b.tif"
    first.touch()
    second.touch()
    refused = amers("production", "run", "--images", first, "--images", second, "-o", tmp_path / "block")
    assert refused.returncode == 2
    assert "already exists" in refused.stderr


def lines_of_readme(heading: str, language: str) -> str:
    """The first lines of the README to copy below a heading or below a paragraph that begins in bold."""
    return lines_of(README, heading, language)


def lines_of(document: Path, heading: str, language: str) -> str:
    """The first lines of a document to copy below some text."""
    below = document.read_text(encoding="utf-8").partition(heading)[2]
    match = re.search(rf"```{language}\n(.*?)```", below, re.DOTALL)
    assert match is not None
    return match[1]


def run(words: list[str], service: Service, folder: Path) -> str:
    """What a command prints in a folder, with the store of a service, once it has ended well."""
    environment = {**service.environment, "PYTHONPATH": str(README.parent)}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def first_run(demo, open_folder) -> Iterator[tuple[Service, Path, dict[str, str]]]:
    """A running service, the folder of `demo-output`, and what the commands of the README print."""
    folder = Path(demo["report"]).parents[2]
    printed = {}
    with Service(open_folder / uuid4().hex[:8], AMERS_PUBLIC_POINTS="true") as service:
        activation, *lines, serving = lines_of_readme("## First run", "bash").splitlines()
        assert activation == ". .venv/bin/activate"
        assert serving.split("#")[0].strip() == "amers serve"
        for line in lines:
            command = line.split("#")[0].split()
            assert command[0] == "amers"
            printed[command[2]] = run([sys.executable, "-m", "amers", *command[1:]], service, folder)
        yield service, folder, printed


def test_the_first_run_of_the_readme_registers_the_scene_of_the_demo(first_run):
    _, folder, printed = first_run
    assert re.search(r"^extent +[-\d.,]+$", printed["show"], re.MULTILINE)
    assert "good" in printed["register"]
    assert (folder / "registered" / "report.html").is_file()


def test_the_python_of_the_readme_prints_the_verdict(first_run):
    service, folder, _ = first_run
    program = lines_of_readme("**In Python**", "python")
    assert run([sys.executable, "-c", program], service, folder).strip() == "good"


@pytest.fixture(scope="module")
def reader(first_run) -> tuple[Service, Path]:
    """The service and the folder, which has the files of the names that the guide gives, and a token."""
    service, folder, _ = first_run
    for name, place in (("scene.tif", "images/scene.tif"), ("my-block", "block")):
        (folder / name).symlink_to(folder / "demo-output" / place)
    (folder / "scene.RPB").write_text(format_rpb(read_rpc(folder / "scene.tif").model))
    token = ["token", "create", uuid4().hex, "--scope", "register"]
    secret = run([sys.executable, "-m", "amers", *token], service, folder).strip()
    service.environment["TOKEN"] = secret
    return service, folder


@pytest.mark.parametrize("heading", ["One command does the same", "## The library"])
def test_the_python_of_the_guide_runs_as_it_is(reader, heading):
    service, folder = reader
    program = lines_of(GUIDE, heading, "python").replace("http://127.0.0.1:8000", service.url)
    assert run([sys.executable, "-c", program], service, folder).strip() == "good"


def test_the_curl_lines_of_the_guide_register_a_scene_and_read_points(reader):
    service, folder = reader
    blocks = "".join(block.text for block in blocks_of("docs/guide.md") if "curl" in block.text)
    texts = blocks.replace("http://127.0.0.1:8000", service.url).replace("\\\n", " ").splitlines()
    *settings, upload, model, execute, status, results, report, items, parquet = filter(None, texts)
    known: dict[str, str] = {}

    def reply(line: str) -> str:
        for name, value in known.items():
            line = line.replace(name, value)
        line = line.replace("curl ", "curl --silent --show-error --fail-with-body ", 1)
        return run(["bash", "-ec", "\n".join([*settings, line])], service, folder)

    known["SCENE_ID"] = json.loads(reply(upload))["id"]
    reply(model)
    known["JOB_ID"] = json.loads(reply(execute))["jobID"]
    assert until(lambda: json.loads(reply(status))["status"] not in ("accepted", "running"))
    assert json.loads(reply(results))["verdict"] == "good"
    reply(report)
    assert "<html" in (folder / "report.html").read_text(encoding="utf-8")
    assert len(json.loads(reply(items))["features"]) == 10
    reply(parquet)
    assert pyarrow.parquet.read_table(folder / "points.parquet").num_rows > 0


@pytest.mark.skipif(shutil.which("ogr2ogr") is None, reason="Debian's gdal-bin is not installed")
def test_gdal_reads_what_the_readme_makes(first_run):
    service, folder, _ = first_run
    lines = lines_of_readme("**In GDAL**", "bash").replace("http://127.0.0.1:8000", service.url)
    printed = run(["bash", "-ec", lines], service, folder)
    assert "LINE_OFF" in printed
    assert (folder / "map.tif").is_file()
    assert (folder / "points.gpkg").is_file()


@pytest.fixture(scope="module")
def store(demo) -> Path:
    """The store that the demonstration leaves."""
    return Path(demo["report"]).parents[1] / "store"


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
