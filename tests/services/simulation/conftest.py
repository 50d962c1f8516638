"""A world of 600 m, and the geometry of a view of its middle, made once for all tests."""

import numpy as np
import pytest

from amers.services.simulation.render import Radiometry
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world

SILENT = Radiometry(noise_floor=0.0, noise_per_signal=0.0)


@pytest.fixture(scope="session")
def world() -> World:
    return make_world(np.random.default_rng(3), size_m=600.0, posting_m=0.5)


@pytest.fixture(scope="session")
def taken(world: World) -> ViewGeometry:
    """Of 300 lines and 330 samples, without noise."""
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan("view", (lon, lat), (300, 330), 0.5, 15.0, 100.0, radiometry=SILENT)
    return plan_geometry(world, plan, np.random.default_rng(0))
