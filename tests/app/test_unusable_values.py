"""Values that JSON cannot carry, and reference systems that do not exist, are refused when requested."""

import json
from base64 import b64encode
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.testclient import TestClient

from amers.app.json_values import unusable_body, unusable_value
from amers.app.usecases.jobs import PROCESSES
from tests.app.callers import Caller

JSON = {"Content-Type": "application/json"}
TIFF = b"II*\0" + bytes(100)
VALUES = ("NaN", "-Infinity", '"NaN"', '"\\ud800"')
NO_CRS = (
    "nonsense",
    "EPSG:999999",
    "EPSG:",
    "epsg:32631",
    "EPSG:32631\u0000",
    "EPSG:4978",
    "ESRI:104903",
    "+proj=utm +zone=31",
    "+proj=pipeline +step +proj=axisswap +order=2,1",
    "+init=/etc/passwd:root",
    "/etc/passwd",
    "file:///etc/passwd",
    "http://169.254.169.254/latest",
    "urn:ogc:def:crs:EPSG::32631",
    'GEOGCS["x"]',
    "",
)
"""Unknown codes, those of heights, of the Earth's centre, of the Moon, definitions and addresses."""


@pytest.fixture
def inputs(admin: Caller) -> dict[str, dict[str, Any]]:
    """Inputs of every process that lack nothing; a new process needs a line here."""
    scene, other = (admin.scene(TIFF, f"name={name}.tif") for name in "ab")
    return {
        "register-scene": {"scene": scene},
        "register-scenes": {"scenes": [scene, other]},
        "view-scene": {"scene": scene},
        "read-model": {"scene": scene},
        "map-scene": {"scene": scene, "registration": scene},
        "orthorectify": {"scene": scene, "dem": "dem.tif"},
        "straighten-scene": {"scene": scene, "registration": scene},
        "make-surface": {"scenes": [scene, other]},
        "make-mosaic": {"scenes": [scene, other]},
        "correct-vectors": {"scene": scene, "vectors": "a.geojson", "dem": "dem.tif"},
        "project-vectors": {"scene": scene, "vectors": "a.geojson", "dem": "dem.tif"},
        "ingest-block": {"path": "block"},
        "export-block": {"block": "flat"},
        "assess-block": {"block": "flat"},
        "renew-block": {"block": "flat", "jobs": [scene]},
        "make-base": {"id": "valley", "bbox": [5.9, 43.5, 6.1, 43.7]},
    }


def leaves(
    schema: dict[str, Any], definitions: dict[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[str, ...]]:
    """The paths of all values in a JSON Schema that are no objects."""
    for option in schema.get("anyOf", ()):
        if "$ref" in option:
            schema = option
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rsplit("/", 1)[1]]
    if "properties" not in schema:
        yield path
    for name, member in schema.get("properties", {}).items():
        yield from leaves(member, definitions, (*path, name))


def document(base: dict[str, Any], path: tuple[str, ...], value: str) -> str:
    """A JSON document with a value, as written, at a path."""
    marker = "the value"
    inner: Any = marker
    for name in reversed(path[1:]):
        inner = {name: inner}
    return json.dumps({**base, path[0]: inner}).replace(json.dumps(marker), value)


@pytest.mark.thorough
@pytest.mark.parametrize("process_id", PROCESSES)
def test_no_input_of_a_process_accepts_what_json_cannot_carry(
    client: TestClient, admin: Caller, inputs: dict[str, dict[str, Any]], process_id: str
):
    schema = PROCESSES[process_id].input_schema()
    url, number = f"/processes/{process_id}/execution", 0
    for path in leaves(schema, schema.get("$defs", {})):
        for value in VALUES:
            body = f'{{"inputs": {document(inputs[process_id], path, value)}}}'
            reply = client.post(url, content=body, headers=admin | JSON)
            number += 1
            assert reply.status_code < 500, (path, value, reply.text)
            if value != '"NaN"':
                assert reply.status_code == 422, (path, value, reply.text)
                assert ".".join(path) in reply.json()["detail"]
    assert number >= len(VALUES)


def test_an_option_without_a_finite_value_is_named(
    client: TestClient, admin: Caller, inputs: dict[str, dict[str, Any]]
):
    for value in ["NaN", "Infinity", "1e999", '"inf"']:
        body = f'{{"inputs": {document(inputs["orthorectify"], ("map", "gsd_m"), value)}}}'
        reply = client.post("/processes/orthorectify/execution", content=body, headers=admin | JSON)
        assert reply.status_code == 422, value
        assert "inputs.map.gsd_m: a finite number expected" in reply.json()["detail"], value


@pytest.mark.thorough
def test_every_body_of_the_api_is_free_of_what_json_cannot_carry(client: TestClient, admin: Caller):
    described = client.get("/api").json()
    definitions, number = described["components"]["schemas"], 0
    for path, methods in described["paths"].items():
        filled = "/".join("1" if part.startswith("{") else part for part in path.split("/"))
        for method, operation in methods.items():
            content = operation.get("requestBody", {}).get("content", {})
            if "application/json" not in content:
                continue
            for place in leaves(content["application/json"]["schema"], definitions):
                for value in ("NaN", '["\\udfff"]', '{"\\ud800": 1}'):
                    body = document({}, place, value) if place else value
                    reply = client.request(method, filled, content=body, headers=admin | JSON)
                    number += 1
                    assert 400 <= reply.status_code < 500, (method, path, place, value, reply.text)
    assert number > 50


