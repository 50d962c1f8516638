"""Functions of rows give each row its own result, in any order and number of rows, none included."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.geodesy import (
    continuous,
    ecef_from_east_north_up,
    ecef_from_lon_lat_h,
    lon_lat_h_from_ecef,
    metres_per_degree_at,
    move_metres,
)
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid, continuous_xy, lon_lat_of_xy, xy_of_lon_lat
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.ortho import OrthoModel, ReliefDisplacement
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Array

COUNT = 600
"""More than two batches of the kernels."""
SHAPE = (500, 700)
GRID = MapGrid("EPSG:32631", np.array([7e5, 4.8e6]), np.array([[0.0, 10.0], [-9.0, 1.0]]), SHAPE)
DEGREES = replace(GRID, crs="EPSG:4326", origin_xy=np.array([179.9, 1.0]), step_xy=GRID.step_xy * 1e-4)
RNG = np.random.default_rng(12)
LINE_SAMPLE = RNG.uniform(-0.1, 1.1, (COUNT, 2)) * SHAPE
HEIGHT_M = RNG.uniform(100.0, 900.0, COUNT)
GROUND = np.column_stack([GRID.lon_lat(LINE_SAMPLE), HEIGHT_M])
ACROSS = DEGREES.lon_lat(LINE_SAMPLE)
rounding = {"rtol": 1e-9, "atol": 1e-7}


def correction() -> ImageCorrection:
    """Affine, and a displacement on uneven nodes with a break."""
    line, sample = np.array([-50.0, 199.9, 200.1, 400.0, 530.0]), np.array([-20.0, 100.0, 710.0])
    moved, variance = RNG.normal(size=(2, 5, 3, 2))
    grid = DisplacementGrid(line, sample, moved, variance**2, np.array([200.0]))
    parameters = np.array([[3.0, 0.5, -2.0], [-1.0, 0.2, 0.7]])
    return ImageCorrection(parameters, np.array(SHAPE) / 2.0, np.array(SHAPE) / 2.0, grid)


def terrain(**more: Any) -> Terrain:
    heights, sigmas = RNG.uniform(0.0, 300.0, (2, *SHAPE)).astype(np.float32)
    return Terrain(GRID, ArrayImage(heights), sigmas=ArrayImage(sigmas), **more)


def models() -> dict[str, SensorModel]:
    text = (Path(__file__).parents[1] / "golden" / "invented_RPC.TXT").read_text()
    middle = np.append(GRID.lon_lat(np.array([[250.0, 350.0]]))[0], 500.0)
    pushbroom = pushbroom_over(middle, SHAPE, 10.0, (20.0, 100.0), (0.0, 1000.0))
    relief = ReliefDisplacement(lambda at: 400.0 + 50.0 * np.sin(900.0 * at[:, 0]), 0.1 * np.eye(2, 3))
    rpc = parse_rpc_text(text)
    return {
        "RPC": replace(rpc, ground_offset=middle, image_offset=np.array(SHAPE) / 2.0),
        "pushbroom": pushbroom,
        "map": OrthoModel(GRID),
        "map with relief": OrthoModel(GRID, displacement=relief),
        "corrected": CorrectedModel(pushbroom, correction()),
    }


def of_models() -> dict[str, tuple[Callable[..., Any], tuple[Array, ...]]]:
    found: dict[str, tuple[Callable[..., Any], tuple[Array, ...]]] = {}
    for name, model in models().items():
        found[f"{name}: project"] = model.project, (GROUND,)
        found[f"{name}: project_derivative"] = model.project_derivative, (GROUND,)
        found[f"{name}: locate"] = model.locate, (LINE_SAMPLE, HEIGHT_M)
        found[f"{name}: line_of_sight"] = model.line_of_sight, (LINE_SAMPLE,)
    return found


MOVED, TERRAIN, UNDULATING = correction(), terrain(), terrain(geoid=lambda at: 40.0 + at[:, 1])
assert MOVED.displacement is not None
FUNCTIONS: dict[str, tuple[Callable[..., Any], tuple[Array, ...]]] = {
    "ecef": (ecef_from_lon_lat_h, (GROUND,)),
    "geodetic": (lon_lat_h_from_ecef, (ecef_from_lon_lat_h(GROUND),)),
    "axes": (ecef_from_east_north_up, (GROUND,)),
    "metres per degree": (metres_per_degree_at, (GROUND,)),
    "moves": (move_metres, (GROUND, RNG.normal(size=(COUNT, 3)))),
    "map positions": (lambda at: xy_of_lon_lat("EPSG:32631", at), (GROUND[:, :2],)),
    "ground of a map": (lambda at: lon_lat_of_xy("EPSG:4326", at), (ACROSS + [360.0, 0.0],)),
    "lines and samples": (GRID.line_sample, (GROUND,)),
    "longitudes and latitudes": (DEGREES.lon_lat, (LINE_SAMPLE,)),
    "pixels across the antimeridian": (DEGREES.line_sample, (ACROSS,)),
    "derivatives of a map": (GRID.derivative, (GROUND,)),
    "heights": (TERRAIN.height_m, (GROUND[:, :2],)),
    "heights above a geoid": (UNDULATING.height_m, (GROUND[:, :2],)),
    "slopes": (UNDULATING.slope, (GROUND[:, :2],)),
    "sigmas": (TERRAIN.sigma_m, (GROUND[:, :2],)),
    "corrections": (MOVED.apply, (LINE_SAMPLE,)),
    "derivatives of corrections": (MOVED.derivative_at, (LINE_SAMPLE,)),
    "corrections back": (MOVED.invert, (LINE_SAMPLE,)),
    "covariances": (lambda at: MOVED.covariance_at(at, np.eye(6), np.ones(2)), (LINE_SAMPLE,)),
    "means over chips": (lambda at: MOVED.displacement.averaged(at, 20.0), (LINE_SAMPLE,)),
    **of_models(),
}


def results(name: str, rows: slice | Array) -> tuple[Array, ...]:
    """What a function gives for some of its rows."""
    function, arguments = FUNCTIONS[name]
    found = function(*(argument[rows] for argument in arguments))
    return found if isinstance(found, tuple) else (found,)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_rows_have_their_own_results_in_any_order_and_number(name: str) -> None:
    whole = results(name, slice(None))
    order = np.random.default_rng(1).permutation(COUNT)
    none = results(name, order[:0])
    for rows in (order, order[:257], *(np.array([row]) for row in (0, 255, 256, COUNT - 1))):
        for found, expected in zip(results(name, rows), whole, strict=True):
            np.testing.assert_allclose(found, expected[rows], **rounding)
    for found, expected in zip(none, whole, strict=True):
        assert found.shape == (0, *expected.shape[1:])
        assert np.isfinite(expected).reshape(COUNT, -1).all(axis=1).mean() > 0.5


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_row_that_is_unknown_has_no_result_and_changes_no_other(name: str) -> None:
    function, arguments = FUNCTIONS[name]
    holed = [argument[:300].copy() for argument in arguments]
    holed[0][[7, 280]] = np.nan
    found = function(*holed)
    for one, expected in zip(
        found if isinstance(found, tuple) else (found,), results(name, slice(300)), strict=True
    ):
        assert np.isnan(one[[7, 280]]).any(axis=tuple(range(1, one.ndim))).all()
        known = np.delete(np.arange(300), [7, 280])
        np.testing.assert_allclose(one[known], expected[known], **rounding)


@pytest.mark.parametrize(
    ("crs", "turn", "seam_deg"), [("EPSG:4326", 360.0, 180.0), ("EPSG:4807", 400.0, -177.66)]
)
def test_positions_on_a_geographic_map_go_on_beyond_its_seam(
    crs: str, turn: float, seam_deg: float
) -> None:
    """The seam of a map from Paris lies where longitudes go on."""
    lon_lat = continuous(ACROSS) + [seam_deg - 180.0, 0.0]
    xy, plain = continuous_xy(crs, lon_lat), xy_of_lon_lat(crs, lon_lat)
    assert np.ptp(xy[:, 0]) < 0.01 * turn
    assert seam_deg == 180.0 or np.ptp(plain[:, 0]) > 0.9 * turn
    turns = (xy - plain) / [turn, 1.0]
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    assert continuous_xy(crs, lon_lat[:0]).shape == (0, 2)
