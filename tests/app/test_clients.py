"""Unmodified standard clients on a service that is a separate process.

They receive a token as in practice: GDAL by a setting, OWSLib by an argument. The lines of the page
`/connect` run as its readers run them, one after the other in a folder.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import geopandas
import httpx
import numpy as np
import pyogrio
import pytest
from numpy.testing import assert_allclose
from owslib.ogcapi.features import Features
from pyproj import CRS

from amers.app.api.connect import EXAMPLE, RECIPES, Recipe, as_markdown
from tests.app.running_service import Served, service_with_a_block

BOX = (5.22, 43.21, 5.27, 43.26)
WHERE = "saliency > 0.5 AND n_views = 3"
a_tenth_of_a_millimetre_deg = 1e-9
in_single_precision = 1e-7


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory) -> Iterator[Served]:
    with service_with_a_block(cluster, tmp_path_factory.mktemp("served"), "register") as served:
        yield served


@pytest.fixture
def in_box(served) -> np.ndarray:
    lon, lat = served.points.lon_lat_h[:, 0], served.points.lon_lat_h[:, 1]
    return (lon >= BOX[0]) & (lon <= BOX[2]) & (lat >= BOX[1]) & (lat <= BOX[3])


@pytest.fixture
def in_box_and_strong(served, in_box) -> np.ndarray:
    return in_box & (served.points.saliency > 0.5)


@pytest.fixture
def header_file(served) -> str:
    """The caller's header in a file, for GDAL."""
    path = served.folder / "header"
    path.write_text(f"Authorization: {served.authorization['Authorization']}")
    return str(path)


@pytest.fixture
def source(served, header_file) -> Iterator[str]:
    """The GDAL name of the service, with the token in GDAL's setting; GDAL prints the requests."""
    options = {"GDAL_HTTP_HEADER_FILE": header_file, "CPL_DEBUG": "ON"}
    pyogrio.set_gdal_config_options(options)
    yield f"OAPIF:{served.url}"
    pyogrio.set_gdal_config_options(dict.fromkeys(options))


def fetched(capture) -> list[str]:
    """The item requests of GDAL since the last call."""
    output = "".join(capture.readouterr())
    return [line for line in output.splitlines() if "Fetch(" in line and "/items?" in line]


def test_gdal_knows_layers_their_fields_number_and_reference_system_without_reading_them(source):
    assert {"points", "blocks", "density"} <= set(pyogrio.list_layers(source)[:, 0])
    info = pyogrio.read_info(source, layer="points")
    assert info["features"] == 60
    assert CRS(info["crs"]).equals(CRS("OGC:CRS84h"))
    assert info["geometry_type"] == "Point Z"
    kinds = dict(zip(info["fields"].tolist(), info["dtypes"].tolist(), strict=True))
    assert kinds["saliency"] == "float64"
    assert kinds["n_views"].startswith("int")
    assert kinds["first_view"] == "datetime64[D]"
    assert_allclose(info["total_bounds"], [5.2, 43.2, 5.3, 43.3], atol=1e-9)


def test_gdal_reads_all_points_page_by_page_with_heights(served, source, capfd):
    frame = pyogrio.read_dataframe(source, layer="points", PAGE_SIZE=7)
    found = np.column_stack([frame.geometry.x, frame.geometry.y, frame.geometry.z])
    assert_allclose(found, served.points.lon_lat_h, rtol=0, atol=a_tenth_of_a_millimetre_deg)
    assert_allclose(frame["saliency"], served.points.saliency, rtol=in_single_precision)
    assert frame["typology"].isna().sum() == 15
    following = [line for line in fetched(capfd) if "limit=7" in line and "token=" in line]
    assert len(following) == 60 // 7


def test_gdal_leaves_a_box_and_a_filter_to_the_service(served, source, in_box, in_box_and_strong, capfd):
    assert 0 < in_box_and_strong.sum() < in_box.sum()
    frame = pyogrio.read_dataframe(source, layer="points", bbox=BOX, where=WHERE)
    assert_allclose(
        np.sort(frame.geometry.x),
        np.sort(served.points.lon_lat_h[in_box_and_strong, 0]),
        atol=a_tenth_of_a_millimetre_deg,
    )
    request = fetched(capfd)[-1]
    assert "bbox=5.2" in request
    for word in ("saliency", "n_views", "filter-lang=cql-text"):
        assert word in request


