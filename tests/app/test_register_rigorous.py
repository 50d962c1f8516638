"""`amers scene register-many --rigorous`: orbits and attitudes in one block with an RPC, from files."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from jsonschema import validate
from rasterio.transform import Affine

from amers.app.config import Settings
from amers.app.storage import Storage
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.correction_json import parse_correction
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.reports.document import joint_schema, report_schema
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.moving_pushbroom import moving_model
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array
from tests.app.callers import Bearer
from tests.app.flat_world import (
    CENTRE,
    GROUND_H,
    GSD_M,
    SIGMA_M,
    FlatWorld,
    make_flat_world,
    publish_world,
)
from tests.app.worker_processes import ended, running_worker
from tests.command_line import Done, amers_here
from tests.services.formats.sensor_models.simulated_metadata import dimap_v2

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SHAPE, SIZE = (2400, 3000), 800
FIRST = (900.0, 1300.0)
"""Line and sample of the first pixel of the images in the scenes of their metadata."""
VIEWS = {
    "orbit_a": (14.0, 100.0),
    "orbit_b": (9.0, 270.0),
    "orbit_c": (18.0, 20.0),
    "oscillating": (11.0, 190.0),
}
MICRORADIANS = {
    "orbit_a": (6.0, -5.0),
    "orbit_b": (-7.0, 4.0),
    "orbit_c": (4.0, 6.0),
    "oscillating": (5.0, -4.0),
}
"""By how much roll and pitch in the metadata are off: 3 to 5 m on the ground."""
WAVE_PX = 3.0, 4.0
"""Of lines and samples of the image that oscillates, half a wave along it."""
A_FIFTH_OF_A_PIXEL = 0.2


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=SIZE, points=30)


def delivered(name: str) -> PushbroomModel:
    """The model of the metadata, of the whole scene, whose part in the middle is the image."""
    middle = np.array(FIRST) + (SIZE - 1.0) / 2.0
    target = np.array([*CENTRE, GROUND_H])
    for _ in range(3):
        model = pushbroom_over(target, SHAPE, GSD_M, VIEWS[name], (0.0, 400.0))
        target[:2] -= model.locate(middle[None], np.array([GROUND_H]))[0, :2] - CENTRE
    return model


def true_model(name: str) -> PushbroomModel:
    """Where the image truly shows the ground, in its own pixels."""
    terms = np.zeros(len(TERMS))
    terms[:2] = np.array(MICRORADIANS[name]) * 1e-6
    model = PushbroomErrors(delivered(name)).corrected(terms).cropped(FIRST, (SIZE, SIZE))
    if name != "oscillating":
        return model
    moving = moving_model(model, replace(no_correction((SIZE, SIZE)), displacement=oscillation()))
    assert moving is not None
    return moving


def oscillation() -> DisplacementGrid:
    lines, samples = np.linspace(0.0, SIZE - 1.0, 101), np.array([0.0, SIZE - 1.0])
    wave = np.sin(np.pi * lines / SIZE)[:, None, None] * np.array(WAVE_PX)
    grid = np.repeat(wave, 2, axis=1)
    return DisplacementGrid(lines, samples, grid, np.zeros_like(grid))


@pytest.fixture(scope="module")
def folder(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four parts of scenes with DIMAP metadata beside them, and an image with RPC tags."""
    folder = tmp_path_factory.mktemp("scenes")
    rng = np.random.default_rng(8)
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij"), axis=-1)
    for name in VIEWS:
        ground = true_model(name).locate(grid.reshape(-1, 2).astype(float), np.full(SIZE**2, GROUND_H))
        seen = world.true_model.project(ground).reshape(SIZE, SIZE, 2).astype(np.float32)
        pixels = cv2.remap(world.ground, seen[..., 1], seen[..., 0], cv2.INTER_CUBIC, borderValue=1500.0)
        path = folder / f"IMG_{name}.tif"
        write(
            path,
            pixels + rng.normal(0.0, 20.0, pixels.shape),
            transform=Affine.translation(*FIRST[::-1]),
        )
        (folder / f"DIM_{name}.XML").write_text(dimap_v2(delivered(name)))
    moved = world.true_model.image_offset - [12.0, -7.0]
    tagged = gdal_rpc(type(world.true_model)(**vars(world.true_model) | {"image_offset": moved}))
    write(folder / "rpc.tif", world.ground + rng.normal(0.0, 20.0, world.ground.shape), rpcs=tagged)
    return folder


