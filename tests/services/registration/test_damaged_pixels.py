"""Damaged pixels cost what they hide: scattered ones nothing, areas the points that they cover."""

from functools import cache

import numpy as np
import pytest

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.registration.on_points import Registration, register_scene
from amers.services.simulation.view import SimulatedView
from amers.services.types import FloatImage
from tests.services.simulated import block, spoiled_view

pytestmark = [pytest.mark.long, pytest.mark.thorough]

five_percent = 0.05
SIGMA_M = 15.0


@cache
def view() -> SimulatedView:
    return spoiled_view()


def registered(pixels: FloatImage) -> Registration:
    scene = view().as_scene(SIGMA_M)
    damaged = Scene(ArrayImage(pixels), scene.model, scene.acquisition, scene.sigma_m)
    return register_scene(damaged, *block())


@cache
def clean() -> Registration:
    return registered(view().pixels.astype(np.float32))


def predicted_ce90_px(registration: Registration) -> float:
    criteria = registration.qualification.criteria
    return next(c.value for c in criteria if c.name == "predicted_ce90_px")


@pytest.mark.parametrize(
    ("lost", "share"), [(np.inf, 3e-4), (np.nan, 3e-4), (np.inf, 0.01), (np.nan, 0.01)]
)
def test_scattered_damaged_pixels_cost_nothing(lost: float, share: float) -> None:
    pixels = view().pixels.astype(np.float32)
    pixels[np.random.default_rng(4).random(pixels.shape) < share] = lost
    damaged = registered(pixels)
    assert damaged.qualification.verdict == clean().qualification.verdict
    count = int(clean().measures.active.sum())
    assert abs(int(damaged.measures.active.sum()) - count) <= max(five_percent * count, 1.0)
    assert predicted_ce90_px(damaged) == pytest.approx(predicted_ce90_px(clean()), rel=five_percent)


@pytest.mark.parametrize(("lost", "reason"), [(np.inf, "saturated"), (np.nan, "nodata")])
def test_points_in_a_damaged_area_have_its_reason_and_others_stay(lost: float, reason: str) -> None:
    pixels = view().pixels.astype(np.float32)
    pixels[:, :300] = lost
    measures = registered(pixels).measures
    inside = measures.predicted[:, 1] < 230.0
    assert inside.sum() >= 3
    assert set(measures.reason[inside]) == {reason}
    assert measures.active[measures.predicted[:, 1] > 400.0].mean() > 0.5