@pytest.mark.thorough
def test_no_parameter_of_the_api_accepts_numbers_that_are_none(client: TestClient, admin: Caller):
    number = 0
    for path, methods in client.get("/api").json()["paths"].items():
        filled = "/".join("%ED%A0%80" if part.startswith("{") else part for part in path.split("/"))
        for method, operation in methods.items():
            for parameter in operation.get("parameters", ()):
                for value in ("nan", "%ED%A0%80"):
                    headers, query = dict(admin), ""
                    if parameter["in"] == "query":
                        query = f"?{parameter['name']}={value}"
                    elif parameter["in"] == "header":
                        headers[parameter["name"]] = value
                    reply = client.request(method, filled + query, headers=headers)
                    number += 1
                    assert reply.status_code < 500, (method, filled + query, reply.text)
    assert number > 100


@pytest.mark.parametrize(
    "disposition",
    [
        b"attachment; filename=\xed\xa0\x80.tif",
        b"attachment; filename*=UTF-8''%ED%A0%80.tif",
        b"attachment; filename*=utf-16''%D8%00.tif",
        b"attachment; filename*=no-such-code''a.tif",
        b"attachment; filename*0*=UTF-8''a; filename*1=%ff.tif",
    ],
)
def test_the_name_of_a_file_is_text_however_it_is_encoded(
    client: TestClient, admin: Caller, disposition: bytes
):
    headers = {name.encode(): value.encode() for name, value in admin.items()}
    reply = client.post("/scenes", content=TIFF, headers=headers | {b"Content-Disposition": disposition})
    assert reply.status_code in (201, 422), reply.text


def test_metadata_of_an_upload_is_text(client: TestClient, admin: Caller):
    for value in (b"\xed\xa0\x80.tif", b"a\0.tif", "\udcff.tif".encode("utf-8", "surrogatepass")):
        metadata = f"filename {b64encode(value).decode()}"
        headers = {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Metadata": metadata}
        assert client.post("/uploads", headers=admin | headers).status_code in (400, 422)


def test_a_reference_system_that_is_none_is_refused_when_it_is_requested(
    client: TestClient, admin: Caller, inputs: dict[str, dict[str, Any]]
):
    for process_id, path, of_another_kind in [
        ("orthorectify", ("map", "crs"), "EPSG:5773"),
        ("orthorectify", ("vertical",), "EPSG:4326"),
        ("correct-vectors", ("crs",), "EPSG:5773"),
        ("correct-vectors", ("vertical",), "EPSG:4326"),
        ("project-vectors", ("vertical",), "EPSG:4326"),
        ("register-scene", ("check_heights",), "EPSG:4326"),
    ]:
        for name in (*NO_CRS, of_another_kind):
            body = f'{{"inputs": {document(inputs[process_id], path, json.dumps(name))}}}'
            reply = client.post(f"/processes/{process_id}/execution", content=body, headers=admin | JSON)
            assert reply.status_code == 422, (name, reply.text)
            assert ".".join(path) in reply.json()["detail"], process_id


def test_known_reference_systems_are_accepted(
    client: TestClient, admin: Caller, inputs: dict[str, dict[str, Any]]
):
    for process_id, path, name in (
        ("orthorectify", ("map", "crs"), "EPSG:32631"),
        ("orthorectify", ("map", "crs"), "EPSG:4326"),
        ("orthorectify", ("map", "crs"), "OGC:CRS84"),
        ("orthorectify", ("vertical",), "EGM96"),
        ("orthorectify", ("vertical",), "EPSG:5773"),
        ("correct-vectors", ("crs",), "EPSG:2154"),
        ("register-scene", ("check_heights",), "ellipsoid"),
        ("register-scene", ("check_heights",), "EPSG:3855"),
    ):
        body = f'{{"inputs": {document(inputs[process_id], path, json.dumps(name))}}}'
        reply = client.post(f"/processes/{process_id}/execution", content=body, headers=admin | JSON)
        assert reply.status_code == 201, reply.text


def test_the_quick_look_at_a_body_misses_nothing():
    for body in (b'{"a": [1, NaN]}', b'{"a": 1e400}', b'{"a": -Infinity}', b"1" * 400 + b".0"):
        assert "a finite number expected" in (unusable_body(body) or "")
    for body in (b'"\\ud83d"', b'"\\uDE00"', b'"\xed\xa0\x80"', '"\\ud800"'.encode("utf-16")):
        assert "surrogate" in (unusable_body(body) or "")
    assert unusable_body(b'{"NaN": "Infinity \\ud83d\\ude00 1e400"}') is None
    assert unusable_value({"a": {"b": [0.0, float("inf")]}}, "inputs") == (
        "inputs.a.b.1: a finite number expected, an infinite one found"
    )
