"""Files that people keep: their names, and tables without formulas of strangers."""

import csv
import io
import re
from email.message import Message
from urllib.parse import unquote
from uuid import UUID

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amers.app.api.disposition import disposition
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts
from amers.app.storage import Storage
from tests.app.callers import Caller
from tests.app.job_queue import claimed
from tests.statements import run_sql

TIFF = b"II*\0" + bytes(1000)
FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\tx", "\rx", '="a"', "-", "+1e", "-1-1"]
PLAIN = ["-5", "+4.5", "-.5e-3", "a=1", "1+1", "", "'", "é", 'say "hi"']


def name_in(value: str) -> str | None:
    """The file name that a client finds in a header: the encoded one where there are two."""
    encoded = re.search(r"; filename\*=UTF-8''([^;]+)$", value)
    if encoded is not None:
        return unquote(encoded[1], errors="strict")
    message = Message()
    message["Content-Disposition"] = value
    return message.get_filename()


@pytest.mark.parametrize(
    "name", ["report.html", "a b.tif", "scène 1.tif", "日本.csv", "100%.txt", "a'b(1).tif"]
)
def test_a_name_arrives_as_it_is(name: str) -> None:
    assert name_in(disposition(name)) == name


@given(st.text(st.characters(codec=None, exclude_categories=["Cs"])))
def test_no_name_ends_the_header_or_leads_out_of_a_folder(name: str) -> None:
    value = disposition(name)
    assert value.isascii()
    assert value.isprintable()
    found = name_in(value)
    assert found
    assert not set(found) & set("/\\")


@pytest.mark.parametrize(
    ("kind", "way"),
    [
        ("text/html; charset=utf-8", "inline"),
        ("image/tiff", "attachment"),
        ("application/zip", "attachment"),
    ],
)
def test_a_browser_shows_what_it_can_show(kind: str, way: str) -> None:
    assert disposition("a", kind).startswith(f"{way};")


def test_files_of_results_and_scenes_have_names(
    me: Caller, database: Database, storage: Storage
) -> None:
    scene = me.post("/scenes?name=my scene.tif", content=TIFF).json()
    reply = me.get(f"/scenes/{scene['id']}/files/{scene['file']}")
    assert reply.headers["content-disposition"] == 'attachment; filename="my_scene.tif"'
    inputs = {"scene": scene["id"]}
    sent = me.execute("register-scene", inputs)
    job = claimed(database, UUID(sent.json()["jobID"]))
    names = {"report.html": "inline", "north/scene_RPC.TXT": "inline", "copy.tif": "attachment"}
    keys = {name: storage.put(f"results/{job.id}/1/{name}", [b"x"]).key for name in names}
    with database.transaction() as connection:
        attempts.succeed(connection, job.id, 1, {"files": keys})
    for name, way in names.items():
        reply = me.get(f"/jobs/{job.id}/results/{name}")
        kept = name.replace("/", "-")
        assert reply.headers["content-disposition"] == f'{way}; filename="{kept}"'


def test_no_text_in_a_csv_is_a_formula_and_numbers_stay_numbers(me, connection) -> None:
    for _ in FORMULAS + PLAIN:
        me.post("/scenes?name=a.tif", content=TIFF)
    rows = run_sql(connection, "select id from scene order by created_at").fetchall()
    for row, name in zip(rows, FORMULAS + PLAIN, strict=True):
        run_sql(connection, "update scene set name = %s, sigma_m = 5 where id = %s", [name, row["id"]])
    connection.commit()
    reply = me.get("/collections/scenes/items?f=csv&limit=100")
    assert reply.status_code == 200
    table = list(csv.DictReader(io.StringIO(reply.text, newline="")))
    titles = [row["title"] for row in table]
    assert sorted(titles) == sorted([f"'{text}" for text in FORMULAS] + PLAIN)
    with_titles = me.get("/collections/scenes/items?limit=100").json()["features"]
    assert sorted(one["properties"]["title"] for one in with_titles) == sorted(FORMULAS + PLAIN)
