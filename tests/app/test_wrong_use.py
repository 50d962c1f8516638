"""Forty kinds of wrong use: each ends with one sentence and its exit status, and changes nothing."""

import os
import re
import shlex
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import from_origin

from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.storage import MARKER, Storage
from amers.app.usecases.blocks.lifecycle import ingest_block
from amers.app.usecases.tokens import create_token
from tests.app.conftest import EMPTY_TEMPLATE, TEMPLATE, fresh_database
from tests.command_line import Done, amers_here
from tests.factories import make_block
from tests.geotiffs import write_geotiff
from tests.statements import run_sql

TABLES = "select relname, n_tup_ins, n_tup_upd, n_tup_del from pg_stat_user_tables"
PASSWORD = "hush-hush"


@dataclass(frozen=True)
class Place:
    """An installation with a block and a token, and a folder with files to name.

    Attributes:
        values: that stand in commands and sentences, by their names in braces.
    """

    dsn: str
    folder: Path
    values: dict[str, object] = field(default_factory=dict)

    @property
    def patterns(self) -> dict[str, str]:
        """The values as patterns that match them."""
        return {name: re.escape(str(value)) for name, value in self.values.items()}

    def run(self, use: "WrongUse") -> Done:
        settings = {"AMERS_DATABASE_URL": self.dsn, "AMERS_DATA_FOLDER": str(self.folder / "data")}
        given = {name: value.format(**self.values) for name, value in use.environment.items()}
        kept = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
        words = [word.format(**self.values) for word in shlex.split(use.words)]
        return amers_here(words, {**kept, **settings, **given})

    def state(self) -> tuple[object, ...]:
        """Everything that a command could have changed: rows and their last changes, and files."""
        with engine.connect(self.dsn) as connection:
            tables = [row["relname"] for row in run_sql(connection, TABLES).fetchall()]
            rows = run_sql(
                connection,
                "select (select count(*) from audit) as changes, (select count(*) from token) as tokens,"
                " (select count(*) from block) as blocks, (select count(*) from point) as points,"
                " (select count(*) from job) as jobs, (select count(*) from scene) as scenes",
            ).fetchone()
        files = {
            path: (path.stat().st_size, path.stat().st_mtime_ns)
            for path in self.folder.rglob("*")
            if path.is_file() and path.name != Path(MARKER).name  # names the last command
        }
        return sorted(tables), rows, files


@dataclass(frozen=True)
class WrongUse:
    """One kind of wrong use.

    Attributes:
        words: of the command, as a shell reads them.
        sentence: a pattern for what follows `amers: `.
        status: exit status.
        environment: variables.
    """

    words: str
    sentence: str
    status: int = 2
    environment: dict[str, str] = field(default_factory=dict)


def database(url: str, sentence: str) -> WrongUse:
    return WrongUse("block list", sentence, environment={"AMERS_DATABASE_URL": url})


def box(text: str, sentence: str) -> WrongUse:
    return WrongUse(f"points query --bbox {shlex.quote(text)} -o {{new}}", sentence)


