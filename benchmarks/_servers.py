"""Services of points as separate processes: ours, tipg and pygeoapi, each run as documented."""

import http.client
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from psycopg.conninfo import conninfo_to_dict

from amers.app.db.engine import Connection
from tests.service_process import free_port
from tests.statements import run_sql

PATIENCE_S = 120.0
PEER_SCHEMA = "peer"
VIEW = f"""
create schema {PEER_SCHEMA};
create view {PEER_SCHEMA}.point as
    select id, st_setsrid(geom, 4326)::geometry(PointZ, 4326) as geom, sigma_east_m, sigma_north_m,
        sigma_up_m, corr_east_north, corr_east_up, corr_north_up, n_views, saliency, typology,
        first_view, last_view, block_number, surface_height_m, surface_sigma_m
    from public.point;
create index point_peer on point using gist ((st_setsrid(geom, 4326)::geometry(PointZ, 4326)));
"""


@dataclass(frozen=True)
class Server:
    """A running service.

    Attributes:
        name: of the software.
        process: its first process.
        items: path of the collection of points.
        page: parameters of a page request besides its box.
        tiles: path of its vector tiles, up to the zoom; "" without any.
    """

    name: str
    process: "subprocess.Popen[bytes]"
    port: int
    items: str
    page: str
    tiles: str = ""

    @property
    def replying(self) -> int:
        """The number of the one process that replies: the child of a supervisor, where there is one."""
        first = self.process.pid
        children = Path(f"/proc/{first}/task/{first}/children").read_text().split()
        return int(children[0]) if children else first

    def connect(self) -> http.client.HTTPConnection:
        """A kept-alive connection."""
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)


def show_to_peers(connection: Connection) -> None:
    """Create a view for other services: positions in EPSG:4326 with an index, published columns."""
    run_sql(connection, VIEW)
    run_sql(connection, "analyze point")


@contextmanager
def amers(data_folder: Path) -> Iterator[Server]:
    """`amers serve` without its worker and with public points."""
    settings = {"AMERS_DATA_FOLDER": str(data_folder), "AMERS_PUBLIC_POINTS": "true"}
    port = free_port()
    command = [sys.executable, "-m", "amers", "serve", "--no-worker", "--port", str(port)]
    page = "limit=10000&f=json"
    tiles = "/collections/points/tiles/WebMercatorQuad"
    with running(command, _plain_environment() | settings) as process:
        yield _ready(Server("amers", process, port, "/collections/points/items", page, tiles), "/readyz")


@contextmanager
def tipg(python: Path, dsn: str) -> Iterator[Server]:
    """tipg under uvicorn: one process with kept connections."""
    database = conninfo_to_dict(dsn)
    settings = {
        "POSTGRES_USER": str(database["user"]),
        "POSTGRES_DBNAME": str(database["dbname"]),
        "POSTGRES_HOST": quote(str(database["host"]), safe=""),
        "POSTGRES_PORT": str(database["port"]),
        "TIPG_DB_SCHEMAS": json.dumps([PEER_SCHEMA]),
        "TIPG_DB_SPATIAL_EXTENT": "false",
        "TIPG_DB_DATETIME_EXTENT": "false",
    }
    port = free_port()
    command = [str(python), "-m", "uvicorn", "tipg.main:app", "--port", str(port), "--no-access-log"]
    items = f"/collections/{PEER_SCHEMA}.point/items"
    tiles = f"/collections/{PEER_SCHEMA}.point/tiles/WebMercatorQuad"
    page = "limit=10000&f=geojson"
    with running(command, _plain_environment() | settings) as process:
        yield _ready(Server("tipg", process, port, items, page, tiles), "/conformance")


@contextmanager
def pygeoapi(python: Path, dsn: str, folder: Path, threads: int) -> Iterator[Server]:
    """pygeoapi under gunicorn: one worker with one thread per client."""
    port = free_port()
    configuration, description = folder / "pygeoapi.json", folder / "openapi.yml"
    configuration.write_text(json.dumps(_pygeoapi_document(port, conninfo_to_dict(dsn))))
    settings = {"PYGEOAPI_CONFIG": str(configuration), "PYGEOAPI_OPENAPI": str(description)}
    generate = ["openapi", "generate", str(configuration), "--output-file", str(description)]
    subprocess.run(
        [str(python.parent / "pygeoapi"), *generate],
        check=True,
        env=_plain_environment() | settings,
        capture_output=True,
    )
    command = [str(python), "-m", "gunicorn", "--workers", "1", "--threads", str(threads)]
    command += ["--bind", f"127.0.0.1:{port}", "--keep-alive", "60", "pygeoapi.flask_app:APP"]
    with running(command, _plain_environment() | settings) as process:
        server = Server("pygeoapi", process, port, "/collections/point/items", "limit=10000&f=json")
        yield _ready(server, "/conformance?f=json")


def _pygeoapi_document(port: int, database: Mapping[str, object]) -> dict[str, object]:
    somebody = {"name": "benchmark", "url": "http://localhost"}
    provider = {
        "type": "feature",
        "name": "PostgreSQL",
        "data": {
            **{name: database[name] for name in ("host", "port", "dbname", "user")},
            "password": "none",
            "search_path": [PEER_SCHEMA],
        },
        "id_field": "id",
        "table": "point",
        "geom_field": "geom",
    }
    return {
        "server": {
            "bind": {"host": "127.0.0.1", "port": port},
            "url": f"http://127.0.0.1:{port}",
            "mimetype": "application/json; charset=UTF-8",
            "encoding": "utf-8",
            "gzip": False,
            "languages": ["en-US"],
            "pretty_print": False,
            "limits": {"default_items": 100, "max_items": 10_000, "on_exceed": "throttle"},
            "map": {"url": "http://localhost/{z}/{x}/{y}", "attribution": "none"},
        },
        "logging": {"level": "ERROR"},
        "metadata": {
            "identification": {
                **{"title": "points", "description": "points", "url": "http://localhost"},
                **{"keywords": ["points"], "keywords_type": "theme", "terms_of_service": "none"},
            },
            "license": somebody,
            "provider": somebody,
            "contact": {"name": "benchmark"},
        },
        "resources": {
            "point": {
                "type": "collection",
                **{"title": "point", "description": "points", "keywords": ["points"]},
                "extents": {"spatial": {"bbox": [-180, -90, 180, 90]}},
                "providers": [provider],
            }
        },
    }


def _plain_environment() -> dict[str, str]:
    ours = ("AMERS_", "PYTHONPATH", "VIRTUAL_ENV")
    return {name: value for name, value in os.environ.items() if not name.startswith(ours)}


@contextmanager
def running(
    command: Sequence[str], environment: Mapping[str, str]
) -> Iterator["subprocess.Popen[bytes]"]:
    """A process without input and output, ended by SIGTERM, and after half a minute by SIGKILL."""
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, env=environment, stdin=silent, stdout=silent, stderr=silent)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _ready(server: Server, path: str) -> Server:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if server.process.poll() is not None:
            raise RuntimeError(f"{server.name} ended with {server.process.returncode}")
        try:
            connection = server.connect()
            connection.request("GET", path)
            if connection.getresponse().status == 200:
                return server
        except OSError:
            pass
        time.sleep(0.2)
    raise RuntimeError(f"{server.name} did not answer within {PATIENCE_S:g} s")
