"""GeoJSON of strangers: no other file is read through it, and no address is fetched."""

import json
import socket
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from amers.services.errors import FormatError
from amers.services.formats.vector.layers import read_layer

POINT = {"type": "Point", "coordinates": [1.0, 2.0]}
FEATURE = {"type": "Feature", "properties": {"secret": "yes"}, "geometry": POINT}
COLLECTION: dict[str, Any] = {"type": "FeatureCollection", "features": [FEATURE]}


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.geojson"
    path.write_text(json.dumps(COLLECTION))
    return path


def virtual(secret: Path) -> str:
    layer = f'<OGRVRTLayer name="secret"><SrcDataSource>{secret}</SrcDataSource></OGRVRTLayer>'
    return f"<OGRVRTDataSource>{layer}</OGRVRTDataSource>"


@pytest.mark.parametrize("suffix", ["json", "geojson"])
@pytest.mark.parametrize("kind", ["pipeline", "both types", "virtual", "virtual after a brace"])
def test_no_other_file_is_read(tmp_path: Path, secret: Path, suffix: str, kind: str) -> None:
    pipeline = {
        "type": "gdal_streamed_alg",
        "command_line": f"gdal vector pipeline ! read {secret}",
        "relative_paths_relative_to_this_file": False,
    }
    text = {
        "pipeline": json.dumps(pipeline),
        "both types": '{"type": "FeatureCollection", "features": [], ' + json.dumps(pipeline)[1:],
        "virtual": json.dumps({**COLLECTION, "features": [], "name": virtual(secret)}),
        "virtual after a brace": "{ " + virtual(secret),
    }[kind]
    path = tmp_path / f"uploaded.{suffix}"
    path.write_text(text)
    if kind == "virtual":
        assert len(read_layer(path).geometries) == 0
    else:
        with pytest.raises(FormatError, match=path.name):
            read_layer(path)


@pytest.mark.parametrize("kind", ["link", "url", "name"])
def test_no_address_is_fetched(tmp_path: Path, kind: str) -> None:
    fetched = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.5)

        def answer() -> None:
            try:
                fetched.append(server.accept()[0].close())
            except TimeoutError:
                return

        address = f"http://127.0.0.1:{server.getsockname()[1]}/crs"
        crs = {"type": kind, "properties": {"href": address, "url": address, "name": address}}
        path = tmp_path / "a.geojson"
        path.write_text(json.dumps({**COLLECTION, "crs": crs}))
        thread = Thread(target=answer)
        thread.start()
        read_layer(path)
        thread.join()
    assert fetched == []


def test_features_names_and_codes_stay(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::2154"}}
    path.write_text("\ufeff" + json.dumps({**COLLECTION, "name": "roads", "crs": crs}), encoding="utf-8")
    layer = read_layer(path)
    assert (layer.name, layer.crs) == ("roads", "EPSG:2154")
    assert layer.attributes.to_pylist() == [{"secret": "yes"}]
    for document in (FEATURE, POINT):
        path.write_text(json.dumps(document))
        assert read_layer(path).geometries[0].wkt == "POINT (1 2)"
