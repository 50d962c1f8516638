"""Three real views: points made from two of them, and the third registered on these by the service."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.raster import open_raster, write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.imagery.scene import scene_gsd_m
from amers.services.imagery.source import ArrayImage, Window
from amers.services.production.image_production import ProductionOptions, produce_points
from amers.services.registration.on_points import register_scene
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import ImageCorrection, fold_into_rpc, no_correction
from amers.services.sensors.rpc import RpcModel
from tests.journeys.ties import independent_tracks
from tests.services.simulated import MemoryChips

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

names = ("img_01", "img_02", "img_03")
injected_shift_px = np.array([400.0, -900.0])
"""492 m on the ground; the scene is 512 m wide."""
injected_drift_px = 2.0
injected_sigma_m = "200"
delivered_residual_px = (0.4, 0.7)
delivered_shift_px = 2.0
"""Largest expected difference between the views as delivered."""
three_tenths_of_a_pixel = 0.3
five_kilometres = 5000.0
far_sigma_m = 1700.0
half_metre_chips = ProductionOptions(fine_gsd_m=0.5, coarse_gsd_m=2.0, surface_pairs=0)


@pytest.fixture(scope="module")
def triplet(real_data: Path) -> dict[str, Path]:
    return {name: real_data / "phr_calanques_triplet" / f"{name}.tif" for name in names}


@pytest.fixture(scope="module")
def pixels(triplet):
    images = {}
    for name, path in triplet.items():
        with_image = open_raster(path)
        images[name] = with_image.read(Window(0, 0, *with_image.shape))
        with_image.close()
    return images


@pytest.fixture(scope="module")
def tracks(pixels):
    return independent_tracks([pixels[name] for name in names])


def median_residual_px(models: list[SensorModel], tracks) -> float:
    intersections = intersect(models, tracks, int(tracks.point[-1]) + 1)
    return float(np.median(np.linalg.norm(intersections.residual_px, axis=1)))


def spoiled(model: RpcModel, shape: tuple[int, int]) -> RpcModel:
    """The model with the injected shift and the injected drift from one edge to the other."""
    frame = no_correction(shape)
    drift = np.diag([injected_drift_px / 2.0, injected_drift_px / 2.0])
    parameters = np.column_stack([injected_shift_px, drift])
    return fold_into_rpc(model, ImageCorrection(parameters, frame.centre, frame.half_size))


def test_independent_ties_disagree_with_the_models_as_delivered(triplet, tracks):
    models = [read_rpc(path).model for path in triplet.values()]
    assert tracks.point[-1] > 300
    low, high = delivered_residual_px
    assert low < median_residual_px(models, tracks) < high


@pytest.mark.parametrize(
    ("sources", "third"),
    [
        (("img_01", "img_02"), "img_03"),
        pytest.param(("img_02", "img_03"), "img_01", marks=pytest.mark.endurance),
        pytest.param(("img_01", "img_03"), "img_02", marks=pytest.mark.endurance),
    ],
)
def test_a_spoiled_third_view_agrees_with_the_other_two_once_registered(
    triplet, pixels, tracks, sources, third, service, amers, secret, tmp_path
):
    block = tmp_path / f"calanques-without-{third}"
    images = [word for name in sources for word in ("--images", triplet[name])]
    made = amers("production", "run", *images, "-o", block)
    assert made["points"] >= 100
    amers("block", "ingest", block, "--publish")

    delivered = read_rpc(triplet[third]).model
    scene = tmp_path / f"{third}.tif"
    wrong = spoiled(delivered, pixels[third].shape)
    write_raster(scene, pixels[third].astype(np.uint16), wrong)
    out = tmp_path / "registered"
    result = amers(
        *("scene", "register", scene, "--sigma-m", injected_sigma_m, "-o", out),
        *("--server", service.url, "--token", secret),
    )
    amers("block", "withdraw", block.name)

    models = dict.fromkeys(names, delivered)
    for name in sources:
        models[name] = parse_rpc_text((block / "models" / f"{name}_RPC.TXT").read_text())
    models[third] = wrong
    assert (
        not median_residual_px(list(models.values()), tracks) < 1.0
    )  # With such an error no rays intersect.
    models[third] = parse_rpc_text((out / "refined_RPC.TXT").read_text())
    left_px = median_residual_px(list(models.values()), tracks)
    print(f"{third} from {injected_shift_px} px: {left_px:.3f} px, {result['verdict']}")
    assert left_px < three_tenths_of_a_pixel
    assert result["verdict"] in ("good", "usable")
    drift_there_px = injected_drift_px * np.abs(injected_shift_px) / pixels[third].shape
    found_px = np.array(result["shift_px"])
    assert (np.abs(found_px + injected_shift_px) < delivered_shift_px + drift_there_px).all()
    for name in ("report.json", "report.html", "control_points.geojson", f"{scene.stem}_RPC.TXT"):
        assert (out / name).stat().st_size > 0


@pytest.mark.endurance
@pytest.mark.parametrize("direction_deg", [30.0, 115.0])
def test_a_third_view_five_kilometres_off_is_found(triplet, pixels, tracks, direction_deg):
    images = {
        name: replace(read_scene(path), image=ArrayImage(pixels[name])) for name, path in triplet.items()
    }
    made = produce_points([images["img_01"], images["img_02"]], half_metre_chips)
    chips = MemoryChips(np.concatenate([made.chips(row) for row in range(len(made.points))]))
    third = images["img_03"]
    towards = np.array([np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg))])
    shift_px = five_kilometres / scene_gsd_m(third) * towards
    far_off = replace(third.model, image_offset=third.model.image_offset + shift_px)
    registered = register_scene(replace(third, model=far_off, sigma_m=far_sigma_m), made.points, chips)
    left_px = median_residual_px([*made.adjustment.models, registered.model], tracks)
    print(f"img_03 from {five_kilometres:g} m: {left_px:.3f} px, {registered.qualification.verdict}")
    assert registered.search_stages[0].search_radius_m >= five_kilometres
    assert left_px < three_tenths_of_a_pixel
    assert registered.qualification.verdict in ("good", "usable")


def test_a_refined_model_comes_back_in_the_tags_of_the_image(triplet, pixels, tmp_path):
    delivered = read_rpc(triplet["img_01"]).model
    moved = replace(delivered, image_offset=delivered.image_offset + injected_shift_px)
    write_raster(tmp_path / "copy.tif", pixels["img_01"].astype(np.uint16), moved)
    assert np.array_equal(read_rpc(tmp_path / "copy.tif").model.image_offset, moved.image_offset)