@pytest.mark.parametrize(
    "where",
    [
        "typology IN ('crossroads', 'building corner')",
        "typology LIKE 'cross%'",
        "NOT (saliency <= 0.5)",
        "saliency BETWEEN 0.2 AND 0.4",
        "typology IS NULL",
        "saliency > 0.9 OR saliency < 0.1",
        "first_view >= '2023-03-01'",
    ],
)
def test_gdal_finds_the_same_by_the_service_s_filter_as_by_its_own(served, source, where, tmp_path):
    everything = tmp_path / "all.fgb"
    reply = httpx.get(
        f"{served.url}/collections/points/items?f=fgb&limit=100", headers=served.authorization
    )
    everything.write_bytes(reply.content)
    by_gdal = pyogrio.read_dataframe(everything, where=where)
    by_service = pyogrio.read_dataframe(source, layer="points", where=where)
    assert len(by_service) == len(by_gdal) > 0


@pytest.mark.skipif(shutil.which("ogr2ogr") is None, reason="Debian's gdal-bin is not installed")
def test_ogrinfo_and_ogr2ogr_of_the_machine_do_the_same(
    served, header_file, in_box_and_strong, tmp_path
):
    environment = {
        **os.environ,
        "GDAL_HTTP_HEADER_FILE": header_file,
        "CPL_DEBUG": "ON",
    }
    box, copied = [str(value) for value in BOX], tmp_path / "copied.gpkg"

    def run(*arguments: str) -> str:
        result = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True)
        return result.stdout + result.stderr

    output = run("ogrinfo", "-so", f"OAPIF:{served.url}", "points")
    assert "Feature Count: 60" in output
    assert "Geometry: 3D Point" in output
    layer = (f"OAPIF:{served.url}", "points")
    output = run("ogr2ogr", "-spat", *box, "-where", WHERE, str(copied), *layer)
    assert "filter=" in output
    frame = geopandas.read_file(copied)
    assert len(frame) == in_box_and_strong.sum() > 0
    assert_allclose(
        np.sort(frame.geometry.z), np.sort(served.points.lon_lat_h[in_box_and_strong, 2]), atol=1e-9
    )


def test_owslib_finds_collections_queryables_and_features(served, in_box):
    service = Features(served.url, headers=served.authorization)
    declared = service.conformance()["conformsTo"]
    assert "http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/core" in declared
    assert {"points", "blocks", "density"} <= set(service.feature_collections())
    assert service.collection("points")["storageCrs"].endswith("CRS84h")
    assert "saliency" in service.collection_queryables("points")["properties"]
    assert service.collection_schema("points")["properties"]["id"]["x-ogc-role"] == "id"
    page = service.collection_items("points", bbox=list(BOX), limit=5)
    assert (page["numberReturned"], page["numberMatched"]) == (5, in_box.sum())
    strong = service.collection_items("points", filter="saliency > 0.5", limit=100)
    assert strong["numberReturned"] == (served.points.saliency > 0.5).sum()
    first = page["features"][0]
    alone = service.collection_item("points", str(first["id"]))
    assert_allclose(
        alone["geometry"]["coordinates"],
        first["geometry"]["coordinates"],
        atol=a_tenth_of_a_millimetre_deg,
    )


def test_a_client_that_follows_next_as_qgis_does_sees_every_point_once(served):
    with httpx.Client(headers=served.authorization) as client:
        url, seen = f"{served.url}/collections/points/items?limit=9", []
        while url:
            page = client.get(url, headers={"Accept": "application/geo+json"}).json()
            seen += [feature["id"] for feature in page["features"]]
            url = next((link["href"] for link in page["links"] if link["rel"] == "next"), None)
    assert seen == (2**26 + np.arange(60)).tolist()


def test_clients_without_a_valid_token_get_an_error(served):
    with pytest.raises(RuntimeError, match="401"):
        Features(served.url, headers={"Authorization": "Bearer wrong"}).feature_collections()
    with pytest.raises(pyogrio.errors.DataSourceError, match="401"):
        pyogrio.read_info(f"OAPIF:{served.url}", layer="points")


RUN = [recipe for recipe in RECIPES if recipe.steps[0].language != "text"]
SHOWN = {
    "The token, once": "",
    "curl": '"numberMatched": {}',
    "GDAL 3.6 and 3.12": "Feature Count: 60",
    "geopandas 1": "saliency  n_views",
    "R with sf and httr2": "Simple feature collection with {} features and 2 fields",
    "Python client of Amers": "{} points; Test block calanques",
    "OWSLib": "{} [",
    "pystac-client": "",
    "JavaScript with fetch": "{} points\n",
}
"""What the lines of a client print; `{}` is the number of points in the box."""
SHELLS = {
    "bash": ("bash", "-euo", "pipefail", "-c"),
    "python": (sys.executable, "-c"),
    "r": ("Rscript", "-e"),
    "javascript": ("node", "--input-type=module", "-e"),
}
"""The command that runs lines of a language, which are its last argument."""


