"""A simulated scene over rough ground, for vectors between its image and the map."""

from functools import cache

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.terrain import Terrain
from amers.services.types import Acquisition, Array, FloatImage

SHAPE = (420, 380)
GSD_M = 2.0
CRS = "EPSG:32631"
DEM = MapGrid("EPSG:4326", np.array([5.19, 44.22]), np.array([[0.0, 1e-4], [-1e-4, 0.0]]), (320, 340))
"""Nodes 11 m apart to the north, 8 m to the east."""


def heights(relief_m: float = 60.0) -> FloatImage:
    line, sample = np.indices(DEM.shape)
    waves = np.sin(line / 9.0) * np.cos(sample / 11.0) + 0.3 * np.sin((line - 2 * sample) / 5.0)
    rough = np.random.default_rng(1).normal(0.0, 0.02, DEM.shape)
    return (700.0 + relief_m * (waves + rough)).astype(np.float32)


def terrain(relief_m: float = 60.0) -> Terrain:
    return Terrain(DEM, ArrayImage(heights(relief_m)))


@cache
def scene(incidence_deg: float = 25.0) -> Scene:
    lon, lat = DEM.lon_lat(np.array([[160.0, 170.0]]))[0]
    true = pushbroom_over(
        np.array([lon, lat, 700.0]), SHAPE, GSD_M, (incidence_deg, 100.0), (100.0, 1300.0)
    )
    model = fit_rpc(true, SHAPE, (100.0, 1300.0)).model
    return Scene(ArrayImage(np.ones(SHAPE, dtype=np.float32)), model, Acquisition("a"), 5.0)


def image_places(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(20.0, np.array(SHAPE) - 20.0, (count, 2))
