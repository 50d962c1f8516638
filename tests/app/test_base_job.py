"""The process `make-base`: administrators make bases from the catalogues that the operator allows."""

from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db.engine import Database
from tests.app.callers import Bearer
from tests.app.ledger import job_runner
from tests.open_archive import CENTRE, make_archive

pytestmark = [pytest.mark.long, pytest.mark.thorough]

LON, LAT = CENTRE
BOX = [LON - 0.0125, LAT - 0.009, LON + 0.0125, LAT + 0.009]


def test_an_administrator_makes_and_publishes_a_base(
    client: TestClient, database: Database, settings: Settings, bearer: Bearer, tmp_path: Path
) -> None:
    archive = make_archive(tmp_path / "references" / "archive", dates=5)
    catalogue = str(archive.folder / "items.json")
    allowed = {"catalogues": (catalogue,), "reference_folder": archive.folder}
    admin = bearer("admin")
    run = job_runner(client, database, settings.model_copy(update=allowed), admin)
    given = {"id": "valley", "bbox": BOX, "dates": 3, "geoid": "geoid.gtx"}
    job = run("make-base", **given, publish=True)
    assert job["status"] == "successful", job
    made = admin.get(f"/jobs/{job['jobID']}/results").json()
    assert (made["id"], made["state"]) == ("valley", "published")
    assert made["points"] >= 20
    assert made["attribution"].startswith("Contains modified Copernicus Sentinel data 2021")
    (block,) = admin.get("/collections/blocks/items").json()["features"]
    assert block["properties"]["title"] == "valley. Contains modified Copernicus Sentinel data 2021"
    outside = run("make-base", **{**given, "id": "other", "geoid": "../geoid.gtx"})
    assert "geoid: '../geoid.gtx' is not a file below the folder" in outside["message"]
    unset = job_runner(client, database, settings, admin)("make-base", id="none", bbox=BOX)
    assert "AMERS_CATALOGUES is not set" in unset["message"]
    assert bearer("register").execute("make-base", {"id": "no", "bbox": BOX}).status_code == 403


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"id": "1st"}, "id: '1st' found"),
        ({"bbox": [6.1, 43.5, 5.9, 43.7]}, "--bbox"),
        ({"dates": 1}, "dates: 1 found, 2 to 50"),
        ({"max_cloud": 120.0}, "max_cloud: 120 found"),
        ({"archive": "quickbird"}, "archive"),
        ({"vertical": "EGM96"}, "vertical: given without dem"),
    ],
)
def test_what_cannot_be_made_is_refused_when_it_is_requested(
    bearer: Bearer, inputs: dict[str, object], message: str
) -> None:
    reply = bearer("admin").execute("make-base", {"id": "valley", "bbox": BOX, **inputs})
    assert reply.status_code in (400, 422)
    assert message in reply.text