@pytest.fixture(scope="module")
def reader_s_folder(served, tmp_path_factory) -> Path:
    """The folder of a reader of the page who has done its first section."""
    folder = tmp_path_factory.mktemp("reader")
    run_lines(RECIPES[0], served, folder)
    assert (folder / "amers-header").stat().st_mode & 0o077 == 0
    return folder


def run_lines(recipe: Recipe, served: Served, folder: Path) -> str:
    """The output of the lines for one client; the token is pasted where they ask for it."""
    text = "\n".join(lines.at(served.url) for lines in recipe.steps)
    return run_text(text, recipe.steps[0].language, served, folder)


def run_text(text: str, language: str, served: Served, folder: Path) -> str:
    """The output of lines of a language; the token is pasted where they ask for it."""
    secret = served.authorization["Authorization"].split()[1]
    result = subprocess.run(
        [*SHELLS[language], text],
        cwd=folder,
        env={**os.environ, "TOKEN": secret},
        input=f"{secret}\n",
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def has_r() -> bool:
    """Whether the machine has R and both of its packages that the page uses."""
    if shutil.which("Rscript") is None:
        return False
    needed = [*SHELLS["r"], "library(sf); library(httr2)"]
    return subprocess.run(needed, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("recipe", RUN, ids=[recipe.client for recipe in RUN])
def test_the_lines_of_the_page_connect_run_as_they_are(recipe, served, reader_s_folder, in_box):
    if "ogr2ogr" in recipe.steps[0].text and shutil.which("ogr2ogr") is None:
        pytest.skip("Debian's gdal-bin is not installed")
    if recipe.steps[0].language == "r" and not has_r():
        pytest.skip("R with sf and httr2 is not installed")
    assert SHOWN[recipe.client].format(in_box.sum()) in run_lines(recipe, served, reader_s_folder)
    if recipe.client == "curl":
        strong = geopandas.read_parquet(reader_s_folder / "points.parquet")
        assert 0 < len(strong) < len(served.points.saliency)
        assert strong["saliency"].min() > 0.3
        assert strong["n_views"].min() >= 3


def test_the_lines_of_javascript_follow_the_links_to_all_pages(served, reader_s_folder, in_box):
    (recipe,) = (recipe for recipe in RECIPES if recipe.client == "JavaScript with fetch")
    text = recipe.steps[0].at(served.url)
    assert in_box.sum() > 7
    pages = text.replace("limit=1000", "limit=7")
    assert pages != text
    printed = run_text(pages, "javascript", served, reader_s_folder)
    assert printed.startswith(f"{in_box.sum()} points\n")
    refused = text.replace("${process.env.TOKEN}", "wrong")
    with pytest.raises(AssertionError, match="Error: 401"):
        run_text(refused, "javascript", served, reader_s_folder)


def test_the_page_connect_has_the_address_of_the_service(served):
    reply = httpx.get(f"{served.url}/connect", headers={"Accept": "text/html"})
    assert reply.status_code == 200
    assert reply.headers["content-type"].startswith("text/html")
    assert reply.headers["content-security-policy"] == (
        "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; form-action 'self'; "
        "frame-ancestors 'none'"
    )
    assert "BASE" not in reply.text
    # Points are not public there: nothing tells where they are.
    assert "bbox=5.22,43.21,5.27,43.26" in reply.text
    assert f"ogrinfo -so OAPIF:{served.url} points" in reply.text
    for recipe in RECIPES:
        assert f"<h2>{recipe.client}</h2>" in reply.text
    landing = httpx.get(f"{served.url}/").json()
    assert f"{served.url}/connect" in [link["href"] for link in landing["links"]]


def test_the_lines_have_a_box_that_the_service_serves(served):
    password = httpx.BasicAuth("anybody", served.authorization["Authorization"].split()[1])
    reply = httpx.get(f"{served.url}/connect", auth=password)
    (box,) = set(re.findall(r"bbox=([-\d.,]+)&", unescape(reply.text)))
    assert box != "5.22,43.21,5.27,43.26"
    for form in (box, box.replace(",", " "), box.replace(",", ", ")):
        assert form in reply.text
    items = f"{served.url}/collections/points/items"
    assert httpx.get(items, params={"bbox": box}, auth=password).json()["numberMatched"] > 0


@pytest.mark.long
def test_the_page_of_the_documentation_is_that_of_the_service():
    root = Path(__file__).parents[2]
    assert (root / "docs" / "connect.md").read_text() == as_markdown(EXAMPLE)
