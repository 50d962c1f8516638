"""Requests that must be refused: queries, filters, searches, executions, paths."""

from dataclasses import dataclass, field
from typing import Any

from tests.app.hostile_installation import BODY_LIMIT_BYTES

JSON = {"Content-Type": "application/json"}
HUGE = "9" * 400
DEEP = "[" * 20_000
ITEMS = "/collections/points/items"
SEARCH = "/collections/points/search"
EXECUTE = "/processes/register-scene/execution"
NO_ID = "00000000-0000-0000-0000-000000000001"


@dataclass(frozen=True)
class Bad:
    """A request that must be refused.

    Attributes:
        name: what is wrong with the request.
        says: text that the refusal contains.
        who: the caller whose token the request carries.
        status: expected status; None accepts every 4xx.
        json, content: the body; `<name>` in it, path and headers is an id of the installation.
        metadata: metadata of a tus upload.
    """

    name: str
    method: str
    path: str
    says: str
    who: str = "admin"
    status: int | None = None
    json: Any = None
    content: bytes | None = None
    headers: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)


def query(name: str, parameters: str, says: str) -> Bad:
    return Bad(f"query {name}", "GET", f"{ITEMS}?{parameters}", says, "read", 400)


def text_filter(name: str, text: str, says: str = "filter") -> Bad:
    return Bad(
        f"filter {name}",
        "POST",
        SEARCH,
        says,
        "read",
        None,
        {"filter": text, "filter-lang": "cql2-text"},
    )


def json_filter(name: str, value: Any, says: str = "filter") -> Bad:
    return Bad(
        f"filter json {name}",
        "POST",
        SEARCH,
        says,
        "read",
        None,
        {"filter": value, "filter-lang": "cql2-json"},
    )


def search(name: str, says: str, **members: Any) -> Bad:
    return Bad(f"search {name}", "POST", SEARCH, says, "read", None, members)


def execution(
    name: str, says: str, inputs: Any, process: str = "register-scene", who: str = "register"
) -> Bad:
    path = f"/processes/{process}/execution"
    return Bad(f"execute {name}", "POST", path, says, who, None, {"inputs": inputs})


def body(name: str, path: str, content: bytes, says: str = "", who: str = "admin") -> Bad:
    return Bad(f"body {name}", "POST", path, says, who, None, content=content, headers=JSON)


def deep_json_filter(depth: int) -> dict[str, Any]:
    inner: dict[str, Any] = {"op": "=", "args": [{"property": "saliency"}, 1]}
    for _ in range(depth):
        inner = {"op": "not", "args": [inner]}
    return inner