def write(path: Path, pixels: Array, **georeferencing: object) -> None:
    profile = {"driver": "GTiff", "width": SIZE, "height": SIZE, "count": 1, "dtype": "uint16"}
    with rasterio.open(path, "w", **profile) as file:
        file.write(np.rint(np.clip(pixels, 1.0, 4095.0)).astype(np.uint16), 1)
        for name, value in georeferencing.items():
            setattr(file, name, value)


def register(world: FlatWorld, output: Path, *words: object) -> Done:
    control = ("--block", world.block, "--sigma-m", SIGMA_M, "-o", output)
    return amers_here(("scene", "register-many", *words, *control), os.environ)


@pytest.fixture(scope="module")
def two(world: FlatWorld, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Path]:
    """Two scenes with rigorous models and one with an RPC, registered together."""
    output = tmp_path_factory.mktemp("two") / "out"
    images = [folder / "IMG_orbit_a.tif", folder / "IMG_orbit_b.tif", folder / "rpc.tif"]
    return register(world, output, *images, "--rigorous", "srp", "--json"), output


def document(output: Path, name: str) -> dict:
    return json.loads((output / name / "report.json").read_text())


def off_px(output: Path, name: str, image: Path) -> float:
    """Largest distance of the refined RPC from the truth in the image."""
    at = np.stack(np.meshgrid(*[np.linspace(0.0, SIZE - 1.0, 7)] * 2), axis=-1).reshape(-1, 2)
    truth = true_model(name)
    refined = read_rpc(image, output / f"IMG_{name}" / "refined_RPC.TXT", (0.0, 0.0)).model
    errors = [
        refined.project(truth.locate(at, np.full(len(at), height_m))) - at
        for height_m in (GROUND_H - 50.0, GROUND_H + 50.0)
    ]
    return float(np.linalg.norm(np.concatenate(errors), axis=1).max())


def test_rigorous_scenes_and_an_rpc_are_registered_in_one_block(
    folder: Path, two: tuple[Done, Path]
) -> None:
    result, output = two
    assert result.returncode == 0, result.stderr
    report = document(output, "block")
    validate(report, joint_schema())
    scenes = {one["name"]: one for one in report["scenes"]}
    assert scenes["rpc"]["rigorous"] is None
    for name in ("orbit_a", "orbit_b"):
        found = scenes[f"IMG_{name}"]["rigorous"]
        assert found["parameter_set"] == "SRP"
        assert [own["name"] for own in found["parameters"]][:3] == ["roll", "pitch", "yaw"]
        assert found["rpc_error_px"] < 0.1
        assert "WARNING" not in found["rpc_words"]
        # A narrow image does not tell the focal length.
        assert f"IMG_{name}: the observations do not determine focal length" in found["held"]
        own = document(output, f"IMG_{name}")
        validate(own, report_schema())
        assert own["scene"]["model"] == "rigorous, SRP"
        assert own["correction"]["order_reason"].startswith("affine: the nearest to the adjusted")
        assert off_px(output, name, folder / f"IMG_{name}.tif") < A_FIFTH_OF_A_PIXEL
        correction = parse_correction((output / f"IMG_{name}" / "correction.json").read_text())
        model = CorrectedModel(delivered(name).cropped(FIRST, (SIZE, SIZE)), correction)
        truth, places = true_model(name), np.array([[0.0, 0.0], [SIZE - 1.0, SIZE - 1.0]])
        misses = model.project(truth.locate(places, np.full(2, GROUND_H))) - places
        assert np.abs(misses).max() < A_FIFTH_OF_A_PIXEL
    page, text = ((output / "block" / f"report.{kind}").read_text() for kind in ("html", "txt"))
    for words in ("pitch drift", "focal length", "an RPC fitted to the adjusted rigorous model within"):
        assert words in page
        assert words in text


