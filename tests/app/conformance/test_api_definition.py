"""The description of the API: OpenAPI 3.1 and 3.0 of the same, and that what it declares is sent."""

import re

import pytest
from openapi_spec_validator import OpenAPIV30SpecValidator, OpenAPIV31SpecValidator

from amers.app.api.openapi_30 import as_openapi_30
from tests.app.conformance.conftest import COLLECTIONS

OAS_31 = "application/vnd.oai.openapi+json;version=3.1"
OAS_30 = "application/vnd.oai.openapi+json;version=3.0"
OK = 200


@pytest.fixture(scope="module")
def store(store_with_unknowns):
    return store_with_unknowns


@pytest.mark.parametrize(
    ("kind", "validator"), [(OAS_31, OpenAPIV31SpecValidator), (OAS_30, OpenAPIV30SpecValidator)]
)
def test_req_oas30_oas_definition_is_linked_by_its_media_type_and_valid(get, kind, validator):
    links = [one for one in get("/").json()["links"] if one["rel"] == "service-desc"]
    (href,) = (one["href"] for one in links if one["type"] == kind)
    for reply in (get(href), get("/api", accept=kind)):
        assert reply.headers["content-type"] == kind
        document = reply.json()
        assert document["openapi"].startswith(kind[-3:])
        assert document["servers"] == [{"url": "http://testserver"}]
        validator(document).validate()


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        (f"{OAS_30}, application/openapi+json;version=3.0, application/json", OAS_30),
        ("application/json", "application/json"),
        ("application/vnd.oai.openapi+json", OAS_31),
        ("*/*", OAS_31),
        (f"{OAS_31};q=0.5, {OAS_30};q=0.9", OAS_30),
        ("text/html", "text/html; charset=utf-8"),
    ],
)
def test_a_client_gets_the_version_that_it_accepts(get, accept, kind):
    assert get("/api", accept=accept).headers["content-type"] == kind


def test_req_oas30_completeness_both_versions_have_the_same_operations_and_parameters(get):
    new, old = get("/api").json(), get("/api", f="oas30").json()

    def outline(document):
        return {
            (path, method): (
                [(item["in"], item["name"], item["required"]) for item in operation["parameters"]],
                {
                    code: sorted(reply.get("content", {}))
                    for code, reply in operation["responses"].items()
                },
            )
            for path, operations in document["paths"].items()
            for method, operation in operations.items()
        }

    assert outline(new) == outline(old)
    assert set(new["components"]["schemas"]) == set(old["components"]["schemas"])


CONVERTED = (
    ({"type": ["string", "null"]}, {"type": "string", "nullable": True}),
    ({"type": ["string", "integer"]}, {"anyOf": [{"type": "string"}, {"type": "integer"}]}),
    ({"type": "null"}, {"enum": [None], "nullable": True}),
    ({"const": 5}, {"enum": [5]}),
    (
        {"type": "number", "exclusiveMinimum": 0},
        {"type": "number", "minimum": 0, "exclusiveMinimum": True},
    ),
    ({"maximum": 3, "exclusiveMaximum": 2}, {"maximum": 2, "exclusiveMaximum": True}),
    ({"examples": ["a", "b"]}, {"example": "a"}),
    ({"type": "array"}, {"type": "array", "items": {}}),
    (
        {"type": "array", "prefixItems": [{"type": "number"}, {"type": "number"}], "minItems": 2},
        {"type": "array", "items": {"type": "number"}, "minItems": 2},
    ),
    ({"prefixItems": [{}, {"const": 1}]}, {"items": {"anyOf": [{}, {"enum": [1]}]}}),
    (
        {"anyOf": [{"$ref": "#/components/schemas/A"}, {"type": "null"}], "title": "t"},
        {"allOf": [{"$ref": "#/components/schemas/A"}], "nullable": True, "title": "t"},
    ),
    ({"anyOf": [{"type": "string"}, {"type": "null"}]}, {"type": "string", "nullable": True}),
    (
        {"oneOf": [{"const": 1}, {"type": "boolean"}, {"type": "null"}]},
        {"oneOf": [{"enum": [1]}, {"type": "boolean"}], "nullable": True},
    ),
    ({"$ref": "#/a", "description": "d"}, {"allOf": [{"$ref": "#/a"}], "description": "d"}),
    ({"$ref": "#/a"}, {"$ref": "#/a"}),
    ({"type": "object", "patternProperties": {}, "$comment": "c", "if": {}}, {"type": "object"}),
    ({"additionalProperties": {"const": 1}}, {"additionalProperties": {"enum": [1]}}),
    ({"additionalProperties": False, "x-own": [1]}, {"additionalProperties": False, "x-own": [1]}),
    # Names of properties are no words of a schema.
    (
        {"properties": {"const": {"type": "null"}}},
        {"properties": {"const": {"enum": [None], "nullable": True}}},
    ),
    (True, {}),
    ({"items": False}, {"items": {"not": {}}}),
)


@pytest.mark.parametrize(("new", "old"), CONVERTED)
def test_a_schema_of_3_1_is_one_of_3_0(new, old):
    document = {"info": {}, "paths": {}, "components": {"schemas": {"one": new}}}
    assert as_openapi_30(document)["components"]["schemas"]["one"] == old


def test_what_is_declared_of_each_page_is_what_is_sent(get, store):
    """Every GET of the standards: its status, media type and headers, in each format it declares."""
    paths, tried = get("/api").json()["paths"], 0
    wrong: list[tuple[str, str | None, str]] = []
    keys = {name: get(f"/collections/{name}/items").json()["features"][0]["id"] for name in COLLECTIONS}
    for template, operations in paths.items():
        if "get" not in operations or not re.match(
            r"/(collections|conformance|search|tileM|process)", template
        ):
            continue
        name = template.split("/")[2] if template.count("/") > 1 else ""
        path = template.replace("{feature_id}", str(keys.get(name))).replace(
            "{item_id}", str(keys.get(name))
        )
        path = path.replace("{point_id}", str(keys["points"])).replace("{process_id}", "register-scene")
        path = path.replace("{matrix_set}", "WebMercatorQuad").replace("{view}", "0")
        path = path.replace("{z}/{y}/{x}", "0/0/0")
        if "{" in path:
            continue
        operation = operations["get"]
        declared = operation["responses"]["200"]
        content = set(declared.get("content", {}))
        formats = {
            item["name"]: item.get("schema", {}).get("enum") for item in operation["parameters"]
        }.get("f")
        asked = {"ids": keys["points"]} if path == "/collections/points/chips" else {}
        for form in formats or [None]:
            reply = get(path, **asked, **({} if form is None else {"f": form}))
            assert reply.status_code == OK, (path, form, reply.text)
            sent = reply.headers["content-type"].removesuffix("; charset=utf-8")
            wrong += [] if sent in content else [(path, form, sent)]
            headers = {name.lower() for name in declared.get("headers", {})}
            own = {"content-crs", "ogc-numbermatched", "ogc-numberreturned", "amers-next-token", "link"}
            own |= {"content-disposition", "etag"}
            wrong += [(path, form, name) for name in own & set(reply.headers) - headers]
            tried += 1
    assert wrong == []
    assert tried > 60
