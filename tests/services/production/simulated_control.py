"""Views with errors of some metres, and the true error on the Earth of the blocks made of them."""

from functools import cache

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.production.control import Control
from amers.services.production.image_production import Production, produce_points
from amers.services.simulation.view import SimulatedView
from amers.services.tasks import Work
from amers.services.types import Array
from tests.services.simulated import OPTIONS, truth_of, views_of, world
from tests.services.ties import difference_m

SIGMA_M = 5.0
CHI2_3 = 11.3
"""Chi-squared of three coordinates that one draw of a hundred exceeds."""


@cache
def views(seed: int, error_m: float = SIGMA_M) -> tuple[SimulatedView, ...]:
    return views_of(world(), np.random.default_rng(seed), error_m=error_m)


def scenes(seed: int) -> list[Scene]:
    return [view.as_scene(SIGMA_M) for view in views(seed)]


@cache
def _without_control(seed: int) -> tuple[Production, Work]:
    work = Work()
    return produce_points(scenes(seed), OPTIONS, work=work), work


def free(seed: int) -> Production:
    """The block of a seed without control."""
    return _without_control(seed)[0]


def placed(seed: int, control: Control) -> Production:
    """The block of a seed with control: what its images show of each other is measured once."""
    kept = _without_control(seed)[1].kept
    shown = {
        name: kept[name] for name in kept if name.startswith(("features/", "matches/", "measures/"))
    }
    return produce_points(scenes(seed), OPTIONS, control=control, work=Work(kept=shown))


def frame_error_m(made: Production, seen: tuple[SimulatedView, ...]) -> Array:
    """Mean error (3,) on the Earth of the points: the true ground of what the images show there."""
    return difference_m(made.points.lon_lat_h, truth_of(made, seen).lon_lat_h).mean(axis=0)