QUERIES = [
    query("limit zero", "limit=0", "limit"),
    query("limit negative", "limit=-5", "limit"),
    query("limit no number", "limit=ten", "limit"),
    query("limit a fraction", "limit=1.5", "limit"),
    query("limit infinite", "limit=inf", "limit"),
    query("bbox of three numbers", "bbox=1,2,3", "bbox"),
    query("bbox of seven numbers", "bbox=1,2,3,4,5,6,7", "bbox"),
    query("bbox not numbers", "bbox=a,b,c,d", "bbox"),
    query("bbox NaN", "bbox=nan,0,1,1", "bbox"),
    query("bbox infinite", "bbox=-inf,-inf,inf,inf", "bbox"),
    query("bbox beyond the poles", "bbox=0,-91,1,91", "bbox"),
    query("bbox upside down", "bbox=0,2,1,1", "bbox"),
    query("bbox of huge numbers", f"bbox={HUGE},0,1,1", "bbox"),
    query("bbox with SQL", "bbox=0,0,1,1);drop table point;--", "bbox"),
    query("bbox empty", "bbox=", "bbox"),
    query("bbox in an unknown system", "bbox=0,0,1,1&bbox-crs=urn:x", "bbox-crs"),
    query("crs a file", "crs=file:///etc/passwd", "crs"),
    query("crs an address", "crs=http://169.254.169.254/latest", "crs"),
    query("crs unknown", "crs=http://www.opengis.net/def/crs/EPSG/0/999999", "crs"),
    query("datetime no time", "datetime=yesterday", "datetime"),
    query("datetime month 13", "datetime=2024-13-01", "datetime"),
    query("datetime backwards", "datetime=2024-02-01/2024-01-01", "datetime"),
    query("datetime of three", "datetime=2024-01-01/2024-02-01/2024-03-01", "datetime"),
    query("datetime with SQL", "datetime=2024-01-01'%20or%201=1--", "datetime"),
    query("sort by what is not there", "sortby=password", "sortby"),
    query("sort by SQL", "sortby=saliency%20desc;select%20pg_sleep(9)", "sortby"),
    query("sort by a column of the table that the collection lacks", "sortby=chip_file", "sortby"),
    query("properties not there", "properties=secret_hash", "properties"),
    query("properties with SQL", "properties=id,(select%20secret_hash%20from%20token)", "properties"),
    query("an unknown parameter", "where=1=1", "where"),
    query("a page token made up", "token=AAAA", "token"),
    query("a page token of base64 garbage", "token=eyJhIjoxfQ==.xxxx", "token"),
    query("a page token not ASCII", "token=%F0%9F%92%A9", "token"),
    query("a page token of NUL", "token=%00", "token"),
    query("an unknown format", "f=exe", "f"),
    query("a format with a path", "f=../../etc/passwd", "f"),
    query("filter language unknown", "filter=true&filter-lang=sql", "filter-lang"),
    query("filter system unknown", "filter=true&filter-crs=urn:x", "filter-crs"),
    query("a filter that is not UTF-8", "filter=%FF%FE%FA", "filter"),
    query("a filter with NUL", "filter=typology='a%00b'", ""),
    query("a typology with NUL", "typology=a%00b", ""),
]
FILTERS = [
    text_filter("SQL after it", "saliency > 0; drop table point"),
    text_filter("SQL in a text that is closed", "typology = 'x' or 1=1 --'"),
    text_filter("a union", "saliency > 0 union select secret_hash from token"),
    text_filter("a subquery", "saliency > (select 1)"),
    text_filter("a function of the database", "pg_sleep(10) = 1"),
    text_filter("a function that reads files", "pg_read_file('/etc/passwd') = 'x'"),
    text_filter("a function that asks others", "dblink('host=1.2.3.4','select 1') = 1"),
    text_filter("a property of another table", "secret_hash = 'x'"),
    text_filter("a property of the system", "ctid = '(0,1)'"),
    text_filter("a quoted name with SQL", '"saliency"" or true --" > 0'),
    text_filter("a comment", "saliency /* */ > 0"),
    text_filter("an open quotation", "typology = 'x"),
    text_filter("an open parenthesis", "((saliency > 0)"),
    text_filter("parentheses too deep", "(" * 60 + "saliency > 0" + ")" * 60),
    text_filter("too long", "saliency > 0 and " * 2000 + "saliency > 0"),
    text_filter("empty", " "),
    text_filter("a number where a condition belongs", "1"),
    text_filter("a text compared with a number", "saliency = 'x'"),
    text_filter("a number beyond all numbers", f"saliency > 1e{HUGE}"),
    text_filter("a geometry that is none", "s_intersects(geometry, POINT(a b))"),
    text_filter("a geometry of NaN", "s_intersects(geometry, POINT(nan nan))"),
    text_filter("a polygon that is open", "s_intersects(geometry, POLYGON((0 0, 1 0, 1 1)))"),
    text_filter("a relation unknown", "s_eats(geometry, POINT(0 0))"),
    text_filter("a relation without an argument", "s_intersects(geometry)"),
    text_filter("a time that is none", "t_after(first_view, TIMESTAMP('tomorrow'))"),
    text_filter("NUL", "typology = '\0'"),
    text_filter("a lone surrogate", "typology = '\ud800'"),
    json_filter("an unknown operator", {"op": "exec", "args": [1]}),
    json_filter("no arguments", {"op": "="}),
    json_filter("arguments of a wrong kind", {"op": "=", "args": "x"}),
    json_filter(
        "a property that is SQL", {"op": "=", "args": [{"property": 'id"; drop table point; --'}, 1]}
    ),
    json_filter("a property that is a list", {"op": "=", "args": [{"property": ["id"]}, 1]}),
    json_filter("too deep", deep_json_filter(100)),
    body(
        "filter far too deep",
        SEARCH,
        b'{"filter-lang": "cql2-json", "filter": '
        + b'{"op": "not", "args": [' * 800
        + b"true"
        + b"]}" * 800
        + b"}",
    ),
    json_filter(
        "too many nodes",
        {"op": "or", "args": [{"op": "=", "args": [{"property": "saliency"}, i]} for i in range(2000)]},
    ),
    json_filter("a function", {"op": "pg_sleep", "args": [10]}),
    json_filter("like with a number", {"op": "like", "args": [{"property": "typology"}, 3]}),
    json_filter("in without a list", {"op": "in", "args": [{"property": "typology"}, "x"]}),
    json_filter("a list", [1, 2]),
    search("an unknown member", "where", where="1=1"),
    search(
        "a polygon of one point", "geometry", intersects={"type": "Polygon", "coordinates": [[[0, 0]]]}
    ),
    search(
        "a geometry of an unknown kind",
        "geometry",
        intersects={"type": "Sphere", "coordinates": [0, 0]},
    ),
    search("coordinates of texts", "geometry", intersects={"type": "Point", "coordinates": ["a", "b"]}),
    search(
        "coordinates beyond the Earth",
        "geometry",
        intersects={"type": "Point", "coordinates": [999, 999]},
    ),
    search("no coordinates", "geometry", intersects={"type": "Point"}),
    search(
        "a polygon that crosses itself",
        "geometry",
        intersects={"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]},
    ),
    search(
        "too many corners",
        "positions",
        intersects={"type": "LineString", "coordinates": [[i / 1e4, 0] for i in range(10_500)]},
    ),
    search("a limit that is a text", "limit", limit="many"),
    search("a limit that is negative", "limit", limit=-1),
    search("a limit that is huge", "limit", limit=-(10**40)),
    body(
        "search NaN",
        SEARCH,
        b'{"intersects": {"type": "Point", "coordinates": [NaN, NaN]}}',
        "intersects.coordinates",
    ),
    body(
        "search infinite",
        SEARCH,
        b'{"intersects": {"type": "Point", "coordinates": [Infinity, 0]}}',
        "intersects.coordinates",
    ),
    body("search too deep", SEARCH, b'{"filter": ' + DEEP.encode() + b"}"),
    body(
        "search deep intersects",
        SEARCH,
        b'{"intersects": {"type": "Point", "coordinates": ' + b"[" * 500 + b"]" * 500 + b"}}",
    ),
    body("search not JSON", SEARCH, b"{"),
    body("search invalid UTF-8", SEARCH, b'{"filter": "\xff\xfe"}'),
    body("search empty", SEARCH, b""),
    body("search a list", SEARCH, b"[]"),
    body("search too large", SEARCH, b'{"filter": "' + b"a" * BODY_LIMIT_BYTES + b'"}', "larger"),
]
EXECUTIONS = [
    execution("nothing", "scene", {}),
    execution("a scene that is no id", "scene", {"scene": "../../etc/passwd"}),
    execution("a scene that is a number", "scene", {"scene": 7}),
    execution("a scene that is null", "scene", {"scene": None}),
    execution("a scene that is SQL", "scene", {"scene": "' or 1=1 --"}),
    execution("a scene that is not there", "no scene", {"scene": NO_ID}),
    execution("the scene of somebody else", "no scene", {"scene": "<others_scene>"}),
    execution("an unknown input", "sceen", {"scene": "<own_scene>", "sceen": 1}),
    execution(
        "a model with a path", "model", {"scene": "<own_scene>", "model": "../../../outside/canary.txt"}
    ),
    execution(
        "a model with an absolute path", "model", {"scene": "<own_scene>", "model": "/etc/passwd"}
    ),
    execution(
        "a model of GDAL's virtual files",
        "model",
        {"scene": "<own_scene>", "model": "/vsicurl/http://127.0.0.1/x"},
    ),
    execution("options that are a list", "options", {"scene": "<own_scene>", "options": []}),
    execution("an option unknown", "fine_pases", {"scene": "<own_scene>", "options": {"fine_pases": 1}}),
    execution(
        "an option of a wrong type",
        "max_points",
        {"scene": "<own_scene>", "options": {"max_points": "all"}},
    ),
    execution(
        "an option that is null", "max_points", {"scene": "<own_scene>", "options": {"max_points": None}}
    ),
    execution("inputs that are a list", "inputs", []),
    execution("inputs that are a text", "inputs", "scene"),
    execution("an unknown process", "no process", {}, "drop-table"),
    execution("a process with a path", "", {}, "..%2f..%2fadmin"),
    execution("an ingestion without the scope", "scope", {"path": "x"}, "ingest-block"),
    execution("an ingestion of nothing", "path", {}, "ingest-block", "admin"),
    execution(
        "an ingestion of an upload that is not there",
        "no uploaded",
        {"upload": NO_ID},
        "ingest-block",
        "admin",
    ),
    execution(
        "an ingestion with priority NaN as text",
        "priority",
        {"path": "x", "priority": "NaN"},
        "ingest-block",
        "admin",
    ),
    execution("an export of nothing", "bbox", {}, "export-block", "admin"),
    execution(
        "an export of a box of texts", "bbox", {"bbox": ["a", "b", "c", "d"]}, "export-block", "admin"
    ),
    body(
        "execute NaN option",
        EXECUTE,
        b'{"inputs": {"scene": "<own_scene>", "options": {"max_points": NaN}}}',
        "max_points",
    ),
    body("execute deep", EXECUTE, b'{"inputs": ' + DEEP.encode() + b"}"),
    body("execute not JSON", EXECUTE, b"scene=1"),
    body("execute invalid UTF-8", EXECUTE, b'{"inputs": {"scene": "\xc3\x28"}}'),
    body("execute NUL", EXECUTE, b'{"inputs": {"scene": "\\u0000"}}', "scene"),
    Bad(
        "execute with an empty idempotency key",
        "POST",
        EXECUTE,
        "idempotency",
        "register",
        json={"inputs": {"scene": "<own_scene>"}},
        headers={"Idempotency-Key": ""},
    ),
    Bad(
        "execute with a key of 300 letters",
        "POST",
        EXECUTE,
        "idempotency",
        "register",
        json={"inputs": {"scene": "<own_scene>"}},
        headers={"Idempotency-Key": "k" * 300},
    ),
    Bad("job of somebody else", "GET", "/jobs/<others_job>", "no job", "register", 404),
    Bad("job of somebody else dismissed", "DELETE", "/jobs/<others_job>", "no job", "register", 404),
    Bad("results of somebody else", "GET", "/jobs/<others_job>/results", "no job", "register", 404),
    Bad(
        "results file of somebody else",
        "GET",
        "/jobs/<others_job>/results/report.html",
        "no job",
        "register",
        404,
    ),
    Bad(
        "results file with a path",
        "GET",
        "/jobs/<others_job>/results/..%2f..%2f..%2foutside%2fcanary.txt",
        "",
        "admin",
        404,
    ),
    Bad("jobs of a state unknown", "GET", "/jobs?status=done", "status", "register"),
    Bad("jobs after somebody else's", "GET", "/jobs?after=<others_job>", "no job", "register"),
    Bad("jobs with too large a limit", "GET", f"/jobs?limit={HUGE}", "limit", "register"),
]
PLACES = [
    Bad("point that is a text", "GET", f"{ITEMS}/first", "", "read"),
    Bad("point beyond all numbers", "GET", f"{ITEMS}/{HUGE}", "", "read"),
    Bad("point beyond 64 bits", "GET", f"{ITEMS}/{2**63}", "", "read"),
    Bad("point that is negative", "GET", f"{ITEMS}/-1", "no point_id '-1'", "read", 404),
    Bad("point in an unknown system", "GET", f"{ITEMS}/<point>?crs=urn:x", "crs", "read"),
    Bad("chips in an unknown format", "GET", f"{ITEMS}/<point>/chips?f=exe", "f", "read"),
    Bad("chip of a view that is not there", "GET", f"{ITEMS}/<point>/chips/9999", "", "read", 404),
    Bad("chip of a view beyond numbers", "GET", f"{ITEMS}/<point>/chips/{HUGE}", "", "read"),
    Bad("chip of a negative view", "GET", f"{ITEMS}/<point>/chips/-1", "", "read"),
    Bad("tile beyond the zooms", "GET", "/collections/points/tiles/WebMercatorQuad/99/0/0", "", "read"),
    Bad("tile beyond the matrix", "GET", "/collections/points/tiles/WebMercatorQuad/1/2/0", "", "read"),
    Bad("tile of negative row", "GET", "/collections/points/tiles/WebMercatorQuad/1/-1/0", "", "read"),
    Bad(
        "tile beyond numbers", "GET", f"/collections/points/tiles/WebMercatorQuad/1/{HUGE}/0", "", "read"
    ),
    Bad(
        "tile of an unknown matrix",
        "GET",
        "/collections/points/tiles/Mine/1/0/0",
        "no tile matrix set",
        "read",
    ),
    Bad("collection not there", "GET", "/collections/token/items", "no collection", "read", 404),
    Bad("collection with a path", "GET", "/collections/..%2ftoken/items", "", "read", 404),
    Bad("page's file above its folder", "GET", "/map/..%2f..%2f..%2fapp%2fconfig.py", "", "nobody", 404),
    Bad("page's file doubly encoded", "GET", "/map/%252e%252e%252fconfig.py", "", "nobody", 404),
    Bad("audit before a text", "GET", "/audit?before=now", "before"),
    Bad("audit beyond numbers", "GET", f"/audit?before={HUGE}", "before"),
    Bad("audit of an unknown kind", "GET", "/audit?kind=password", "kind"),
    Bad("audit too many", "GET", "/audit?limit=1000000", "limit"),
    Bad("a method that is none", "TRACE", "/jobs", "", status=405),
    Bad("a method that is not for this", "DELETE", "/collections", "", status=405),
    Bad("a path that leads nowhere", "GET", "/.env", "", status=404),
]
BAD_REQUESTS = [*QUERIES, *FILTERS, *EXECUTIONS, *PLACES]
