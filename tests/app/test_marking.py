"""Marks in a scene while a person sets them: `read-model` and `POST /jobs/{id}/marks`."""

from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient

from amers.app.api.marks import MOST_MARKS, MOST_PLACES
from amers.app.config import Settings
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.marking import HeightSource, Place, SetMark, adjust_set_marks
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.scene_model import format_scene_model, parse_scene_model
from amers.services.types import Array
from tests.app.callers import Bearer, Caller
from tests.app.flat_world import CENTRE, GROUND_H, SIGMA_M, FlatWorld, make_flat_world
from tests.app.worker_processes import ended, running_worker
from tests.geotiffs import write_geotiff

pytestmark = [pytest.mark.long, pytest.mark.thorough]

a_thousandth_px = 1e-3
a_tenth_of_a_pixel = 0.1
PICKED = np.array([[200.0, 200.0], [200.0, 1000.0], [1000.0, 250.0], [900.0, 900.0], [600.0, 550.0]])
ACCURATE = {"sigma_m": [0.1, 0.1], "mark_sigma_px": 0.2}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


def ground_of(world: FlatWorld) -> Array:
    return world.true_model.locate(PICKED, np.full(len(PICKED), GROUND_H))


def set_marks(world: FlatWorld) -> list[dict]:
    """Marks without an error."""
    names = ("name", "line", "sample", "lon", "lat", "height_m")
    rows = zip(PICKED.tolist(), ground_of(world).tolist(), strict=True)
    return [
        dict(zip(names, (f"GCP{k}", *mark, *place), strict=True)) for k, (mark, place) in enumerate(rows)
    ]


@pytest.fixture
def references(tmp_path: Path) -> Path:
    """The folder of the installation's references."""
    folder = tmp_path / "references"
    folder.mkdir()
    return folder


@pytest.fixture
def settings(settings: Settings, references: Path) -> Settings:
    return settings.model_copy(update={"reference_folder": references})


@pytest.fixture
def marking(
    client: TestClient, me: Caller, settings: Settings, world: FlatWorld, tmp_path: Path
) -> Callable[..., httpx.Response]:
    """Sends marks in the uploaded scene of the world."""
    sent = me.post(f"/scenes?name=tagged.tif&sigma_m={SIGMA_M}", content=world.tagged.read_bytes())
    response = me.execute("read-model", {"scene": sent.json()["id"]})
    with running_worker(settings, tmp_path / "log"):
        job = ended(client, response.headers["location"], me)
    assert job["status"] == "successful", job
    path = f"/jobs/{job['jobID']}/marks"

    def send(caller: Caller = me, **body: object) -> httpx.Response:
        return caller.post(path, json=body)

    return send


def test_marks_are_adjusted_and_predict_where_the_next_one_is(
    marking: Callable[..., httpx.Response], bearer: Bearer, world: FlatWorld
) -> None:
    *marks, last = set_marks(world)
    place = {name: last[name] for name in ("lon", "lat", "height_m")}
    none = marking(places=[place]).json()
    assert none["marks"] == []
    assert none["verdict"] is None
    off_px = np.hypot(
        none["places"][0]["line"] - last["line"], none["places"][0]["sample"] - last["sample"]
    )
    assert a_tenth_of_a_pixel < off_px < 5.0 * none["places"][0]["sigma_px"]

    found = marking(marks=marks, places=[place, {"line": 600, "sample": 550}], **ACCURATE).json()
    assert [mark["status"] for mark in found["marks"]] == ["used"] * 4
    assert np.abs([mark["residual_px"] for mark in found["marks"]]).max() < a_tenth_of_a_pixel
    assert found["relative_to_control_points"]["ce90_m"] > 0
    into_image, onto_ground = found["places"]
    assert np.hypot(into_image["line"] - 600, into_image["sample"] - 550) < a_tenth_of_a_pixel
    assert into_image["is_height_known"]
    assert not onto_ground["is_height_known"]
    assert onto_ground["height_m"] == pytest.approx(GROUND_H)
    assert abs(onto_ground["lon"] - last["lon"]) < 1e-6

    wrong = [{**marks[0], "sample": marks[0]["sample"] + 40}, *marks[1:], {**last, "check": True}]
    blunder = marking(marks=wrong, **ACCURATE).json()
    assert [mark["status"] for mark in blunder["marks"]] == ["rejected", "used", "used", "used", "check"]
    assert any("GCP0 is not used" in words for words in blunder["words"])
    assert np.abs(blunder["marks"][-1]["residual_px"]).max() < a_tenth_of_a_pixel
    assert marking(bearer("register"), marks=marks).status_code == 404
    assert marking(bearer("read"), marks=marks).status_code == 403


def test_heights_that_are_not_given_are_those_of_the_terrain_of_a_reference(
    marking: Callable[..., httpx.Response], admin: Caller, references: Path, world: FlatWorld
) -> None:
    """The terrain is flat, and states 0.5 m; the accuracy of the height that follows is that of it."""
    west, north = CENTRE + [-0.01, 0.01]
    grid = rasterio.transform.from_origin(west, north, 0.0005, 0.0005)
    profile = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "crs": "EPSG:4326"}
    for name, value in (("ortho", 100.0), ("ground", GROUND_H)):
        with rasterio.open(
            references / f"{name}.tif", "w", **profile, dtype="float32", transform=grid
        ) as file:
            file.write(np.full((40, 40), value, dtype=np.float32), 1)
    body = {"name": "land", "image": "ortho.tif", "dem": "ground.tif", "vertical": "ellipsoid"}
    added = admin.post("/references", json={**body, "sigma_up_m": 0.5})
    assert added.status_code == 201, added.text
    marks = set_marks(world)
    found = marking(
        marks=[{**mark, "height_m": None, "check": mark["name"] == "GCP4"} for mark in marks],
        places=[{"line": 600, "sample": 550}, {"lon": marks[4]["lon"], "lat": marks[4]["lat"]}],
        **ACCURATE,
    ).json()
    assert found["terrain"] == "land"
    assert [mark["height_m"] for mark in found["marks"]] == pytest.approx([GROUND_H] * 5)
    assert [mark["sigma_m"][2] for mark in found["marks"]] == pytest.approx([0.5] * 5)
    for place in found["places"]:
        assert place["is_height_known"]
        assert place["height_m"] == pytest.approx(GROUND_H)
    assert abs(found["places"][0]["lon"] - marks[4]["lon"]) < 1e-6


