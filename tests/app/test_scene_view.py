"""A service draws the raw image of a scene as tiles, for its owner."""

from pathlib import Path

import cv2
import numpy as np
import rasterio
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db.engine import Database
from tests.app.callers import Bearer, Caller
from tests.app.ledger import job_runner, make_token
from tests.app.test_orthorectification import write_inputs


def test_the_tiles_of_a_scene_are_read_by_ranges(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    database: Database,
    tmp_path: Path,
    me: Caller,
) -> None:
    image, _ = write_inputs(tmp_path)
    scene = me.post("/scenes?name=scene.tif", content=image.read_bytes()).json()["id"]
    ended = job_runner(client, database, settings, me)("view-scene", scene=scene)
    assert ended["status"] == "successful", str(ended)
    answer = me.get(f"/jobs/{ended['jobID']}/results").json()
    index = me.get(answer["tiles.json"]["href"]).json()
    with rasterio.open(image) as raw:
        pixels = raw.read(1).astype(float)
    assert (index["lines"], index["samples"]) == pixels.shape == (answer["lines"], answer["samples"])
    at, size = index["levels"][0]["tiles"][0]
    part = client.get(
        answer["tiles.bin"]["href"], headers={**me, "Range": f"bytes={at}-{at + size - 1}"}
    )
    assert part.status_code == 206
    tile = cv2.imdecode(np.frombuffer(part.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.corrcoef(tile.ravel(), pixels[: len(tile), : tile.shape[1]].ravel())[0, 1] > 0.9

    stranger = make_token(client, bearer("admin"))
    assert client.get(answer["tiles.bin"]["href"], headers=stranger).status_code == 404
    body = {"inputs": {"scene": scene}}
    for headers, status in ((stranger, 404), (bearer("read"), 403), ({}, 401)):
        reply = client.post("/processes/view-scene/execution", json=body, headers=headers)
        assert reply.status_code == status
