"""The files of the map page, as they are served."""

import json
import os
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from gzip import compress
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from amers.app.main import create_app
from amers.app.web import page

ROOT = Path(__file__).parents[2]


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page of two files, instead of what may have been built here."""
    monkeypatch.setattr(page, "BUILT", tmp_path)
    for name, text in (("index.html", "<p>page</p>"), ("page.js", "let page"), ("page.js.gz", "zipped")):
        (tmp_path / name).write_text(text)
    return tmp_path


def test_the_page_lets_no_script_in_from_elsewhere(client, built):
    reply = client.get("/map", headers={"Accept-Encoding": "identity"})
    assert reply.status_code == 200
    assert reply.headers["content-type"].startswith("text/html")
    policy = reply.headers["content-security-policy"].split("; ")
    assert policy == [
        "default-src 'none'",
        "script-src 'self'",
        "worker-src 'self'",
        "connect-src 'self'",
        "img-src 'self' blob: data:",
        "style-src 'self' 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]


def test_the_policy_lets_in_the_site_of_the_background_and_only_for_data(settings, built):
    """Without a setting, connections go to this site only."""
    tiles = "https://tiles.example:8443/{z}/{x}/{y}.png"
    for chosen, connections in (
        ({}, "connect-src 'self'"),
        ({"map_background": "/tiles/{z}/{x}/{y}.png"}, "connect-src 'self'"),
        ({"map_background": tiles}, "connect-src 'self' https://tiles.example:8443"),
    ):
        with TestClient(create_app(settings.model_copy(update=chosen))) as client:
            policy = (
                client.get("/map", headers={"Accept-Encoding": "identity"})
                .headers["content-security-policy"]
                .split("; ")
            )
            told = client.get("/map/background.json").json()
        assert connections in policy
        without = [one for one in policy if one != connections]
        assert len(without) == len(policy) - 1 == 8
        assert {"script-src 'self'", "default-src 'none'"} < set(without)
        assert "tiles.example" not in " ".join(without)
        assert told["tiles"] == chosen.get("map_background")


def test_a_file_is_compressed_only_for_those_who_take_it(client, built):
    reply = client.get("/map/page.js", headers={"Accept-Encoding": "identity"})
    assert (reply.text, "content-encoding" in reply.headers) == ("let page", False)
    (built / "page.js.gz").write_bytes(compress(b"let page"))
    zipped = client.get("/map/page.js", headers={"Accept-Encoding": "gzip"})
    assert (zipped.text, zipped.headers["content-encoding"]) == ("let page", "gzip")


def test_what_the_browser_has_is_not_sent_again(client, built):
    plain = {"Accept-Encoding": "identity"}
    first = client.get("/map/page.js", headers=plain)
    again = client.get("/map/page.js", headers={**plain, "If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("name", ["nothing.js", "page.js.gz", "..%2Fpage.py", "%2E%2E"])
def test_nothing_but_the_page_is_served(client, built, name):
    assert client.get(f"/map/{name}").status_code == 404


def test_an_installation_without_the_page_says_so_at_its_address(client, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "BUILT", tmp_path / "not built")
    reply = client.get("/map")
    assert reply.status_code == 404
    assert "make page" in reply.json()["detail"]


def test_the_lock_file_has_versions_and_no_addresses():
    text = (ROOT / "web" / "package-lock.json").read_text()
    assert "://" not in text
    assert "resolved" not in text
    wanted = json.loads((ROOT / "web" / "package.json").read_text())["devDependencies"]
    assert [version for version in wanted.values() if not version[0].isdigit()] == []


@pytest.mark.thorough
def test_the_types_of_the_page_are_those_of_the_api_and_the_report():
    script = ROOT / "scripts" / "make_api_types.py"
    check = subprocess.run(
        [sys.executable, script, "--check"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert check.returncode == 0, check.stdout + check.stderr


def test_the_modules_of_the_page_import_each_other_in_no_circle():
    sources = (ROOT / "web" / "source").glob("*.ts")
    imported = {
        one.stem: set(re.findall(r'from "\./(\w+)"', one.read_text(encoding="utf-8"))) for one in sources
    }
    assert "api" in imported["main"]
    # Raises CycleError, which names the modules.
    assert list(TopologicalSorter(imported).static_order())[-1] == "main"
