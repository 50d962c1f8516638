"""Standard clients: pystac-client searches scenes, OWSLib registers them."""

import json
from typing import Any

import httpx
import pytest
from jsonschema import validate
from owslib.ogcapi.processes import Processes
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.view import ViewExtension
from pystac.validation import validate_dict
from pystac_client import Client
from shapely.geometry import box, mapping, shape

from amers.app.usecases.features.stac import RESULTS
from amers.app.usecases.registration.deliverables import OUTPUTS
from tests.app.flat_world import CENTRE, SIGMA_M, FlatWorld, make_flat_world
from tests.service_process import Service, until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

a_hundredth_of_a_degree = 0.01
SCENES = 3
"""The first one is registered."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def me(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


@pytest.fixture(scope="module")
def http(service: Service, amers, me: dict[str, str], world: FlatWorld):
    amers("block", "ingest", world.block, "--publish")
    with httpx.Client(base_url=service.url, headers=me, timeout=60.0) as http:
        yield http


@pytest.fixture(scope="module")
def scenes(http: httpx.Client, world: FlatWorld) -> list[str]:
    """The ids of scenes, each an image with the file of its model."""
    ids = []
    for number in range(SCENES):
        query = f"/scenes?name=scene{number}.tif&sigma_m={SIGMA_M}"
        scene = http.post(query, content=world.image.read_bytes()).raise_for_status().json()["id"]
        model = f"/scenes/{scene}/files/scene{number}_RPC.TXT"
        http.put(model, content=world.rpc_text.read_bytes()).raise_for_status()
        ids.append(scene)
    return ids


@pytest.fixture(scope="module")
def processes(service: Service, me: dict[str, str]) -> Processes:
    return Processes(service.url, headers=me)


@pytest.fixture(scope="module")
def job(http: httpx.Client, processes: Processes, scenes: list[str]) -> dict[str, Any]:
    """The registration of the first scene, started by OWSLib, after its end."""
    told = processes.execute("register-scene", {"scene": scenes[0]}, async_=True)
    assert processes.response_headers["location"].endswith(f"/jobs/{told['jobID']}")
    assert processes.response_headers["preference-applied"] == "respond-async"
    return ended(http, told["jobID"])


def ended(http: httpx.Client, job_id: str) -> dict[str, Any]:
    def now() -> dict[str, Any]:
        return dict(http.get(f"/jobs/{job_id}").raise_for_status().json())

    assert until(lambda: now()["status"] not in ("accepted", "running"))
    return now()


@pytest.fixture(scope="module")
def catalog(service: Service, me: dict[str, str], job: dict[str, Any]) -> Client:
    assert job["status"] == "successful", job
    return Client.open(service.url, headers=me)


# OWSLib


def test_owslib_reads_the_descriptions_of_the_processes(processes: Processes):
    names = {process["id"] for process in processes.processes()}
    assert names >= {"register-scene", "orthorectify", "ingest-block", "export-block"}
    described = processes.process("register-scene")
    assert described["inputs"]["scene"]["schema"]["format"] == "uuid"
    assert set(described["outputs"]) >= {*OUTPUTS, "verdict"}
    classes = processes.conformance()["conformsTo"]
    assert "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/core" in classes


def test_owslib_registers_a_scene(http: httpx.Client, job: dict[str, Any]):
    assert (job["status"], job["progress"], job["processID"]) == ("successful", 100, "register-scene")
    said = [entry["message"] for entry in http.get(f"/jobs/{job['jobID']}/messages").json()["messages"]]
    assert said[:2] == ["waiting for a worker", "started"]
    assert said[-1] == job["message"]
    # Progress is reported every half second: a quick registration reports one step.
    assert len(said) > 3, "steps of the work between"
    results = http.get(f"/jobs/{job['jobID']}/results").json()
    assert results["verdict"] in ("good", "usable")
    files = {name for name, value in results.items() if isinstance(value, dict) and "href" in value}
    assert files == {*OUTPUTS, "scene0_RPC.TXT"}
    assert results["relative_to_control_points"]["ce90_m"] > 0
    assert results["on_the_earth"]["ce90_m"] is None, "the frame of the block is not stated"


def test_owslib_gets_a_report_by_value_and_a_model_by_reference(
    http: httpx.Client, processes: Processes, scenes: list[str], job: dict[str, Any]
):
    wanted: dict[str, Any] = {
        "report.json": {},
        "verdict": {},
        "refined_RPC.TXT": {"transmissionMode": "reference"},
    }
    told = processes.execute("register-scene", {"scene": scenes[0]}, wanted, async_=True)
    course = http.get(f"/jobs/{told['jobID']}").json()
    assert course["status"] != "accepted" or "amers:estimatedEnd" in course, "one like it was done"
    done = ended(http, told["jobID"])
    results = http.get(f"/jobs/{done['jobID']}/results").json()
    assert set(results) == set(wanted)
    report = results["report.json"]["value"]
    validate(report, http.get("/schemas/report.json").json())
    assert report["verdict"] == results["verdict"]
    model = http.get(results["refined_RPC.TXT"]["href"]).text
    assert model.startswith("LINE_OFF")


# pystac-client


def test_pystac_client_reads_a_catalog_and_collections_that_follow_the_schema(catalog: Client):
    assert (catalog.id, catalog.title) == ("amers", "Amers")
    for name in ("CORE", "COLLECTIONS", "FEATURES", "ITEM_SEARCH", "FILTER", "SORT"):
        catalog.add_conforms_to(name)
    assert len(catalog.get_conforms_to()) == len(set(catalog.get_conforms_to())), "all were told before"
    validate_dict(catalog.to_dict(transform_hrefs=False))
    collections = {collection.id: collection for collection in catalog.get_collections()}
    assert set(collections) >= {"points", "blocks", "scenes"}
    for collection in collections.values():
        validate_dict(collection.to_dict(transform_hrefs=False))
    scenes = catalog.get_collection("scenes")
    west, south, east, north = scenes.extent.spatial.bboxes[0]
    assert (
        box(west, south, east, north)
        .buffer(a_hundredth_of_a_degree)
        .contains(shape({"type": "Point", "coordinates": list(CENTRE)}))
    )
    assert scenes.extent.temporal.intervals[0][0] is not None


def test_pystac_client_reads_items_that_follow_the_schema(
    catalog: Client, scenes: list[str], http: httpx.Client, world: FlatWorld
):
    items = {item.id: item for item in catalog.get_collection("scenes").get_items()}
    assert set(items) == set(scenes)
    for item in items.values():
        # The schemas of extensions need the network; what the extensions read of an item is checked.
        validate_dict(item.to_dict(transform_hrefs=False), extensions=[])
    assert items[scenes[1]].geometry is None, "its files are opened by the job that uses them"
    item = catalog.get_collection("scenes").get_item(scenes[0])
    assert item.datetime == items[scenes[0]].datetime
    assert item.assets.keys() == items[scenes[0]].assets.keys()
    assert ProjectionExtension.ext(item).shape == [1200, 1200]
    assert ProjectionExtension.ext(item).code is None
    assert ViewExtension.ext(item).sun_elevation is None, "the files do not say"
    assert item.properties["amers:verdict"] in ("good", "usable")
    assert shape(item.geometry).contains(shape({"type": "Point", "coordinates": list(CENTRE)}))
    assert set(item.assets) == {
        "image",
        "scene0_RPC.TXT",
        "refined-scene0_RPC.TXT",
        *(RESULTS.get(name, name) for name in OUTPUTS),
    }
    assert http.get(item.assets["image"].href).content == world.image.read_bytes()
    assert http.get(item.assets["scene0_RPC.TXT"].href).content == world.rpc_text.read_bytes()
    report = http.get(item.assets["report"].href).json()
    assert report["verdict"] == item.properties["amers:verdict"]
    for asset in item.assets.values():
        reply = http.get(asset.href)
        assert reply.status_code == 200
        assert reply.headers["content-type"].startswith(asset.media_type.split(";")[0])


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_pystac_client_searches(catalog: Client, scenes: list[str], method: str):
    def found(**asked: Any) -> list[str]:
        return [item.id for item in catalog.search(method=method, **asked).items()]

    lon, lat = CENTRE
    around = (lon - 0.01, lat - 0.01, lon + 0.01, lat + 0.01)
    away = (lon + 1.0, lat, lon + 2.0, lat + 1.0)
    assert found(bbox=around) == found(intersects=mapping(box(*around))) == [scenes[0]]
    assert found(bbox=away) == found(intersects=mapping(box(*away))) == []
    assert sorted(found()) == sorted(found(collections=["scenes"])) == sorted(scenes)
    assert found(collections=["points"]) == []
    assert sorted(found(ids=scenes[1:])) == sorted(scenes[1:])
    assert sorted(found(datetime="2020-01-01/..")) == sorted(scenes)
    assert found(datetime="../2020-01-01") == []
    assert found(sortby="+properties.title") == scenes
    assert found(sortby="-properties.title") == scenes[::-1]
    named = {"op": "=", "args": [{"property": "title"}, "scene1.tif"]}
    assert found(filter=named, filter_lang="cql2-json") == [scenes[1]]
    assert found(filter="\"amers:verdict\" IN ('good','usable')", filter_lang="cql2-text") == [scenes[0]]


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_pystac_client_follows_pages_to_the_last(catalog: Client, scenes: list[str], method: str):
    search = catalog.search(method=method, limit=1, sortby="properties.created", bbox=None)
    pages = list(search.pages_as_dicts())
    assert [len(page["features"]) for page in pages] == [1] * SCENES
    assert [page["features"][0]["id"] for page in pages] == scenes
    assert search.matched() == SCENES


def test_only_their_owners_see_scenes(service: Service, amers, catalog: Client):
    stranger = amers("token", "create", "stranger", "--scope", "register")["secret"]
    headers = {"Authorization": f"Bearer {stranger}"}
    assert list(Client.open(service.url, headers=headers).search().items()) == []
    assert httpx.get(f"{service.url}/search").status_code == 401
    reader = amers("token", "create", "reader", "--scope", "read")["secret"]
    refused = httpx.get(f"{service.url}/search", headers={"Authorization": f"Bearer {reader}"})
    assert refused.status_code == 403


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ({"bbox": [1, 2, 3]}, "bbox"),
        ({"bbox": "1,2,3,4"}, "bbox"),
        ({"bbox": [0, 0, 1, 1], "intersects": mapping(box(0, 0, 1, 1))}, "intersects"),
        ({"intersects": {"type": "Circle"}}, "geometry"),
        ({"datetime": "yesterday"}, "datetime"),
        ({"limit": 0}, "limit"),
        ({"limit": "many"}, "limit"),
        ({"sortby": [{"field": "colour"}]}, "sortby"),
        ({"filter": {"op": "pg_sleep", "args": [9]}}, "filter"),
        ({"token": "AAAA"}, "token"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_searches_that_cannot_be_used_are_refused_by_name(
    http: httpx.Client, body: dict[str, Any], named: str
):
    reply = http.post("/search", json=body)
    assert (reply.status_code, reply.headers["content-type"]) == (400, "application/problem+json")
    assert named in json.dumps(reply.json())