def test_a_satellite_that_oscillates_is_told_by_its_attitude(
    world: FlatWorld, folder: Path, tmp_path: Path
) -> None:
    """Its points lie on the middle half of the lines: beyond them nobody knows how it oscillates."""
    images = [folder / "IMG_oscillating.tif", folder / "IMG_orbit_a.tif", folder / "rpc.tif"]
    done = register(world, tmp_path / "out", *images, "--rigorous", "srp")
    assert done.returncode == 3, done.stderr
    assert "IMG_oscillating.tif: the registration has the verdict failed (Predicted CE90" in done.stderr
    own, block = (tmp_path / "out" / name for name in ("IMG_oscillating", "block"))
    correction = parse_correction((own / "correction.json").read_text())
    model = CorrectedModel(delivered("oscillating").cropped(FIRST, (SIZE, SIZE)), correction)
    lines, samples = np.meshgrid(np.linspace(230.0, 570.0, 9), np.linspace(50.0, SIZE - 51.0, 9))
    at = np.column_stack([lines.ravel(), samples.ravel()])
    shown = model.project(true_model("oscillating").locate(at, np.full(len(at), GROUND_H)))
    assert np.linalg.norm(shown - at, axis=1).max() < 3.0 * A_FIFTH_OF_A_PIXEL
    turns = np.loadtxt(own / "attitude.csv", delimiter=",", skiprows=1)
    assert (np.diff(turns[:, :2], axis=0) > 0.0).all()
    page = (block / "report.html").read_text()
    assert f"by up to {np.abs(turns[:, 2]).max():.2g} μrad of roll" in page
    assert "Use correction.json with the delivered rigorous model, or its parameters as found" in page
    assert not (tmp_path / "out" / "IMG_orbit_a" / "attitude.csv").exists()


@pytest.mark.endurance
def test_a_rigorous_scene_joins_a_block_with_rigorous_scenes(
    world: FlatWorld, folder: Path, two: tuple[Done, Path], tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in two[1].rglob("*") if path.is_file()}
    image = folder / "IMG_orbit_c.tif"
    done = register(world, tmp_path / "out", image, "--join", two[1], "--rigorous", "srp")
    assert done.returncode == 0, done.stderr
    assert {path: path.read_bytes() for path in two[1].rglob("*") if path.is_file()} == before
    assert len(document(tmp_path / "out", "block")["joined"]) == 3
    assert off_px(tmp_path / "out", "orbit_c", image) < A_FIFTH_OF_A_PIXEL


def test_what_cannot_be_done_is_said(world: FlatWorld, folder: Path, tmp_path: Path) -> None:
    unknown = register(world, tmp_path / "out", folder / "rpc.tif", "--rigorous", "best")
    assert unknown.returncode == 2
    assert "'best' found, one of srp, toutin, spot-hrv expected" in unknown.stderr
    none = register(world, tmp_path / "out", folder / "rpc.tif", "--rigorous", "srp")
    assert none.returncode == 2
    assert "none of 1 scenes has metadata with a rigorous model" in none.stderr


def test_a_job_adjusts_the_orbits_of_uploaded_scenes(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    world: FlatWorld,
    folder: Path,
    tmp_path: Path,
    dsn: str,
    storage: Storage,
) -> None:
    publish_world(dsn, storage, world)
    me, ids = bearer("register"), {}
    for name in ("IMG_orbit_a.tif", "IMG_orbit_b.tif", "rpc.tif"):
        upload = f"/scenes?name={name}&sigma_m={SIGMA_M}"
        sent = client.post(upload, content=(folder / name).read_bytes(), headers=me)
        ids[name] = sent.json()["id"]
    for name in ("orbit_a", "orbit_b"):
        metadata = folder / f"DIM_{name}.XML"
        beside = f"/scenes/{ids[f'IMG_{name}.tif']}/files/{metadata.name}"
        assert client.put(beside, content=metadata.read_bytes(), headers=me).status_code == 200
    inputs = {"scenes": list(ids.values()), "rigorous": "srp"}
    execution = "/processes/register-scenes/execution"
    job = client.post(execution, json={"inputs": inputs}, headers=me).headers["location"]
    with running_worker(settings, tmp_path / "log"):
        done = ended(client, job, me)
    assert done["status"] == "successful", done
    results = client.get(f"/jobs/{done['jobID']}/results", headers=me).json()
    report = client.get(results["report.json"]["href"], headers=me).json()
    found = [one["rigorous"] and one["rigorous"]["parameter_set"] for one in report["scenes"]]
    assert sorted(found, key=str) == [None, "SRP", "SRP"]