USES: dict[str, WrongUse] = {
    # The address of the database.
    "another driver": database(
        "mysql://amers:{password}@db/amers",
        "AMERS_DATABASE_URL: 'mysql' found in front of ://, postgresql or postgres expected: "
        "give postgresql:.*",
    ),
    "an address with a wrong escape": database(
        "postgresql://amers:{password}%zz@db/amers",
        "AMERS_DATABASE_URL: it cannot be read as the address of a database: give postgresql:.* %40 .*",
    ),
    "text that is no address": database(
        "{password}",
        "AMERS_DATABASE_URL: it cannot be read as the address of a database: give postgresql:.*",
    ),
    "a host that nobody knows": database(
        "postgresql://amers:{password}@nowhere.invalid/amers",
        "the database amers on nowhere.invalid cannot be reached as user amers .*: check "
        "AMERS_DATABASE_URL.*",
    ),
    "a host that does not answer": database(
        "postgresql://amers:{password}@127.0.0.1:1/amers",
        "the database amers on 127.0.0.1 cannot be reached as user amers .*refused.*check "
        "AMERS_DATABASE_URL.*",
    ),
    "a wrong password": database(
        "postgresql://amers:{password}@127.0.0.1:{refusing}/amers",
        "the database amers on 127.0.0.1 cannot be reached as user amers .*password "
        "authentication failed.*"
        "check AMERS_DATABASE_URL.*",
    ),
    "a database that does not exist": database(
        "{other_dsn}", "the database nobody_made_it on .* cannot be reached .*check AMERS_DATABASE_URL.*"
    ),
    "a database without tables": database(
        "{empty_dsn}",
        "the schema of the database is at revision none, this Amers needs [0-9]+: run `amers db "
        "upgrade`",
    ),
    # Settings.
    "a setting with a wrong value": WrongUse(
        "block list",
        "environment: AMERS_PORT: 'no' found; .* integer.*",
        environment={"AMERS_PORT": "no"},
    ),
    "a setting that is no JSON": WrongUse(
        "block list",
        "environment: AMERS_OIDC_SCOPES: it cannot be read; expected a JSON object such as .*",
        environment={"AMERS_OIDC_SCOPES": "read"},
    ),
    "a setting with its former name": WrongUse(
        "block list",
        "environment: AMERS_QUOTA_UPLOAD_BYTES is now AMERS_QUOTA_STORAGE_BYTES; set it under this name",
        environment={"AMERS_QUOTA_UPLOAD_BYTES": "1"},
    ),
    # The words of the command.
    "an unknown group": WrongUse(
        "blok", "No such command 'blok'. Did you mean 'block'.; see `amers --help`"
    ),
    "an unknown command": WrongUse(
        "block lst", "No such command 'lst'. Did you mean 'list'.; see `amers block --help`"
    ),
    "an unknown option": WrongUse(
        "block list --jsn", "No such option: --jsn .*--json.*; see `amers block list --help`"
    ),
    "a word too many": WrongUse(
        "block list all",
        r"Got unexpected extra argument\(s\) \(all\); see `amers block list --help`",
    ),
    "an option without its value": WrongUse(
        "token create x --scope",
        "Option '--scope' requires an argument; see `amers.* --help`",
    ),
    "several arguments missing": WrongUse(
        "scene ortho", "SCENE, --dem and --output are missing; see `amers scene ortho --help`"
    ),
    "several files missing": WrongUse(
        "production ortho {folder}/a.tif {folder}/b.tif --dem {folder}/c.tif -o {new}",
        "--dem: path '{folder}/c.tif' does not exist; IMAGES: path '{folder}/a.tif' does not exist; "
        "IMAGES: path '{folder}/b.tif' does not exist; see `amers production ortho --help`",
    ),
    "several images missing": WrongUse(
        "production run --images {folder}/a.tif --images {folder}/b.tif -o {new}",
        "--images: no file {folder}/a.tif, {folder}/b.tif; expected paths, s3://BUCKET/KEY or https://.",
    ),
    "text for a number": WrongUse(
        "scene ortho {map} --dem {map} -o {new} --gsd-m fine",
        "--gsd-m: 'fine' found; input should be a valid number.*; see `amers scene ortho --help`",
    ),
    "a number out of range": WrongUse(
        "scene ortho {map} --dem {map} -o {new} --fill-px 99",
        "--fill-px: '99' found; input should be less than or equal to 50; see `amers scene "
        "ortho --help`",
    ),
    "an unknown format": WrongUse(
        "points query --bbox 5,43,6,44 --format xml",
        "--format: 'xml' is not one of 'geojson', 'csv'; see `amers points query --help`",
    ),
    # Boxes.
    "a box without numbers": box(
        "", "--bbox: '' found, four or six numbers W,S,E,N expected; give W,S,E,N .*"
    ),
    "a box of three numbers": box(
        "1,2,3", "--bbox: '1,2,3' found, four or six numbers W,S,E,N expected; .*"
    ),
    "a box of words": box(
        "a,b,c,d", "--bbox: 'a,b,c,d' found, four or six numbers W,S,E,N expected; .*"
    ),
    "a box out of range": box(
        "5,43,6,430", "--bbox: north 430 found, -90 to 90 expected; give W,S,E,N .*"
    ),
    "a box with south and north swapped": box(
        "5,44,6,43", "--bbox: south 44 is above north 43; give W,S,E,N in degrees, such as .*"
    ),
    "a box with west and east swapped": box(
        "6,43,5,44",
        "--bbox: west 6 is east of east 5, a box around the other 359 degrees .*give W,S,E,N.*",
    ),
    "a box without area": box(
        "5,43,5,43", "--bbox: '5,43,5,43' found, a box without area; give W,S,E,N .*"
    ),
    # The service.
    "a port in use": WrongUse(
        "serve --port {used}",
        "port {used} of 127.0.0.1 is in use by another program: end that program, or choose a "
        "free port with "
        "--port or AMERS_PORT",
        status=4,
    ),
    "a port that cannot be": WrongUse(
        "serve --port 99999", "--port: '99999' found; .* 65535; see `amers serve --help`"
    ),
    "an address of another machine": WrongUse(
        "serve --host 192.0.2.1 --port {used}",
        "cannot listen on 192.0.2.1, port {used} .*: choose an address of this machine with --host .*",
    ),
    # Tokens.
    "a name that a valid token has": WrongUse(
        "token create 'survey office' --scope read",
        "NAME: the valid token [0-9a-f-]+ is named 'survey office' already: choose another "
        "name, or revoke .*",
    ),
    "an unknown scope": WrongUse(
        "token create x --scope write",
        "scopes: write found, one or more of read, .* expected",
    ),
    "a token of no days": WrongUse(
        "token create x --scope read --days 0",
        "--days: 0 found, 1 to 36500 expected",
    ),
    "a token that is not there": WrongUse(
        "token revoke nobody", "no valid token nobody: `amers token list` lists names and ids"
    ),
    # Blocks and points.
    "a block that is not there": WrongUse(
        "block publish nowhere@3",
        "no block nowhere@3: expected the number, ID or ID@VERSION of a block of the store",
    ),
    "a folder that is not there": WrongUse(
        "block ingest {new}",
        "{new}: no such folder; expected the folder of a block with block.json",
    ),
    "a folder that is no block": WrongUse(
        "block ingest {empty}", "{empty}: block.json cannot be read: .*"
    ),
    "a version that the store has": WrongUse(
        "block ingest {block}",
        "block calanques version 1 is already in the store; a changed block .*",
    ),
    "a priority out of range": WrongUse(
        "block prioritise calanques 5000", "PRIORITY: 5000 found, -1000 to 1000 expected"
    ),
    "a box without points": WrongUse(
        "block export --bbox 1,1,2,2 -o {new}",
        r"--bbox: no points are served in \[1.0, 1.0, 2.0, 2.0\]; choose a box on a published block",
    ),
    "a point that is not there": WrongUse(
        "points suspend 7 --because gone",
        "no point 7: expected the id of a point of the store",
    ),
    # Files.
    "a folder to write into that is not there": WrongUse(
        "points query --bbox 5,43,6,44 -o {new}/points.geojson",
        r"--output: {new}/points.geojson cannot be written \(No such .*\); expected a file in a "
        r"folder .*",
    ),
    "a grid of a geoid that is not installed": WrongUse(
        "production ortho {map} --dem {map} --vertical EPSG:5720 -o {new}",
        "{map}: heights in NGF-IGN69 height cannot be converted to heights above the ellipsoid.*"
        "or give the grid file of the geoid with --geoid",
    ),
    "heights without a datum": WrongUse(
        "production ortho {map} --dem {map} -o {new}",
        "{map}: the file does not state its vertical datum: give ellipsoid, EGM96, EGM2008 or "
        "the code of .*",
    ),
    "a backup that is none": WrongUse(
        "db verify-backup {empty}", "{empty} is no backup: it has no manifest.json"
    ),
    # Others.
    "an unknown kind of changes": WrongUse(
        "audit --kind weather", "--kind: 'weather' found, one of token, block, .* expected"
    ),
    "too many changes": WrongUse("audit --limit 5000", "--limit: 5000 found, 1 to 1000 expected"),
    "a batch that is not in the trash": WrongUse(
        "store trash restore 1999",
        "no batch 1999 in the trash: `amers store trash list` lists them",
    ),
}