def test_marks_that_cannot_be_used_are_refused_by_name(
    marking: Callable[..., httpx.Response], world: FlatWorld
) -> None:
    first, second, *_ = marks = set_marks(world)
    cases = [
        ({"marks": [{**first, "height_m": None}]}, "GCP0 has no height_m"),
        ({"marks": [first, {**second, "name": "GCP0"}]}, "GCP0 is marked 2 times"),
        ({"marks": [{**first, "line": 5000}]}, "GCP0"),
        ({"marks": [{**first, "lon": first["lat"], "lat": first["lon"]}]}, "exchanged"),
        ({"marks": [{**first, "lat": 91}]}, "lat"),
        ({"marks": [{**first, "sigma_m": [0, 1]}]}, "sigma_m"),
        ({"marks": marks[:1] * (MOST_MARKS + 1)}, str(MOST_MARKS)),
        ({"places": [{"line": 1}]}, "line and sample expected, or lon and lat"),
        ({"places": [{"line": 1, "sample": 1, "lon": 1, "lat": 1}]}, "line and sample expected"),
        ({"places": [{"line": 1, "sample": 1}] * (MOST_PLACES + 1)}, str(MOST_PLACES)),
        ({"marks": [first], "colour": "red"}, "colour"),
    ]
    for body, words in cases:
        refused = marking(**body)
        assert refused.status_code == 422, (body, refused.text)
        assert words in refused.text
    every = marking(marks=[{**mark, "check": True} for mark in marks]).json()
    assert [mark["status"] for mark in every["marks"]] == ["check"] * len(marks)
    assert every["verdict"] is None


def test_a_job_that_read_no_model_has_no_marks(me: Caller, world: FlatWorld) -> None:
    sent = me.post("/scenes?name=tagged.tif", content=world.tagged.read_bytes())
    job = me.execute("view-scene", {"scene": sent.json()["id"]}).json()["jobID"]
    refused = me.post(f"/jobs/{job}/marks", json={})
    assert refused.status_code == 404
    assert "scene_model.json" in refused.json()["detail"]


def test_the_document_of_a_model_has_the_model_as_delivered(world: FlatWorld) -> None:
    scene = read_scene(world.tagged, sigma_m=SIGMA_M)
    again = parse_scene_model(format_scene_model(scene), "scene_model.json")
    ground = ground_of(world)
    assert np.array_equal(again.model.project(ground), scene.model.project(ground))
    assert again.image.shape == scene.image.shape
    assert again.sigma_m == SIGMA_M


def test_the_sigma_of_a_followed_place_is_that_of_its_worse_coordinate(world: FlatWorld) -> None:
    """Ground of unknown height moves along the line of sight, which is along the samples."""
    scene = read_scene(world.tagged, sigma_m=SIGMA_M)
    marks = [SetMark(**mark) for mark in set_marks(world)]
    stated = PointStatements(sigma_m=(0.1, 10.0), mark_sigma_px=0.2)
    adjusted = adjust_set_marks(scene, marks, [Place(600.0, 550.0)], HeightSource(), stated)
    assert adjusted.registration is not None
    at = np.array([[600.0, 550.0]])
    lines_px, samples_px = np.sqrt(np.diagonal(adjusted.registration.adjustment.covariance_at(at)[0]))
    assert adjusted.places[0].sigma_px == pytest.approx(samples_px)
    assert samples_px > 1.2 * lines_px


def test_marks_in_an_ortho_image_need_no_heights(tmp_path: Path) -> None:
    """A map grid that is moved by 12 m comes back, from a document of its model."""
    path, moved_m = tmp_path / "ortho.tif", np.array([12.0, -5.0])
    grid = rasterio.transform.from_origin(700_000.0, 4_800_000.0, 2.0, 2.0)
    write_geotiff(path, np.ones((300, 400), dtype=np.uint8), crs="EPSG:32631", transform=grid)
    scene = parse_scene_model(format_scene_model(read_scene(path, sigma_m=10.0)), "scene_model.json")
    picked = np.array([[50.0, 60.0], [250.0, 90.0], [120.0, 350.0]])
    ground = scene.model.locate(picked + moved_m / 2.0, np.zeros(3))
    marks = [
        SetMark(f"M{number}", *mark, *place[:2])
        for number, (mark, place) in enumerate(zip(picked.tolist(), ground.tolist(), strict=True))
    ]
    stated = PointStatements(sigma_m=(0.1, 0.1), mark_sigma_px=0.2)
    places = [Place(line=150.0, sample=200.0)]
    adjusted = adjust_set_marks(scene, marks, places, HeightSource(), stated)
    assert [mark.status for mark in adjusted.results] == ["used"] * 3
    true = scene.model.locate(np.array([[150.0, 200.0]]) + moved_m / 2.0, np.zeros(1))[0]
    assert abs(adjusted.places[0].lon - true[0]) < 1e-6
    assert abs(adjusted.places[0].lat - true[1]) < 1e-6
