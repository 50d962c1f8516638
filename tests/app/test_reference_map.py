"""Tiles of reference images: `GET /references/{name}/tiles/…`."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.warp
from fastapi.testclient import TestClient
from matplotlib.image import imread

from amers.app.config import Settings
from amers.services.types import Array
from tests.app.callers import Bearer, Caller

SIZE = 600
GSD_M = 2.0
WEST, NORTH = 700_000.0, 4_800_000.0
UTM = "EPSG:32631"
white_square = np.s_[200:300, 300:400]
half_m = 50 * GSD_M
beside = 15.0
"""Metres from an edge: two pixels of the coarsest tiles."""
dark, bright = 60.0, 200.0


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    """Settings with a folder of references, which has a dark image with a bright square."""
    folder = tmp_path / "references"
    folder.mkdir()
    pixels = np.random.default_rng(1).uniform(0.0, 20.0, (SIZE, SIZE)).astype(np.float32)
    pixels[white_square] += 1000.0
    grid = rasterio.transform.from_origin(WEST, NORTH, GSD_M, GSD_M)
    profile = {"driver": "GTiff", "width": SIZE, "height": SIZE, "count": 1, "dtype": "float32"}
    with rasterio.open(folder / "land.tif", "w", **profile, crs=UTM, transform=grid) as file:
        file.write(pixels, 1)
    return settings.model_copy(update={"reference_folder": folder})


@pytest.fixture
def reference(client: TestClient, admin: Caller) -> str:
    """The path of the tiles of a reference."""
    added = admin.post("/references", json={"name": "the land", "image": "land.tif"})
    assert added.status_code == 201, added.text
    return "/references/the%20land/tiles/WebMercatorQuad"


def on_the_ground(xy: Array) -> Array:
    """Longitudes and latitudes (n, 2) of places in the image's system."""
    lon, lat = rasterio.warp.transform(UTM, "EPSG:4326", *xy.T.tolist())
    return np.column_stack([lon, lat])


def pixel_at(me: Caller, tiles: str, lon_lat: Array, zoom: int) -> float:
    """The grey value of a map at a place, 0 to 255."""
    column = (lon_lat[0] / 360.0 + 0.5) * 2**zoom
    row = (0.5 - np.arcsinh(np.tan(np.radians(lon_lat[1]))) / (2.0 * np.pi)) * 2**zoom
    reply = me.get(f"{tiles}/{zoom}/{int(row)}/{int(column)}")
    assert reply.status_code == 200, reply.text
    kind = reply.headers["content-type"].removeprefix("image/")
    pixels = np.atleast_3d(imread(BytesIO(reply.content), format=kind)).astype(np.float64)
    value = pixels[int(row % 1.0 * 256), int(column % 1.0 * 256), 0]
    return float(value * (255.0 if kind == "png" else 1.0))


@pytest.mark.parametrize("zoom", [14, 16, 17])
def test_a_tile_shows_the_reference_where_it_lies(me: Caller, reference: str, zoom: int) -> None:
    """Both sides of each edge of the square."""
    middle = np.array([WEST + 350.0 * GSD_M, NORTH - 250.0 * GSD_M])
    for way in ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]):
        inside, outside = (
            middle + np.array(way) * (half_m + beside_m) for beside_m in (-beside, beside)
        )
        assert pixel_at(me, reference, on_the_ground(inside[None])[0], zoom) > bright
        assert pixel_at(me, reference, on_the_ground(outside[None])[0], zoom) < dark


def test_tiles_that_do_not_exist_and_strangers_are_refused(
    me: Caller, reference: str, bearer: Bearer
) -> None:
    cases = {
        f"{reference}/5/11/16": "pixels",
        f"{reference}/3/9/1": "no tile 3/9/1",
        f"{reference}/25/0/0": "no tile 25/0/0",
        "/references/other/tiles/WebMercatorQuad/5/1/1": "no reference other",
        reference.replace("WebMercatorQuad", "Other") + "/5/1/1": "Other",
    }
    for path, words in cases.items():
        refused = me.get(path)
        assert refused.status_code == 404, (path, refused.text)
        assert words in refused.json()["detail"]
    far = me.get(f"{reference}/16/0/0")
    assert far.headers["content-type"] == "image/png"
    assert not imread(BytesIO(far.content), format="png")[:, :, 3].any()
    assert bearer("read").get(f"{reference}/16/0/0").status_code == 403
