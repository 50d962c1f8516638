"""Questions and orders that must be refused: of queries, filters, searches, executions, places."""

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
        name: what is wrong with it.
        says: what the refusal names.
        who: whose token it carries.
        status: None: any refusal will do.
        json, content: of the body; `<name>` in them, path and headers is an id of the installation.
        metadata: of an upload by tus.
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


def asked(name: str, query: str, says: str) -> Bad:
    return Bad(f"query {name}", "GET", f"{ITEMS}?{query}", says, "read", 400)


def filtered(name: str, text: str, says: str = "filter") -> Bad:
    return Bad(
        f"filter {name}",
        "POST",
        SEARCH,
        says,
        "read",
        None,
        {"filter": text, "filter-lang": "cql2-text"},
    )


def filtered_json(name: str, value: Any, says: str = "filter") -> Bad:
    return Bad(
        f"filter json {name}",
        "POST",
        SEARCH,
        says,
        "read",
        None,
        {"filter": value, "filter-lang": "cql2-json"},
    )


def searched(name: str, says: str, **members: Any) -> Bad:
    return Bad(f"search {name}", "POST", SEARCH, says, "read", None, members)


def executed(
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
    asked("limit zero", "limit=0", "limit"),
    asked("limit negative", "limit=-5", "limit"),
    asked("limit no number", "limit=ten", "limit"),
    asked("limit a fraction", "limit=1.5", "limit"),
    asked("limit infinite", "limit=inf", "limit"),
    asked("bbox of three numbers", "bbox=1,2,3", "bbox"),
    asked("bbox of seven numbers", "bbox=1,2,3,4,5,6,7", "bbox"),
    asked("bbox not numbers", "bbox=a,b,c,d", "bbox"),
    asked("bbox NaN", "bbox=nan,0,1,1", "bbox"),
    asked("bbox infinite", "bbox=-inf,-inf,inf,inf", "bbox"),
    asked("bbox beyond the poles", "bbox=0,-91,1,91", "bbox"),
    asked("bbox upside down", "bbox=0,2,1,1", "bbox"),
    asked("bbox of huge numbers", f"bbox={HUGE},0,1,1", "bbox"),
    asked("bbox with SQL", "bbox=0,0,1,1);drop table point;--", "bbox"),
    asked("bbox empty", "bbox=", "bbox"),
    asked("bbox in an unknown system", "bbox=0,0,1,1&bbox-crs=urn:x", "bbox-crs"),
    asked("crs a file", "crs=file:///etc/passwd", "crs"),
    asked("crs an address", "crs=http://169.254.169.254/latest", "crs"),
    asked("crs unknown", "crs=http://www.opengis.net/def/crs/EPSG/0/999999", "crs"),
    asked("datetime no time", "datetime=yesterday", "datetime"),
    asked("datetime month 13", "datetime=2024-13-01", "datetime"),
    asked("datetime backwards", "datetime=2024-02-01/2024-01-01", "datetime"),
    asked("datetime of three", "datetime=2024-01-01/2024-02-01/2024-03-01", "datetime"),
    asked("datetime with SQL", "datetime=2024-01-01'%20or%201=1--", "datetime"),
    asked("sort by what is not there", "sortby=password", "sortby"),
    asked("sort by SQL", "sortby=saliency%20desc;select%20pg_sleep(9)", "sortby"),
    asked("sort by a column of the table that is none of the collection", "sortby=chip_file", "sortby"),
    asked("properties not there", "properties=secret_hash", "properties"),
    asked("properties with SQL", "properties=id,(select%20secret_hash%20from%20token)", "properties"),
    asked("an unknown parameter", "where=1=1", "where"),
    asked("a page token made up", "token=AAAA", "token"),
    asked("a page token of base64 garbage", "token=eyJhIjoxfQ==.xxxx", "token"),
    asked("a page token not ASCII", "token=%F0%9F%92%A9", "token"),
    asked("a page token of NUL", "token=%00", "token"),
    asked("a format that is none", "f=exe", "f"),
    asked("a format with a path", "f=../../etc/passwd", "f"),
    asked("filter language unknown", "filter=true&filter-lang=sql", "filter-lang"),
    asked("filter system unknown", "filter=true&filter-crs=urn:x", "filter-crs"),
    asked("a filter that is not UTF-8", "filter=%FF%FE%FA", "filter"),
    asked("a filter with NUL", "filter=typology='a%00b'", ""),
    asked("a typology with NUL", "typology=a%00b", ""),
]
FILTERS = [
    filtered("SQL after it", "saliency > 0; drop table point"),
    filtered("SQL in a text that is closed", "typology = 'x' or 1=1 --'"),
    filtered("a union", "saliency > 0 union select secret_hash from token"),
    filtered("a subquery", "saliency > (select 1)"),
    filtered("a function of the database", "pg_sleep(10) = 1"),
    filtered("a function that reads files", "pg_read_file('/etc/passwd') = 'x'"),
    filtered("a function that asks others", "dblink('host=1.2.3.4','select 1') = 1"),
    filtered("a property of another table", "secret_hash = 'x'"),
    filtered("a property of the system", "ctid = '(0,1)'"),
    filtered("a quoted name with SQL", '"saliency"" or true --" > 0'),
    filtered("a comment", "saliency /* */ > 0"),
    filtered("an open quotation", "typology = 'x"),
    filtered("an open parenthesis", "((saliency > 0)"),
    filtered("parentheses too deep", "(" * 60 + "saliency > 0" + ")" * 60),
    filtered("too long", "saliency > 0 and " * 2000 + "saliency > 0"),
    filtered("empty", " "),
    filtered("a number where a condition belongs", "1"),
    filtered("a text compared with a number", "saliency = 'x'"),
    filtered("a number beyond all numbers", f"saliency > 1e{HUGE}"),
    filtered("a geometry that is none", "s_intersects(geometry, POINT(a b))"),
    filtered("a geometry of NaN", "s_intersects(geometry, POINT(nan nan))"),
    filtered("a polygon that is open", "s_intersects(geometry, POLYGON((0 0, 1 0, 1 1)))"),
    filtered("a relation unknown", "s_eats(geometry, POINT(0 0))"),
    filtered("a relation without an argument", "s_intersects(geometry)"),
    filtered("a time that is none", "t_after(first_view, TIMESTAMP('tomorrow'))"),
    filtered("NUL", "typology = '\0'"),
    filtered("a lone surrogate", "typology = '\ud800'"),
    filtered_json("an unknown operator", {"op": "exec", "args": [1]}),
    filtered_json("no arguments", {"op": "="}),
    filtered_json("arguments of a wrong kind", {"op": "=", "args": "x"}),
    filtered_json(
        "a property that is SQL", {"op": "=", "args": [{"property": 'id"; drop table point; --'}, 1]}
    ),
    filtered_json("a property that is a list", {"op": "=", "args": [{"property": ["id"]}, 1]}),
    filtered_json("too deep", deep_json_filter(100)),
    body(
        "filter far too deep",
        SEARCH,
        b'{"filter-lang": "cql2-json", "filter": '
        + b'{"op": "not", "args": [' * 800
        + b"true"
        + b"]}" * 800
        + b"}",
    ),
    filtered_json(
        "too many nodes",
        {"op": "or", "args": [{"op": "=", "args": [{"property": "saliency"}, i]} for i in range(2000)]},
    ),
    filtered_json("a function", {"op": "pg_sleep", "args": [10]}),
    filtered_json("like with a number", {"op": "like", "args": [{"property": "typology"}, 3]}),
    filtered_json("in without a list", {"op": "in", "args": [{"property": "typology"}, "x"]}),
    filtered_json("a list", [1, 2]),
    searched("an unknown member", "where", where="1=1"),
    searched(
        "a polygon of one point", "geometry", intersects={"type": "Polygon", "coordinates": [[[0, 0]]]}
    ),
    searched(
        "a geometry of an unknown kind",
        "geometry",
        intersects={"type": "Sphere", "coordinates": [0, 0]},
    ),
    searched(
        "coordinates of texts", "geometry", intersects={"type": "Point", "coordinates": ["a", "b"]}
    ),
    searched(
        "coordinates beyond the Earth",
        "geometry",
        intersects={"type": "Point", "coordinates": [999, 999]},
    ),
    searched("no coordinates", "geometry", intersects={"type": "Point"}),
    searched(
        "a polygon that crosses itself",
        "geometry",
        intersects={"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]},
    ),
    searched(
        "too many corners",
        "positions",
        intersects={"type": "LineString", "coordinates": [[i / 1e4, 0] for i in range(10_500)]},
    ),
    searched("a limit that is a text", "limit", limit="many"),
    searched("a limit that is negative", "limit", limit=-1),
    searched("a limit that is huge", "limit", limit=-(10**40)),
    body(
        "search NaN",
        SEARCH,
        b'{"intersects": {"type": "Point", "coordinates": [NaN, NaN]}}',
        "geometry",
    ),
    body(
        "search infinite",
        SEARCH,
        b'{"intersects": {"type": "Point", "coordinates": [Infinity, 0]}}',
        "geometry",
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
    executed("nothing", "scene", {}),
    executed("a scene that is no id", "scene", {"scene": "../../etc/passwd"}),
    executed("a scene that is a number", "scene", {"scene": 7}),
    executed("a scene that is null", "scene", {"scene": None}),
    executed("a scene that is SQL", "scene", {"scene": "' or 1=1 --"}),
    executed("a scene that is not there", "no scene", {"scene": NO_ID}),
    executed("the scene of somebody else", "no scene", {"scene": "<others_scene>"}),
    executed("an unknown input", "sceen", {"scene": "<own_scene>", "sceen": 1}),
    executed(
        "a model with a path", "model", {"scene": "<own_scene>", "model": "../../../outside/canary.txt"}
    ),
    executed("a model with an absolute path", "model", {"scene": "<own_scene>", "model": "/etc/passwd"}),
    executed(
        "a model of GDAL's virtual files",
        "model",
        {"scene": "<own_scene>", "model": "/vsicurl/http://127.0.0.1/x"},
    ),
    executed("options that are a list", "options", {"scene": "<own_scene>", "options": []}),
    executed("an option unknown", "fine_pases", {"scene": "<own_scene>", "options": {"fine_pases": 1}}),
    executed(
        "an option of a wrong type",
        "max_points",
        {"scene": "<own_scene>", "options": {"max_points": "all"}},
    ),
    executed(
        "an option that is null", "max_points", {"scene": "<own_scene>", "options": {"max_points": None}}
    ),
    executed("inputs that are a list", "inputs", []),
    executed("inputs that are a text", "inputs", "scene"),
    executed("an unknown process", "no process", {}, "drop-table"),
    executed("a process with a path", "", {}, "..%2f..%2fadmin"),
    executed("an ingestion without the scope", "scope", {"path": "x"}, "ingest-block"),
    executed("an ingestion of nothing", "path", {}, "ingest-block", "admin"),
    executed(
        "an ingestion of an upload that is not there",
        "no uploaded",
        {"upload": NO_ID},
        "ingest-block",
        "admin",
    ),
    executed(
        "an ingestion with priority NaN as text",
        "priority",
        {"path": "x", "priority": "NaN"},
        "ingest-block",
        "admin",
    ),
    executed("an export of nothing", "bbox", {}, "export-block", "admin"),
    executed(
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
    Bad("point that is negative", "GET", f"{ITEMS}/-1", "no point", "read", 404),
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
QUESTIONS = [*QUERIES, *FILTERS, *EXECUTIONS, *PLACES]
