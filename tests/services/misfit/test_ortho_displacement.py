"""What displaces an ortho-image is followed in both directions, and errors of its points are not."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.map_grid import MapGrid
from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.accuracy import normalised_error
from amers.services.quality.normal_law import normal_ce90
from amers.services.sensors.correction import no_correction
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array

SHAPE = (4000, 3000)
PIXELS = MapGrid("EPSG:32631", np.array([450e3, 4900e3]), np.array([[0.0, 1.0], [-1.0, 0.0]]), SHAPE)
COUNT, SIGMA_PX, CHIP_PX = 100, 0.5, 64.0
WRONG = 3.0
"""True over predicted CE90 from which on a result is wrong."""
_WAVES = 60

Field = Callable[[Array], Array]
"""Displacement (n, 2) of positions (n, 2)."""


def still(place: Array) -> Array:
    return np.zeros_like(place)


def smooth(seed: int, length: float, size_px: float) -> Field:
    """A random field that neighbours within a length, in sides of the image, have in common."""
    rng = np.random.default_rng([9, seed])
    frequency = rng.normal(0.0, 1.0 / (length * max(SHAPE)), (_WAVES, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES))

    def field(place: Array) -> Array:
        turns = place @ frequency.T
        waves = np.column_stack([np.cos(turns + own).sum(axis=1) for own in phase])
        return np.asarray(size_px * np.sqrt(2.0 / _WAVES) * waves)

    return field


@dataclass(frozen=True)
class Trial:
    """An ortho-image, adjusted, and how far off it is at places all over it, pixels.

    Attributes:
        adjustment: of the image.
        ce90_px, ratio: true CE90, and over the median of the predicted ones.
        normalised: mean square of the errors over what is stated.
        worst_px: largest predicted CE90.
    """

    adjustment: SceneAdjustment
    ce90_px: float
    ratio: float
    normalised: float
    worst_px: float


def trial(
    seed: int,
    *,
    image: Field = still,
    points: Field = still,
    point_sigma_px: float = 0.0,
    stated_px: float | None = None,
    sigma_stated_px: float = SIGMA_PX,
    at: Callable[[Array], Array] = lambda place: np.ones(len(place), dtype=bool),
) -> Trial:
    """An image that is shifted, skewed and displaced, on points that err, some of them by far."""
    rng = np.random.default_rng(seed)
    frame = no_correction(SHAPE)
    parameters = np.column_stack([rng.normal(0.0, 10.0, 2), rng.normal(0.0, 1.0, (2, 2))])
    truth = replace(frame, parameters=parameters)
    model, size = OrthoModel(PIXELS), np.array(SHAPE) - 1.0
    place = rng.random((COUNT, 2)) * size
    noise_px = np.hypot(SIGMA_PX, point_sigma_px) * rng.normal(size=(COUNT, 2))
    line_sample = truth.apply(place) + image(place) + points(place) + noise_px
    blunder = rng.random(COUNT) < 0.06
    line_sample[blunder] += rng.choice([-1.0, 1.0], (blunder.sum(), 2)) * rng.uniform(5.0, 25.0)
    stated = np.diag([(stated_px or point_sigma_px) ** 2] * 2 + [1e-6])
    observations = ControlObservations(
        model.locate(place, np.full(COUNT, 100.0)),
        line_sample,
        np.full(COUNT, sigma_stated_px),
        np.tile(stated, (COUNT, 1, 1)),
        chip_side_px=CHIP_PX,
    )
    adjustment = adjust_scene(model, SHAPE, observations, ground_may_move=True)
    places = np.random.default_rng(0).random((300, 2)) * size
    places = places[at(places)]
    error = adjustment.correction.apply(places) - truth.apply(places) - image(places)
    covariance = adjustment.covariance_at(adjustment.correction.apply(places))
    ce90_px = float(np.quantile(np.hypot(*error.T), 0.9))
    predicted_px = normal_ce90(covariance)
    mean_square = normalised_error(error, covariance).mean_square
    ratio = ce90_px / float(np.median(predicted_px))
    return Trial(adjustment, ce90_px, ratio, mean_square, float(predicted_px.max()))


@pytest.mark.monte_carlo
@pytest.mark.parametrize(("length", "size_px"), [(0.1, 1.5), (0.2, 1.5), (0.2, 4.0), (0.4, 4.0)])
def test_what_displaces_an_ortho_image_is_followed_with_the_stated_accuracy(
    length: float, size_px: float
) -> None:
    trials = [trial(seed, image=smooth(seed, length, size_px)) for seed in range(6)]
    assert all(one.adjustment.components for one in trials)
    assert max(one.ratio for one in trials) < WRONG
    assert 0.5 < np.mean([one.normalised for one in trials]) < 1.7
    affine = 2.1 * size_px * (0.5 if length > 0.3 else 1.0)
    assert np.median([one.ce90_px for one in trials]) < 0.6 * affine


@pytest.mark.parametrize(
    ("scanned", "points_px", "along"), [(False, 0.1, {"image"}), (False, 3.0, set()), (True, 0.1, set())]
)
def test_lines_and_samples_together_displace_an_ortho_image_alone(
    scanned: bool, points_px: float, along: set[str]
) -> None:
    """What a scanner does depends on one of them; what points state of their errors is theirs."""
    rng, count = np.random.default_rng(1), 80
    t = rng.uniform(-1.0, 1.0, (count, 2))
    place = (np.array(SHAPE) - 1.0) / 2.0 + t * np.array(SHAPE) / 2.0
    misfit = smooth(1, 0.2, 3.0)(place) + SIGMA_PX * rng.normal(size=(count, 2))
    fit = AffineFit(t, misfit, np.full((count, 2), SIGMA_PX**2), np.zeros((count, 0)), np.zeros((2, 0)))
    measured = PlacedMeasures(
        place, np.zeros(count), np.zeros(2), points_px**2, np.eye(count), CHIP_PX, SHAPE, scanned
    )
    components, _ = measured.components(fit, np.ones(count, dtype=np.bool_))
    assert {one.along for one in components} - {"lines", "samples"} == along
    assert scanned or len(components) == len(along)


@pytest.mark.monte_carlo
def test_an_image_is_not_displaced_by_more_because_measures_are_better_than_they_state() -> None:
    """Between and beyond points it is off by what they show, at most."""
    modest = [trial(seed, image=smooth(seed, 0.15, 2.0), sigma_stated_px=3.0) for seed in range(6)]
    assert all(one.adjustment.components for one in modest)
    assert max(one.ratio for one in modest) < WRONG
    assert np.median([one.worst_px for one in modest]) < 2.5 * 2.0 * 2.146


@pytest.mark.monte_carlo
def test_points_of_a_pixel_do_not_hide_a_displacement_of_three() -> None:
    trials = [trial(seed, image=smooth(seed, 0.2, 3.0), point_sigma_px=1.0) for seed in range(6)]
    assert all(one.adjustment.components for one in trials)
    assert max(one.ratio for one in trials) < WRONG
    assert 0.5 < np.mean([one.normalised for one in trials]) < 1.7


@pytest.mark.monte_carlo
@pytest.mark.parametrize("length", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("size_px", [0.5, 2.0])
def test_errors_that_points_share_within_what_they_state_do_not_bend_an_image(
    length: float, size_px: float
) -> None:
    trials = [trial(seed, points=smooth(seed, length, size_px), stated_px=size_px) for seed in range(10)]
    assert not any(one.adjustment.components for one in trials)


@pytest.mark.monte_carlo
def test_an_image_that_is_not_displaced_stays_as_it_is() -> None:
    trials = [trial(seed, point_sigma_px=sigma) for seed in range(30) for sigma in (0.0, 1.0)]
    assert sum(bool(one.adjustment.components) for one in trials) <= 1
    assert 0.5 < np.mean([one.normalised for one in trials]) < 1.4


@pytest.mark.monte_carlo
@pytest.mark.parametrize("size_px", [3.0, 8.0])
def test_ground_that_moved_in_an_ortho_image_is_not_followed_as_its_displacement(size_px: float) -> None:
    def moved(place: Array) -> Array:
        half_size = np.sqrt(0.2 / np.pi) * np.array(SHAPE)
        off = (place - np.array([0.45, 0.5]) * SHAPE) / half_size
        return np.asarray((off**2).sum(axis=1) < 1.0)

    def image(place: Array) -> Array:
        return np.asarray(moved(place)[:, None] * np.array([0.8, -0.6]) * size_px)

    trials = [trial(seed, image=image, at=lambda place: ~moved(place)) for seed in range(6)]
    assert sum(one.adjustment.moved is not None for one in trials) >= 5
    assert max(one.ratio for one in trials) < 2.0