@contextmanager
def refusing_server() -> Iterator[int]:
    """The port of a server that speaks as PostgreSQL does to a wrong password."""

    def message(kind: bytes, body: bytes) -> bytes:
        return kind + (len(body) + 4).to_bytes(4, "big") + body

    refusal = b'SFATAL\0VFATAL\0C28P01\0Mpassword authentication failed for user "amers"\0\0'

    def serve() -> None:
        while True:
            try:
                line, _ = server.accept()
            except OSError:
                return
            with line:
                if line.recv(1024)[4:8] == (80877103).to_bytes(4, "big"):
                    line.sendall(b"N")
                    line.recv(1024)
                line.sendall(message(b"R", (3).to_bytes(4, "big")))
                line.recv(1024)
                line.sendall(message(b"E", refusal))

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)


def write_map(path: Path) -> Path:
    """An image of 64 x 64 pixels on a map."""
    pixels = np.arange(64 * 64, dtype=np.uint16).reshape(1, 64, 64)
    write_geotiff(path, pixels, crs="EPSG:32631", transform=from_origin(700_000, 4_830_000, 1.0, 1.0))
    return path


@pytest.fixture(scope="module")
def place(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """The installation of all kinds: none of them changes it."""
    folder = tmp_path_factory.mktemp("wrong-use")
    (folder / "empty").mkdir()
    made = make_block(folder / "block", 5, n_images=2, gsds_m=(2.0,))
    with (
        fresh_database(cluster, TEMPLATE) as dsn,
        fresh_database(cluster, EMPTY_TEMPLATE) as empty,
        refusing_server() as refusing,
        socket.create_server(("127.0.0.1", 0)) as used,
    ):
        with engine.connect(dsn) as connection:
            ingest_block(connection, Storage(folder / "data" / "storage"), made.folder)
            create_token(connection, "survey office", ["read"])
        values = {
            "password": PASSWORD,
            "folder": folder,
            "block": made.folder,
            "empty": folder / "empty",
            "new": folder / "new",
            "map": write_map(folder / "map.tif"),
            "empty_dsn": empty,
            "other_dsn": re.sub("dbname=[^ ]+", "dbname=nobody_made_it", dsn),
            "refusing": refusing,
            "used": used.getsockname()[1],
        }
        yield Place(dsn, folder, values)


@pytest.mark.parametrize("kind", USES)
def test_wrong_use_ends_with_one_sentence_and_changes_nothing(place, kind):
    use = USES[kind]
    before = place.state()
    done = place.run(use)
    lines = [line for line in done.stderr.splitlines() if not re.match(r" *\d+ % ", line)]
    print(*lines, sep="\n")
    assert len(lines) == 1, done.stderr
    assert re.fullmatch("amers: " + use.sentence.format(**place.patterns), lines[0]), lines[0]
    assert done.returncode == use.status
    assert done.stdout == ""
    assert PASSWORD not in done.stderr
    assert place.state() == before


def test_the_refusal_of_a_scene_names_the_option_that_it_needs(place, tmp_path):
    done = place.run(WrongUse(f"scene register {{map}} -o {tmp_path / 'out'}", ""))
    assert "is unknown: give the horizontal accuracy of its map grid as `--sigma-m`, one" in done.stderr
    assert "`--sigma-m`" in done.stdout
    assert done.returncode == 2


def test_there_are_forty_kinds():
    assert len(USES) >= 40
