"""Terms that a set leaves out, and RPCs that follow no attitude, are in the stated accuracy."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.joint.fitting import adjust_fitting
from amers.services.joint.model_errors import of_left_out_terms, of_rpc, with_every_term_free
from amers.services.joint.results import scene_adjustment
from amers.services.sensors.correction import no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.moving_pushbroom import moving_model
from amers.services.sensors.parameter_sets import (
    PARAMETER_SETS,
    SPOT_HRV,
    SRP,
    TOUTIN,
    ParameterSet,
    left_out_of,
    with_every_term,
)
from amers.services.sensors.refined import refined_rpc
from amers.services.simulation.orbit import pushbroom_over
from benchmarks._joint_scenes import errors_px
from tests.services.joint.test_rigorous_scenes import (
    OPTIONS,
    SHAPE,
    mixed,
    observed,
    plan_of,
    rigorous_truth,
)
from tests.services.ties import whitened_square

TRIALS = 5


def test_every_term_of_all_sets_is_free_or_named() -> None:
    terms = {term for one in PARAMETER_SETS.values() for term in one.sigmas}
    for one in PARAMETER_SETS.values():
        complete = with_every_term(one)
        assert complete.sigmas.keys() == terms
        assert complete.sigmas.items() >= dict(one.sigmas).items()
        assert {*left_out_of(one), *one.sigmas} == terms
    assert left_out_of(SRP) == ("along track", "across track", "radial", "anisotropy")


def squares_of(true: ParameterSet, stated: ParameterSet) -> tuple[float, float, float]:
    """Mean squares of errors over what is stated, without and with what the set leaves out; its size.

    The first image of each block is off by terms of one set, and adjusted by those of another.
    """
    without, beside, harm = [], [], []
    side = np.linspace(0.05, 0.95, 7) * SHAPE[0]
    at = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    for trial in range(TRIALS):
        rng = np.random.default_rng([51, trial])
        truth = mixed(rng, stated, points=160)
        image = replace(rigorous_truth(plan_of(0), true, rng), parameter_set=stated)
        truth = replace(truth, images=(image, *truth.images[1:]))
        block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
        assert not left
        error, _ = errors_px(truth, 0, block.model(0), at)
        covariance = scene_adjustment(block, 0, OPTIONS).covariance_at(at)
        found = of_left_out_terms(block, with_every_term_free(block, OPTIONS, None), 0)
        harm_px = np.zeros(2) if found is None else found.harm_px
        for squares, own in ((without, covariance), (beside, covariance + np.diag(harm_px**2))):
            squares.append(whitened_square(error, own).mean())
        harm.append(float(np.hypot(*harm_px)))
    return float(np.mean(without)), float(np.mean(beside)), float(np.median(harm))


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_drifts_that_a_set_leaves_out_are_in_the_accuracy() -> None:
    """Of 1.5 microradians, a metre at the borders: scenes fit beside the others."""
    drifts = {"roll drift": 1.5, "pitch drift": 1.5}
    drifting = ParameterSet("drifting", dict(SPOT_HRV.sigmas) | drifts)
    without, beside, harm_px = squares_of(drifting, SPOT_HRV)
    assert without > 5.0
    assert 0.3 < beside < 2.0
    assert harm_px > 0.3


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("free", [SRP, TOUTIN], ids=["SRP", "Toutin"])
def test_a_set_that_leaves_nothing_out_gains_nothing(free: ParameterSet) -> None:
    without, beside, harm_px = squares_of(free, free)
    assert 0.3 < without < 1.6
    assert 0.3 < beside <= without
    assert harm_px < 0.1


def test_an_rpc_that_misses_an_oscillating_model_does_harm_and_one_of_a_still_one_none() -> None:
    """A wave of 0.8 px in line, five times in the image: its root mean square is 0.57 px.

    The samples stay where they are, and an RPC shows them there.
    """
    target, shape, heights_m = np.array([5.4, 43.6, 300.0]), (1500, 1000), (0.0, 600.0)
    still = pushbroom_over(target, shape, 1.5, (20.0, 100.0), heights_m)
    lines, samples = np.linspace(0.0, 1499.0, 201), np.array([0.0, 999.0])
    wave = np.zeros((201, 2, 2))
    wave[:, :, 0] = 0.8 * np.sin(10.0 * np.pi * lines / 1500.0)[:, None]
    displacement = DisplacementGrid(lines, samples, wave, 0.0 * wave)
    shaking = moving_model(still, replace(no_correction(shape), displacement=displacement))
    assert shaking is not None
    of_still, of_shaking = (
        of_rpc(model, refined_rpc(model, shape, heights_m), shape, heights_m)
        for model in (still, shaking)
    )
    assert of_still is None
    assert of_shaking is not None
    assert of_shaking.harm_px[0] == pytest.approx(0.8 / np.sqrt(2.0), abs=0.08)
    assert of_shaking.harm_px[1] < 0.001
    assert "no RPC follows this attitude closer" in of_shaking.words
