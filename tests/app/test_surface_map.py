"""The surface of a job on the map: tiles and heights for its owner, for nobody else."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.errors import DamagedFile
from amers.app.storage import Storage
from amers.app.usecases.surface_map import map_values, surface_heights, surface_tile
from amers.services.orthorectification.tile_limits import TileLimits, TilePlace
from tests.app.callers import Bearer
from tests.app.job_queue import new_job
from tests.app.ledger import job_runner, make_token
from tests.app.s3_server import running_bucket
from tests.app.surface_world import OPTIONS, write_pair
from tests.app.test_surface_difference import write_surface
from tests.services.surface.worlds import town
from tests.unproven import unproven_storage

OPEN_GROUND = town().centre_lon_lat[None, :] + [[0.0, -0.0004]]
MADE = {"gsd_m": 1.25, "heights_m": OPTIONS.heights_m}
a_tenth_of_the_base_m = 0.3


def test_tiles_and_heights_of_a_surface_are_for_its_owner(
    client: TestClient, bearer: Bearer, settings: Settings, database: Database, tmp_path: Path
) -> None:
    me = bearer("register")
    run = job_runner(client, database, settings, me)
    images = write_pair(tmp_path)
    ids = [me.scene(image.read_bytes(), f"name={image.name}") for image in images]
    job = run("make-surface", scenes=ids, **MADE)
    assert job["status"] == "successful", job
    results = me.get(f"/jobs/{job['jobID']}/results").json()
    place = f"/jobs/{job['jobID']}/map/surface"

    limits = [TileLimits(**one) for one in results["tile_limits"]]
    finest = limits[0]
    tile = f"{place}/tiles/WebMercatorQuad/{finest.zoom}/{finest.first_row}/{finest.first_column}"
    reply = me.get(tile)
    assert reply.headers["content-type"] == "image/png"
    assert reply.headers["cache-control"] == "private, no-cache"
    pixels = cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (256, 256, 4)
    assert me.get(tile.replace(f"/{finest.zoom}/", "/3/")).status_code == 404
    assert me.get(tile.replace("/surface/", "/raw/")).status_code == 404
    west, south, east, north = results["bounds"]
    assert west < OPEN_GROUND[0, 0] < east
    assert south < OPEN_GROUND[0, 1] < north
    low, high = results["height_range_m"]
    truth_m = float(town().height_m(OPEN_GROUND)[0])
    assert low <= truth_m <= high
    assert len(results["height_colours"]) > 3

    lon, lat = OPEN_GROUND[0]
    (found,) = me.get(f"{place}/heights?along={lon},{lat}").json()["heights"]
    assert found["height_m"] == pytest.approx(truth_m, abs=a_tenth_of_the_base_m)
    assert 0.0 < found["sigma_m"] < 2.0
    assert (found["views"], found["reason"]) == (2, "has a height")
    line = me.get(f"{place}/heights?along={west},{lat},{east},{lat}").json()["heights"]
    assert 2 < len(line) <= 400
    distances_m = np.array([one["distance_m"] for one in line])
    assert np.ptp(np.diff(distances_m)) < 0.02
    width_m = (east - west) * 111_320.0 * np.cos(np.radians(lat))
    assert distances_m[-1] == pytest.approx(width_m, rel=0.005)
    known = [one for one in line if one["height_m"] is not None]
    assert len(known) > 0.3 * len(line)
    (outside,) = me.get(f"{place}/heights?along=-20,10").json()["heights"]
    assert (outside["height_m"], outside["sigma_m"], outside["views"]) == (None, None, 0)

    for along in ("", "5", "a,b", "5,43,6", "nan,43", "5,91", "181,0", "1e999,0"):
        refused = me.get(f"{place}/heights", params={"along": along})
        assert refused.status_code == 400, along
        assert "along" in refused.json()["detail"]
    stranger = make_token(client, bearer("admin"))
    for path in (tile, f"{place}/heights?along={lon},{lat}"):
        assert stranger.get(path).status_code == 404
        assert client.get(path).status_code == 401
        assert bearer("admin").get(path).status_code == 200


def test_a_surface_in_a_bucket_is_shown_as_one_in_a_folder(
    settings: Settings,
    storage: Storage,
    database: Database,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    surface = write_surface(tmp_path / "surface.tif")
    key, values = "results/a/1/surface.tif", map_values(surface)
    job = replace(new_job(database), results={**values, "files": {"surface.tif": key}})
    west, south, east, north = values["bounds"]
    line = np.array([[west, south], [east, north]])
    finest = TileLimits(**values["tile_limits"][0])
    place = TilePlace(finest.zoom, finest.first_row + 1, finest.first_column + 1)
    with running_bucket(monkeypatch) as url:
        bucket = unproven_storage(settings.model_copy(update={"storage_url": url}))
        shown = []
        for kept in (storage, bucket):
            kept.put_file(key, surface)
            shown.append((surface_tile(kept, job, place), surface_heights(kept, job, line)))
        assert shown[0] == shown[1]
        assert sum(one.height_m is not None for one in shown[0][1]) > 200
        bucket.delete(key)
        with pytest.raises(DamagedFile, match="missing from the storage"):
            surface_tile(bucket, job, place)
    storage.path(key).write_bytes(b"II*\0 no surface")
    with pytest.raises(DamagedFile):
        surface_heights(storage, job, line)
