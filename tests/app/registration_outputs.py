"""Checks of the outputs of a registration of the flat world, and files to send with its scene."""

import json
from pathlib import Path

import numpy as np
import rasterio
from jsonschema import validate

from amers.app.usecases.registration.deliverables import OUTPUTS
from amers.services.formats.gcp.reader import read_control_points
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.reports.document import report_schema
from amers.services.sensors.base import SensorModel
from amers.services.sensors.rpc import RpcModel
from tests.app.flat_world import CENTRE, GROUND_H, FlatWorld

A_TENTH_OF_A_PIXEL = 0.1
A_MILLIONTH_OF_A_PIXEL = 1e-6
MASKED_LINES = 400
CHECK_POINTS = 36
COMMON_FILES = set(OUTPUTS)


def largest_error_px(model: RpcModel, truth: SensorModel) -> float:
    """Largest distance in the image between two models, over the ground of the scene."""
    step = np.linspace(-0.003, 0.003, 5)
    lon, lat, h = np.meshgrid(
        step + CENTRE[0], step + CENTRE[1], GROUND_H + np.array([-50.0, 0.0, 50.0])
    )
    ground = np.column_stack([lon.ravel(), lat.ravel(), h.ravel()])
    return float(np.linalg.norm(model.project(ground) - truth.project(ground), axis=1).max())


def assert_registered(folder: Path, world: FlatWorld) -> None:
    """Check that the report follows its schema and that the refined model is right."""
    report = json.loads((folder / "report.json").read_text())
    validate(report, report_schema())
    (only,) = report["run"]["blocks"]
    assert (only["id"], only["version"]) == ("flat", "1")
    assert only["active"] == report["point_counts"]["active"]
    refined = read_rpc(world.image, folder / "refined_RPC.TXT").model
    assert largest_error_px(refined, world.true_model) < A_TENTH_OF_A_PIXEL
    assert_exchanged(folder, report["point_counts"]["active"])
    points = json.loads((folder / "control_points.geojson").read_text())["features"]
    active = [point for point in points if point["properties"]["status"] == "active"]
    assert len(active) == report["point_counts"]["active"]
    assert "<html" in (folder / "report.html").read_text()


def assert_exchanged(folder: Path, active: int) -> None:
    """Check that every exchange format has the active points at the positions of the GeoJSON file."""
    document = read_control_points(folder / "control_points.geojson")
    used = document.take(document.active)
    assert len(used) == active
    for name in ("gcp", "points", "pts"):
        points = read_control_points(folder / f"control_points.{name}", "ellipsoid")
        assert (
            np.abs(points.line_sample[points.active] - used.line_sample).max() < A_MILLIONTH_OF_A_PIXEL
        )
    opf = read_control_points(folder / "control_points_opf.json")
    assert np.abs(opf.line_sample - used.line_sample).max() < A_MILLIONTH_OF_A_PIXEL
    assert np.abs(opf.lon_lat_h - used.lon_lat_h).max() == 0.0


def write_mask(path: Path) -> None:
    """Write a mask, four times coarser than the scene, that hides its first lines."""
    hidden = np.zeros((300, 300), np.uint8)
    hidden[: MASKED_LINES // 4 + 30] = 1
    with rasterio.open(path, "w", driver="GTiff", width=300, height=300, count=1, dtype="uint8") as file:
        file.write(hidden, 1)


def write_check_points(path: Path, world: FlatWorld, moved_px: float = 0.0) -> None:
    """Write true ground points of the scene as GeoJSON, with marks shifted along the lines."""
    step = np.linspace(-0.002, 0.002, 6)
    lon, lat = (axis.ravel() for axis in np.meshgrid(step + CENTRE[0], step + CENTRE[1]))
    ground = np.column_stack([lon, lat, np.full(CHECK_POINTS, GROUND_H)])
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place.tolist()},
            "properties": {"line": line + moved_px, "sample": sample, "sigma_px": 0.2, "check": True},
        }
        for place, (line, sample) in zip(ground, world.true_model.project(ground), strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))


def assert_masked(folder: Path) -> None:
    """Check that no point under the mask was searched."""
    points = json.loads((folder / "control_points.geojson").read_text())["features"]
    under_the_mask = [
        one["properties"]["reason"]
        for one in points
        if one["properties"]["predicted_line"] < MASKED_LINES
    ]
    assert set(under_the_mask) <= {"nodata", "not_tried"}
    assert "nodata" in under_the_mask
