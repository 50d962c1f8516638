"""Rigorous models are found by the names under which they are delivered, by every command alike."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.services.errors import FormatError, InputError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.imagery.scene import Scene
from amers.services.sensors.parameter_sets import parameter_set_named
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc import RpcModel
from tests.app.callers import Bearer
from tests.app.rigorous_products import (
    PRODUCTS,
    write_empty,
    write_mark,
    write_product,
    write_terrain,
)
from tests.app.worker_processes import ended, running_worker
from tests.command_line import Done, amers_here
from tests.services.formats.sensor_models import simulated_metadata as simulated

pytestmark = pytest.mark.long

TABLE = Path(__file__).parents[2] / "docs" / "methods" / "rigorous_models.md"
COMMANDS = (
    "scene register",
    "scene register-many",
    "scene ortho",
    "vectors correct",
    "surface make",
    "production run",
    "uploads",
)
a_pixel = 1.0
POINT = (1500.0, 2000.0)
products = pytest.mark.parametrize("name", list(PRODUCTS))


def amers(*words: object) -> Done:
    return amers_here(words, dict(os.environ))


class ScenesRead(InputError):
    """Stops a command where its science would begin."""


def stop(scenes: list, *_: object, **__: object) -> None:
    """The models of the scenes that a command read."""
    kinds = {type(one if isinstance(one, Scene) else one.scene).__name__ for one in scenes}
    models = [(one if isinstance(one, Scene) else one.scene).model for one in scenes]
    assert kinds == {"Scene"}
    raise ScenesRead(f"{len(models)} scenes with {', '.join(type(one).__name__ for one in models)}")


def test_the_table_of_the_documents_has_these_models_and_commands() -> None:
    text = TABLE.read_text(encoding="utf-8")
    head, _, *rows = re.findall(
        r"^\|(.*)\|$", text[text.index("| model | delivered as |") :], re.MULTILINE
    )
    assert [cell.strip() for cell in head.split("|")][2:] == list(COMMANDS)
    cells = [[cell.strip() for cell in row.split("|")] for row in rows[: len(PRODUCTS)]]
    assert [row[0] for row in cells] == list(PRODUCTS)
    assert {cell for row in cells for cell in (row[2], *row[4:])} == {"RPC"}
    assert {row[3] for row in cells} == {"RPC; orbit and attitude with `--rigorous`"}


@products
def test_an_rpc_fitted_to_the_model_is_read_and_the_model_itself_where_it_is_wanted(
    name: str, tmp_path: Path
) -> None:
    image = write_product(tmp_path / "a", name)
    true = simulated.truth(PRODUCTS[name].light_path)
    seen = np.random.default_rng(0).uniform(0.0, 1.0, (50, 2)) * simulated.SHAPE
    ground = true.locate(seen, np.full(50, 1500.0))
    fitted, itself = (
        read_scene(image, parameter_set=wanted) for wanted in (None, parameter_set_named("srp"))
    )
    assert isinstance(fitted.model, RpcModel)
    assert isinstance(itself.model, PushbroomModel)
    for scene in (fitted, itself):
        assert np.abs(scene.model.project(ground) - seen).max() < a_pixel


@products
def test_commands_on_one_image_find_the_model(name: str, tmp_path: Path) -> None:
    image, terrain = write_product(tmp_path / "a", name), write_terrain(tmp_path / "dem.tif")
    mark = write_mark(tmp_path / "mark.csv", name)
    registered = amers("scene", "register", image, "--control", mark, "-o", tmp_path / "out")
    assert registered.returncode == 0, registered.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["correction"]["shift_px"] == pytest.approx([12.0, -16.0], abs=a_pixel)
    assert (tmp_path / "out" / "refined_RPC.TXT").is_file()
    ground = ["--dem", terrain, "--vertical", "ellipsoid"]
    ortho = amers("scene", "ortho", image, *ground, "--gsd-m", "40", "-o", tmp_path / "ortho.tif")
    assert ortho.returncode == 0, ortho.stderr
    drawn = {"type": "Point", "coordinates": list(POINT)}
    features = [{"type": "Feature", "properties": {}, "geometry": drawn}]
    drawing = tmp_path / "drawn.geojson"
    drawing.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    of_scene = ["--scene", image, "--pixels", "centre", *ground, "-o", tmp_path / "map.gpkg"]
    corrected = amers("vectors", "correct", drawing, *of_scene)
    assert corrected.returncode == 0, corrected.stderr


@products
def test_commands_on_several_images_find_the_models(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = [write_product(tmp_path / f"product_{number}", name, number) for number in (1, 2)]
    monkeypatch.setattr("amers.app.usecases.surface.write_surface", stop)
    monkeypatch.setattr("amers.app.usecases.image_production.produce_points", stop)
    surface = amers("surface", "make", *images, "-o", tmp_path / "surface.tif")
    assert "2 scenes with RpcModel, RpcModel" in surface.stderr
    each = [word for image in images for word in ("--images", image)]
    block = amers("production", "run", *each, "-o", tmp_path / "block")
    assert "2 scenes with RpcModel, RpcModel" in block.stderr


def test_metadata_of_another_name_are_named_in_one_sentence(tmp_path: Path) -> None:
    image = write_product(tmp_path / "a", "WorldView")
    image.rename(image.with_name("converted.tif"))
    with pytest.raises(FormatError, match=r"21JUN03-P1BS-P001\.XML beside it has a model: --model"):
        read_scene(image.with_name("converted.tif"))
    given = image.with_name("21JUN03-P1BS-P001.XML")
    assert isinstance(read_scene(image.with_name("converted.tif"), given).model, RpcModel)


@pytest.mark.thorough
def test_uploads_find_the_model(
    client: TestClient, bearer: Bearer, settings: Settings, tmp_path: Path
) -> None:
    me, jobs = bearer("register"), {}
    for number, name in enumerate(PRODUCTS):
        image = write_product(tmp_path / str(number), name)
        mark = write_mark(tmp_path / str(number) / "mark.csv", name)
        scene = me.post(f"/scenes?name={image.name}", content=image.read_bytes()).json()["id"]
        metadata = image.with_name(PRODUCTS[name].metadata.format(1))
        for file in (metadata, mark):
            laid = me.put(f"/scenes/{scene}/files/{file.name}", content=file.read_bytes())
            assert laid.status_code == 200, laid.text
        inputs = {"scene": scene, "method": "marks", "control": mark.name}
        jobs[name] = me.execute("register-scene", inputs).headers["location"]
    with running_worker(settings, tmp_path / "log"):
        states = {name: ended(client, job, me) for name, job in jobs.items()}
    assert {name: job["status"] for name, job in states.items()} == dict.fromkeys(PRODUCTS, "successful")


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("metadata", "image", "named"),
    [
        *((f"spot1-5_dimap/SPOT{k}.DIM", "IMAGERY.TIF", "METADATA.DIM") for k in range(1, 6)),
        ("spot6_dimapv2/SPOT6.XML", "IMG_SPOT6_P.TIF", "DIM_SPOT6_P.XML"),
        (
            "pleiades_dimap/PHRDIMAP_P1BP--2018122638935449CP.XML",
            "P1BP--2018122638935449CP.TIF",
            "PHRDIMAP_P1BP--2018122638935449CP.XML",
        ),
        ("worldview_isd/WV3.XML", "16JAN01-P1BS-P001.TIF", "16JAN01-P1BS-P001.XML"),
    ],
)
def test_real_metadata_are_found_and_their_rpc_is_near(
    real_data: Path, tmp_path: Path, metadata: str, image: str, named: str
) -> None:
    source = real_data / "rigorous_metadata" / metadata
    (tmp_path / named).write_bytes(source.read_bytes())
    model = read_rigorous_model(source)
    write_empty(tmp_path / image, model.image_shape)
    scene = read_scene(tmp_path / image)
    seen = np.random.default_rng(0).uniform(0.0, 1.0, (100, 2)) * model.image_shape
    ground = model.locate(seen, np.full(100, 500.0))
    off_px = np.abs(scene.model.project(ground) - seen).max()
    print(f"{metadata}: {scene.acquisition.sensor}, {scene.sigma_m:.1f} m, {off_px:.2f} px")
    assert off_px < a_pixel
    assert scene.acquisition.sensor
