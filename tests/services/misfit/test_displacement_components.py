"""What moves lines and samples is followed as far as points show it, the rest is named."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.displacement_components import MAX_CHANCE
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.misfit.structure import Family
from amers.services.quality.accuracy import normalised_error
from amers.services.quality.normal_law import normal_ce90, overall_ce90
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.refined import LOUD_PX, refined_rpc
from amers.services.types import Array
from tests.services.conftest import FlatModel

SHAPE = (4000, 3000)
CHIP_PX = 64.0
WRONG = 3.0
"""True over predicted CE90 from which on a result is wrong."""

Motion = Callable[[Array], Array]
"""Displacement (n, 2) of positions (n, 2)."""


@dataclass(frozen=True)
class Trial:
    """A scene whose lines and samples move, adjusted, and how far off the result is."""

    adjustment: SceneAdjustment
    ratio: float
    normalised: float

    def chance(self, family: Family) -> float:
        return next(one.chance for one in self.adjustment.structures if one.family == family)

    @property
    def named(self) -> bool:
        return min(one.chance for one in self.adjustment.structures) < MAX_CHANCE


def still(place: Array) -> Array:
    return np.zeros((len(place), 2))


def draw(
    motion: Motion,
    rng: np.random.Generator,
    *,
    count: int = 100,
    sigma_px: float = 0.5,
    wrong: float = 0.06,
    averaged: bool = False,
    by_height_px: float = 0.0,
    reach: tuple[float, float] = (1.0, 1.0),
) -> tuple[ControlObservations, ImageCorrection]:
    """Points of a scene that is shifted, skewed and moved line by line, with noise and some blunders.

    They reach over a part of its lines and samples.
    """
    frame = no_correction(SHAPE)
    truth = replace(
        frame, parameters=np.column_stack([rng.normal(0.0, 10.0, 2), rng.normal(0.0, 1.0, (2, 2))])
    )
    predicted = rng.random((count, 2)) * reach * (np.array(SHAPE) - 1.0)
    height_m = rng.normal(0.0, 80.0, count)
    offsets = np.linspace(-0.5, 0.5, 65) * CHIP_PX if averaged else np.zeros(1)
    moved = np.mean([motion(predicted + [offset, 0.0]) for offset in offsets], axis=0)
    line_sample = truth.apply(predicted) + moved + sigma_px * rng.normal(size=(count, 2))
    line_sample[:, 1] += by_height_px * height_m / 100.0
    blunder = rng.random(count) < wrong
    line_sample[blunder] += rng.choice([-1.0, 1.0], (blunder.sum(), 2)) * rng.uniform(5.0, 25.0)
    lon_lat_h = FlatModel().locate(predicted, np.zeros(count))
    lon_lat_h[:, 2] = height_m
    return ControlObservations(
        lon_lat_h, line_sample, np.full(count, sigma_px), np.zeros((count, 3, 3)), chip_side_px=CHIP_PX
    ), truth


def trial(motion: Motion, seed: int, **how: object) -> Trial:
    """A drawn scene, adjusted, against its truth at places all over the image."""
    observations, truth = draw(motion, np.random.default_rng(seed), **how)  # type: ignore[arg-type]
    adjustment = adjust_scene(FlatModel(), SHAPE, observations, AdjustmentOptions())
    places = np.random.default_rng(0).random((300, 2)) * (np.array(SHAPE) - 1.0)
    error = adjustment.correction.apply(places) - truth.apply(places) - motion(places)
    covariance = adjustment.covariance_at(adjustment.correction.apply(places))
    true_px = float(np.quantile(np.hypot(*error.T), 0.9))
    return Trial(
        adjustment, true_px / overall_ce90(covariance), normalised_error(error, covariance).mean_square
    )


def beyond_affine(motion: Motion, places: Array) -> Array:
    """What a motion does (n, 2) beyond the affine displacement that is closest to it."""
    moved, design = motion(places), np.column_stack([np.ones(len(places)), places])
    return np.asarray(moved - design @ np.linalg.lstsq(design, moved, rcond=None)[0])


def jitter(period: float, size_px: tuple[float, float], chirp: float = 0.0) -> Motion:
    def motion(place: Array) -> Array:
        line = place[:, 0]
        turns = line / period * (1.0 + chirp * line / SHAPE[0])
        return np.column_stack(
            [size_px[0] * np.sin(2.0 * np.pi * turns), size_px[1] * np.cos(2.0 * np.pi * turns + 1.0)]
        )

    return motion


def bow(size_px: float, axis: int = 0, degree: int = 2) -> Motion:
    return lambda place: (
        size_px * ((2.0 * place[:, axis] / SHAPE[axis] - 1.0) ** degree)[:, None] * [0.5, 1.0]
    )


def step(at: float, size_px: float) -> Motion:
    return lambda place: (place[:, 0] > at)[:, None] * [size_px, 0.0]


def seam(at: float, size_px: tuple[float, float]) -> Motion:
    """Detectors beside each other of which the one behind a sample is out of place."""
    return lambda place: (place[:, 1] > at)[:, None] * list(size_px)


def yaw(size_px: float, period: float, scale_px: float = 0.0) -> Motion:
    """Lines that turn and grow with time, in proportion to the distance from the middle of the swath."""

    def motion(place: Array) -> Array:
        turned = np.sin(2.0 * np.pi * place[:, 0] / period) * (2.0 * place[:, 1] / SHAPE[1] - 1.0)
        return turned[:, None] * [size_px, scale_px]

    return motion


def diagonal(size_px: float) -> Motion:
    """A bow across the image from corner to corner."""
    return lambda place: size_px * ((place / SHAPE).sum(axis=1) - 1.0)[:, None] ** 2 * [0.5, 1.0]


def both(*motions: Motion) -> Motion:
    return lambda place: np.sum([one(place) for one in motions], axis=0)


MOTIONS = {
    "slow jitter": jitter(2500.0, (0.5, 2.0)),
    "jitter": jitter(600.0, (1.0, 2.0)),
    "jitter in lines alone": jitter(350.0, (2.0, 0.0)),
    "jitter that changes": jitter(900.0, (0.5, 2.0), chirp=0.4),
    "bow": bow(4.0),
    "lines lost": step(2900.0, 6.0),
    "seam between detectors": seam(1100.0, (2.0, -3.0)),
    "two seams": both(seam(800.0, (3.0, 0.0)), seam(2000.0, (-1.0, 3.0))),
    "bow over samples": bow(4.0, axis=1),
    "large bow over samples": bow(8.0, axis=1),
    "distortion of the optics": bow(3.0, axis=1, degree=3),
    "bows over both": both(bow(6.0), bow(3.0, axis=1)),
    "yaw that drifts": both(yaw(8.0, 12_000.0), bow(2.0)),
    "yaw that oscillates": yaw(4.0, 4_000.0),
    "scale that changes": yaw(0.0, 6_000.0, 5.0),
    "diagonal bow": diagonal(5.0),
    "jitter and a bow over samples": both(jitter(600.0, (1.0, 2.0)), bow(4.0, axis=1)),
}


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("name", list(MOTIONS))
def test_what_points_show_along_lines_and_samples_is_followed_as_accurately_as_stated(name: str) -> None:
    trials = [trial(MOTIONS[name], seed) for seed in range(8)]
    assert all(one.adjustment.components for one in trials)
    assert max(one.ratio for one in trials) < WRONG
    assert 0.6 < np.mean([one.normalised for one in trials]) < 1.7


@pytest.mark.parametrize(("count", "turns"), [(23, 0), (40, 3)])
def test_few_measures_show_no_lines_that_turn(count: int, turns: int) -> None:
    """Whatever is wrong with few points, some turn of the lines explains it."""
    trials = [trial(yaw(12.0, 6_000.0), seed, count=count, wrong=0.0) for seed in (0, 2, 3)]
    told = [any(part.along == "swath" for part in one.adjustment.components) for one in trials]
    assert sum(told) == turns


@pytest.mark.parametrize("name", list(MOTIONS))
def test_an_affine_correction_alone_would_be_wrong_and_say_nothing(name: str) -> None:
    """Without the profile the same scenes are off by more than three times what is stated."""
    observations, truth = draw(MOTIONS[name], np.random.default_rng(1))
    places = np.random.default_rng(0).random((300, 2)) * (np.array(SHAPE) - 1.0)
    full = adjust_scene(FlatModel(), SHAPE, observations, AdjustmentOptions())
    affine = replace(full.correction, displacement=None)
    error = affine.apply(places) - truth.apply(places) - MOTIONS[name](places)
    off_px, beyond_px = (
        float(np.quantile(np.hypot(*one.T), 0.9))
        for one in (error, beyond_affine(MOTIONS[name], places))
    )
    assert off_px > 0.8 * beyond_px
    stated = normal_ce90(full.covariance_at(full.correction.apply(places)))
    assert off_px > WRONG * float(np.median(stated))


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_scenes_that_do_not_move_are_not_accused_and_not_bent() -> None:
    trials = [trial(still, seed, count=60) for seed in range(150)]
    assert sum(one.named for one in trials) <= 3
    assert sum(bool(one.adjustment.components) for one in trials) <= 2
    assert 0.7 < np.mean([one.normalised for one in trials]) < 1.3


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_the_chance_of_each_family_is_what_it_says() -> None:
    """Of independent errors, at most 5 % have a chance below 5 %, and not far fewer."""
    trials = [trial(still, seed, count=60, wrong=0.0) for seed in range(300, 450)]
    for family in ("lines", "steps", "samples", "seams", "image", "height"):
        below = float(np.mean([one.chance(family) < 0.05 for one in trials]))
        assert below < 0.09
    assert np.mean([one.chance("height") < 0.5 for one in trials]) > 0.3


@pytest.mark.monte_carlo
def test_chips_show_less_of_a_fast_jitter_which_is_taken_into_account() -> None:
    fast = jitter(130.0, (0.0, 4.0))
    trials = [trial(fast, seed, count=160, averaged=True) for seed in range(6)]
    assert max(one.ratio for one in trials) < WRONG
    assert 0.5 < np.mean([one.normalised for one in trials]) < 2.0


def corrected(observations: ControlObservations) -> Array:
    """Where a correction puts places all over the image (n, 2)."""
    places = np.random.default_rng(0).random((300, 2)) * (np.array(SHAPE) - 1.0)
    adjustment = adjust_scene(FlatModel(), SHAPE, observations)
    assert adjustment.components
    return adjustment.correction.apply(places)


@pytest.mark.parametrize("name", ["slow jitter", "jitter that changes"])
def test_a_motion_is_followed_as_far_whatever_the_sigmas_state(name: str) -> None:
    observations, _ = draw(MOTIONS[name], np.random.default_rng(4), wrong=0.0)
    too_small = replace(observations, sigma_px=observations.sigma_px / 8.0)
    assert corrected(too_small) == pytest.approx(corrected(observations), abs=0.1)


def test_a_motion_is_followed_as_far_however_much_too_large_the_sigmas_of_points_are() -> None:
    """Sharp and dull measures show that the points are better than they state."""
    observations, _ = draw(
        MOTIONS["slow jitter"], np.random.default_rng(4), count=80, sigma_px=0.0, wrong=0.0
    )
    rng = np.random.default_rng(5)
    sigma_px = rng.choice([0.2, 2.0], 80, p=[0.6, 0.4])
    noise_px = sigma_px[:, None] * rng.normal(size=(80, 2))
    vague, vaguer = (
        replace(
            observations,
            line_sample=observations.line_sample + noise_px,
            sigma_px=sigma_px,
            covariance_m2=np.tile(sigma_m**2 * np.eye(3), (80, 1, 1)),
        )
        for sigma_m in (12.0, 50.0)
    )
    assert corrected(vaguer) == pytest.approx(corrected(vague), abs=0.4)


def test_a_chip_shows_of_a_smooth_motion_what_is_left_of_its_mean_over_the_chip() -> None:
    observations, _ = draw(bow(6.0), np.random.default_rng(4), count=200, sigma_px=0.2, wrong=0.0)
    side_px = 800.0
    wide = replace(observations, chip_side_px=side_px)
    (smooth,) = adjust_scene(FlatModel(), SHAPE, wide).components
    offsets = np.linspace(-0.5, 0.5, 401) * side_px
    lost = 1.0 - np.exp(-0.5 * (offsets / smooth.length_px) ** 2).mean()
    assert 1.0 - smooth.seen == pytest.approx(lost, rel=0.1)


def test_residuals_that_grow_with_height_are_named_so() -> None:
    trials = [trial(still, seed, by_height_px=1.5) for seed in range(8)]
    assert all(one.chance("height") < MAX_CHANCE for one in trials)


def test_relief_that_turns_lines_is_named_and_not_followed() -> None:
    """Valleys that rise to one side, seen from another side: a turn of the lines explains most of it."""
    rng = np.random.default_rng(8)
    for _ in range(4):
        observations, _ = draw(still, rng, wrong=0.0)
        place = observations.line_sample
        along, across = (2.0 * (place - place.min(axis=0)) / np.ptp(place, axis=0) - 1.0).T
        valleys_m = np.sin(3.0 * along) * (90.0 + 60.0 * across)
        height_m = valleys_m + rng.normal(0.0, 10.0, len(place))
        lon_lat_h = observations.lon_lat_h.copy()
        lon_lat_h[:, 2] = height_m
        seen = replace(
            observations, lon_lat_h=lon_lat_h, line_sample=place + np.outer(height_m, [0.06, 0.0])
        )
        result = adjust_scene(FlatModel(), SHAPE, seen, AdjustmentOptions())
        assert all(one.along != "swath" for one in result.components)
        (height,) = (one for one in result.structures if one.family == "height")
        assert height.chance < MAX_CHANCE


def test_lines_that_oscillate_above_hills_still_turn() -> None:
    """Residuals that follow hills by chance, but lines far more clearly, are of no other view."""
    motion = both(jitter(2600.0, (2.0, 4.0)), yaw(3.0, 6_000.0, 3.0))
    for seed in range(3):
        observations, truth = draw(motion, np.random.default_rng(seed), wrong=0.0)
        lon_lat_h = observations.lon_lat_h.copy()
        oscillating = motion(observations.line_sample)[:, 1]
        lon_lat_h[:, 2] = 40.0 * oscillating + np.random.default_rng(seed).normal(
            0.0, 60.0, len(oscillating)
        )
        above_hills = replace(observations, lon_lat_h=lon_lat_h)
        result = adjust_scene(FlatModel(), SHAPE, above_hills, AdjustmentOptions())
        assert "swath" in {one.along for one in result.components}
        places = np.random.default_rng(0).random((300, 2)) * (np.array(SHAPE) - 1.0)
        error = result.correction.apply(places) - truth.apply(places) - motion(places)
        assert np.quantile(np.hypot(*error.T), 0.9) < WRONG * np.median(
            normal_ce90(result.covariance_at(result.correction.apply(places)))
        )


@pytest.mark.long
def test_heights_with_errors_on_level_ground_are_not_taken_for_another_view() -> None:
    """A point that is too high by its error is displaced by it, in every model."""
    rng = np.random.default_rng(3)
    accused = 0
    for _ in range(60):
        observations, _ = draw(still, rng, wrong=0.0)
        sigma_m, per_metre = 3.0, 0.4
        error_m = sigma_m * rng.normal(size=len(observations.lon_lat_h))
        line_sample = observations.line_sample - np.outer(error_m, [0.0, per_metre])
        covariance_m2 = np.zeros((len(error_m), 3, 3))
        covariance_m2[:, 2, 2] = sigma_m**2
        lon_lat_h = observations.lon_lat_h.copy()
        lon_lat_h[:, 2] = rng.normal(0.0, 3.0, len(error_m)) + error_m
        tilted = replace(
            observations, lon_lat_h=lon_lat_h, line_sample=line_sample, covariance_m2=covariance_m2
        )
        adjustment = adjust_scene(_Tilted(per_metre=per_metre), SHAPE, tilted, AdjustmentOptions())
        chance = next(one.chance for one in adjustment.structures if one.family == "height")
        accused += chance < MAX_CHANCE
    assert accused <= 2


@dataclass(frozen=True)
class _Tilted(FlatModel):
    """The plane whose model moves points by their heights; heights here are errors alone."""

    per_metre: float = 0.0

    def project_derivative(self, lon_lat_h: Array) -> Array:
        derivative = np.array(super().project_derivative(lon_lat_h))
        derivative[:, 1, 2] = self.per_metre
        return derivative


def test_a_repetition_keeps_the_components_and_follows_its_own_points() -> None:
    observations, _ = draw(MOTIONS["jitter"], np.random.default_rng(5))
    first = adjust_scene(FlatModel(), SHAPE, observations, AdjustmentOptions())
    fewer = replace(observations, usable=first.active & (np.arange(len(first.active)) % 5 > 0))
    again = adjust_scene(FlatModel(), SHAPE, fewer, AdjustmentOptions(), like=first)
    assert again.components == first.components
    places = np.random.default_rng(1).random((100, 2)) * (np.array(SHAPE) - 1.0)
    moved = again.correction.apply(places) - first.correction.apply(places)
    assert 0.0 < np.abs(moved).mean() < 0.5


def grid_of(motion: Motion, nodes: tuple[int, int] = (400, 2)) -> DisplacementGrid:
    line, sample = (np.linspace(0.0, size - 1.0, n) for size, n in zip(SHAPE, nodes, strict=True))
    places = np.stack(np.meshgrid(line, sample, indexing="ij"), axis=-1)
    displacement_px = motion(places.reshape(-1, 2)).reshape(places.shape)
    return DisplacementGrid(line, sample, displacement_px, np.full(places.shape, 0.04))


def test_a_corrected_model_with_a_profile_is_consistent_with_itself() -> None:
    parameters = np.array([[30.0, 2.0, -1.0], [-12.0, 0.5, 3.0]])
    correction = replace(
        no_correction(SHAPE), parameters=parameters, displacement=grid_of(MOTIONS["jitter"])
    )
    model = CorrectedModel(FlatModel(), correction)
    places = np.random.default_rng(2).random((200, 2)) * (np.array(SHAPE) - 1.0)
    ground = model.locate(places, np.zeros(200))
    np.testing.assert_allclose(model.project(ground), places, atol=1e-6)
    step_m = 0.01
    metre = FlatModel().locate(np.array([[0.0, 2.0 * step_m]]), np.zeros(1))[0, 0]
    east = np.array([metre, 0.0, 0.0])
    by_difference = (model.project(ground + east) - model.project(ground - east)) / (2.0 * step_m)
    inside = np.abs(by_difference - model.project_derivative(ground)[:, :, 0]).max(axis=1) < 1e-3
    assert inside.mean() > 0.97, "apart from nodes, where the slope changes"


def test_an_rpc_that_cannot_follow_a_profile_is_loud() -> None:
    correction = replace(no_correction(SHAPE), displacement=grid_of(MOTIONS["jitter"]))
    bent = replace(no_correction(SHAPE), displacement=grid_of(bow(2.0)))
    followed, shaken = (
        refined_rpc(CorrectedModel(FlatModel(), one), SHAPE, (-50.0, 50.0)) for one in (bent, correction)
    )
    assert followed.model is not None
    assert followed.max_error_px < LOUD_PX
    assert shaken.max_error_px > LOUD_PX
