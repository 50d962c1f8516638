"""Blocks of rigorous models: positions within what is declared, and wrong use by name."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.parameter_figures import held_parameters, parameter_figures
from amers.services.adjustment.parameters import AdjustableImage, image_parameters, own_part, shared_part
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.errors import InputError
from amers.services.geodesy import lon_lat_h_from_east_north_up
from amers.services.sensors.parameter_sets import PARAMETER_SETS, SPOT_HRV, SRP, TOUTIN, ParameterSet
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.refined import refined_rpc
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array, Frame, Observations
from benchmarks.rigorous_block import EXACT, Truth, drawn
from tests.services.ties import difference_m, whitened_square

TARGET = np.array([5.4, 43.6, 250.0])
SHAPE = (3000, 3000)
GSD_M, SIGMA_M, NOISE_PX = 2.5, 15.0, 0.2
HEIGHTS_M = (0.0, 1500.0)
VIEWS = ((22.0, 95.0), (20.0, 275.0), (18.0, 10.0))
trials = 10
ninety_percent = 6.25
"""Of the squares of three normal numbers, their sum is below this."""
alone = BlockOptions(min_points=0)


def model_from(view: tuple[float, float]) -> PushbroomModel:
    return pushbroom_over(TARGET, SHAPE, GSD_M, view, HEIGHTS_M)


MODELS = tuple(model_from(view) for view in VIEWS)


def rigorous(free: ParameterSet) -> list[AdjustableImage]:
    return [
        rigorous_parameters(f"image {k + 1}", model, free, sigma_m=SIGMA_M)
        for k, model in enumerate(MODELS)
    ]


def mixed() -> list[AdjustableImage]:
    """The second image has an RPC instead."""
    images = rigorous(SRP)
    rpc = fit_rpc(MODELS[1], SHAPE, HEIGHTS_M).model
    images[1] = image_parameters("image 2", rpc, SHAPE, shift_px=SIGMA_M / GSD_M, slope_px=0.3)
    return images


def ground(rng: np.random.Generator, count: int = 150) -> Array:
    east_north = rng.uniform(-3200.0, 3200.0, (count, 2))
    points = lon_lat_h_from_east_north_up(np.column_stack([east_north, np.zeros(count)]), TARGET)
    points[:, 2] = rng.uniform(50.0, 1200.0, count)
    return points


def errors_of(block: BlockAdjustment, truth: Array) -> tuple[float, float]:
    """Normalised errors of the points relative to their mean, and of that mean."""
    found = np.isfinite(block.lon_lat_h[:, 0])
    error_m = difference_m(block.lon_lat_h, truth[: len(block.lon_lat_h)])[found]
    mean_m = error_m.mean(axis=0)
    relative = float(whitened_square(error_m - mean_m, block.point_covariance_m2[found]).mean())
    frame_m2 = block.frames[0].covariance_m2 + block.frames[0].shared_m2
    return relative, float(whitened_square(mean_m[None], frame_m2[None]).mean())


@pytest.mark.monte_carlo
@pytest.mark.parametrize("controlled", [False, True], ids=["tie points", "control"])
@pytest.mark.parametrize("kind", ["rigorous", "with an RPC"])
def test_positions_are_recovered_within_what_is_declared(kind: str, controlled: bool) -> None:
    images = rigorous(SRP) if kind == "rigorous" else mixed()
    outcome = []
    for trial in range(trials):
        rng = np.random.default_rng([4, trial])
        truth = Truth(images, drawn(images, rng), ground(rng))
        control = NO_CONTROL
        if controlled:
            frame = Frame.from_sigmas(1.0, 1.0)
            control = truth.control(rng, np.arange(8), (0.5, 0.5), frame)
        block = adjust_block(images, truth.observed(rng, NOISE_PX), control=control)
        assert (block.frames[0].sigma_m < 1.2) == controlled
        outcome.append(errors_of(block, truth.lon_lat_h))
    relative, frame = np.mean(outcome, axis=0)
    assert 0.8 < relative < 1.2
    # Thirty numbers: within two and a half standard deviations.
    assert 0.4 < frame < 1.65


def held_by_regions(block: BlockAdjustment, truth: Array) -> float:
    """Share of the points whose 90 % regions hold their errors relative to the median error."""
    found = np.isfinite(block.lon_lat_h[:, 0])
    error_m = difference_m(block.lon_lat_h, truth)[found]
    off_m = error_m - np.median(error_m, axis=0)
    square = 3.0 * whitened_square(off_m, block.point_covariance_m2[found])
    return float((square < ninety_percent).mean())


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_a_tenth_of_wrong_observations_leaves_the_regions_as_good() -> None:
    images, held = mixed(), []
    for trial in range(trials):
        rng = np.random.default_rng([6, trial])
        truth = Truth(images, drawn(images, rng), ground(rng))
        observations = truth.observed(rng, NOISE_PX)
        right = adjust_block(images, observations)
        wrong = rng.random(len(observations)) < 0.1
        observations.line_sample[wrong] += rng.uniform(-30.0, 30.0, (int(wrong.sum()), 2))
        spoilt = adjust_block(images, observations)
        held.append([held_by_regions(block, truth.lon_lat_h) for block in (right, spoilt)])
    without, with_blunders = np.mean(held, axis=0)
    # Points share the deformation of their block: a few blocks hold half of theirs.
    assert 0.75 < without < 0.95
    assert with_blunders > without - 0.05


@pytest.mark.long
def test_parameters_are_recovered_within_their_sigmas() -> None:
    images = rigorous(TOUTIN)[:2]
    square = []
    for trial in range(trials):
        rng = np.random.default_rng([5, trial])
        values = [rng.normal(0.0, image.sigma) for image in images]
        models = [image.corrected(own) for image, own in zip(images, values, strict=True)]
        truth = Truth(images, models, ground(rng))
        control = truth.control(rng, np.arange(60), (0.2, 0.2))
        block = adjust_block(images, truth.observed(rng, NOISE_PX), control=control)
        sigma = np.sqrt(block.accuracy.variance())[: block.values.size]
        square.append(((block.values.ravel() - np.concatenate(values)) / sigma) ** 2)
        # Drifts and yaw are told apart from all others; roll from a displaced orbit is not.
        names = [parameter.name for parameter in images[0].parameters]
        told = dict(zip(names, block.determined.mean(axis=0), strict=True))
        assert min(told["yaw"], told["roll drift"], told["pitch drift"]) > 0.95
        assert told["roll"] < 0.2
    assert 0.75 < np.mean(square) < 1.25


@pytest.mark.parametrize("controlled", [False, True], ids=["tie points", "control"])
def test_models_for_other_heights_meet_where_all_hold(controlled: bool) -> None:
    """Rigorous models of products hold for all ground, RPCs for that of their image."""
    wide = replace(MODELS[0], height_range_m=(-500.0, 9000.0))
    images: list[AdjustableImage] = [rigorous_parameters("image 1", wide, SRP, sigma_m=SIGMA_M)]
    for number in (1, 2):
        rpc = fit_rpc(MODELS[number], SHAPE, HEIGHTS_M).model
        name, shift_px = f"image {number + 1}", SIGMA_M / GSD_M
        images.append(image_parameters(name, rpc, SHAPE, shift_px=shift_px, slope_px=0.3))
    rng = np.random.default_rng(4)
    truth = Truth(images, drawn(images, rng), ground(rng))
    control = NO_CONTROL
    if controlled:
        control = truth.control(rng, np.arange(8), (0.5, 0.5), Frame.from_sigmas(1.0, 1.0))
    block = adjust_block(images, truth.observed(rng, NOISE_PX), control=control)
    assert block.active.mean() > 0.98
    assert errors_of(block, truth.lon_lat_h)[0] < 2.0


@pytest.mark.parametrize("free", PARAMETER_SETS.values(), ids=PARAMETER_SETS)
def test_the_accuracy_on_the_ground_is_the_one_that_is_stated(free: ParameterSet) -> None:
    image = rigorous(free)[0]
    centre = (np.array([SHAPE]) - 1.0) / 2.0
    middle = image.model.locate(centre, np.array([np.mean(HEIGHTS_M)]))
    rng = np.random.default_rng(3)
    moved = [model.locate(centre, middle[:, 2])[0] for model in drawn([image] * 300, rng)]
    error_m = difference_m(np.array(moved), np.repeat(middle, 300, axis=0))
    np.testing.assert_allclose(error_m[:, :2].std(axis=0), SIGMA_M, rtol=0.15)


@pytest.mark.parametrize(
    ("free", "along", "across"),
    [
        (TOUTIN, ["along track"], ["across track"]),
        (SPOT_HRV, ["along track"], ["across track", "radial"]),
    ],
)
def test_an_orbit_known_worse_than_the_scene_has_nine_tenths_of_its_variance(
    free: ParameterSet, along: list[str], across: list[str]
) -> None:
    image = rigorous(free)[0]
    middle = image.model.locate((np.array([SHAPE]) - 1.0) / 2.0, np.array([np.mean(HEIGHTS_M)]))
    computed = image.computed(np.zeros(len(image.sigma)), middle)
    moved_m = np.linalg.solve(computed.by_ground[0, :, :2], computed.by_parameters[0] * image.sigma)
    variance_m2 = dict(
        zip([one.name for one in image.parameters], (moved_m**2).sum(axis=0), strict=True)
    )
    for orbit, turn in ((along, "pitch"), (across, "roll")):
        of_orbit_m2 = sum(variance_m2[name] for name in orbit)
        assert of_orbit_m2 == pytest.approx(0.9 * SIGMA_M**2, rel=1e-6)
        assert of_orbit_m2 + variance_m2[turn] == pytest.approx(SIGMA_M**2, rel=1e-6)


def test_the_sets_have_the_parameters_that_were_published() -> None:
    assert {name: len(rigorous(free)[0].sigma) for name, free in PARAMETER_SETS.items()} == {
        "srp": 7,
        "toutin": 8,
        "spot-hrv": 7,
    }
    with pytest.raises(InputError, match="own: heading given as free, some of roll, pitch"):
        rigorous(ParameterSet("own", {"heading": 1.0}))


def test_images_of_a_pass_share_errors_whatever_their_model_is() -> None:
    images = mixed()
    everyone = np.ones(3, dtype=np.bool_)
    every = np.eye(int(sum(image.locating.sum() for image in images)))
    full = own_part(images, everyone, every) + shared_part(images, everyone, every)
    assert np.linalg.eigvalsh(full).min() > -1e-9
    # An error that all share moves the ground under all images alike.
    values = [image.shared_direction() @ [1.0, 0.0] for image in images]
    moved = []
    for image, own in zip(images, values, strict=True):
        parameters = np.zeros(len(image.sigma))
        parameters[image.locating] = own
        computed = image.computed(parameters, TARGET[None])
        shift = computed.line_sample - image.model.project(TARGET[None])
        moved.append(np.linalg.solve(computed.by_ground[0, :, :2], shift[0]))
    np.testing.assert_allclose(moved, np.tile(moved[0], (3, 1)), atol=0.15 * SIGMA_M)


def single(free: ParameterSet, count: int) -> tuple[list[AdjustableImage], Observations, ControlGround]:
    """One image and known points that it alone shows."""
    rng = np.random.default_rng(8)
    images = rigorous(free)[:1]
    truth = Truth(images, drawn(images, rng), ground(rng, count))
    return images, truth.observed(rng, NOISE_PX), truth.control(rng, np.arange(count), (0.3, 0.3))


def test_too_few_points_say_which_parameters_they_do_not_determine() -> None:
    images, observations, control = single(SRP, 2)
    block = adjust_block(images, observations, control=control, options=alone)
    figures = parameter_figures(images, block)
    held = [figure.name for figure in figures if figure.is_held]
    assert held == ["yaw", "yaw drift", "focal length"]
    sentence = held_parameters(figures)[0]
    assert sentence.startswith("image 1: the observations do not determine ")
    assert "focal length (" in sentence
    assert "ppm, 20 a priori)" in sentence
    for figure in figures:
        # What is held keeps nearly the whole of its a priori sigma.
        assert figure.sigma <= figure.a_priori_sigma * 1.0001
        assert figure.is_held == (figure.sigma > 0.9486 * figure.a_priori_sigma)
    images, observations, control = single(SRP, 150)
    block = adjust_block(images, observations, control=control, options=alone)
    assert "focal length" not in " ".join(held_parameters(parameter_figures(images, block)))


def test_control_points_of_another_instrument_are_refused() -> None:
    # Two instruments side by side look 20 degrees apart; their images overlap little.
    _, observations, control = single(SRP, 12)
    other = pushbroom_over(TARGET, SHAPE, GSD_M, (2.0, 275.0), HEIGHTS_M)
    aside = lon_lat_h_from_east_north_up(np.array([[5500.0, 0.0, 0.0]]), TARGET)[0]
    for target in (aside, TARGET + [1.0, 0.5, 0.0]):
        elsewhere = pushbroom_over(target, SHAPE, GSD_M, (2.0, 275.0), HEIGHTS_M)
        strange = rigorous_parameters("HRV 1", elsewhere, SRP, sigma_m=SIGMA_M)
        with pytest.raises(InputError, match=r"HRV 1: 1[0-2] of 12 control points are not where .*px"):
            adjust_block([strange], observations, control=control, options=alone)
    right = rigorous_parameters("HRV 2", other, SRP, sigma_m=SIGMA_M)
    shown = replace(observations, line_sample=other.project(control.lon_lat_h))
    assert adjust_block([right], shown, control=control, options=alone).control_active.all()


@pytest.mark.parametrize("number", [0, 2])
def test_an_image_that_shows_most_control_elsewhere_is_refused_whichever_it_is(number: int) -> None:
    """Beside an image whose accuracy is a guess, which shows control as well; half may be wrong."""
    images, rng = mixed(), np.random.default_rng([6, number])
    truth = Truth(images, drawn(images, rng), ground(rng))
    control = truth.control(rng, np.arange(40), (0.5, 0.5), Frame.from_sigmas(1.0, 1.0))
    seen = truth.observed(rng, NOISE_PX)
    of_image = np.flatnonzero((seen.image == number) & (seen.point < 40))
    half = len(of_image) // 2
    assert half > 5

    def block_of(wrong: int) -> BlockAdjustment:
        line_sample = seen.line_sample.copy()
        line_sample[of_image[:wrong]] += 500.0
        return adjust_block(images, replace(seen, line_sample=line_sample), control=control)

    with pytest.raises(InputError, match=rf"image {number + 1}: {half + 1} of {len(of_image)} control"):
        block_of(half + 1)
    assert not block_of(half).active[of_image[:half]].any()


def test_an_exact_frame_and_many_points_leave_the_noise_alone() -> None:
    images, observations, control = single(SRP, 60)
    block = adjust_block(images, replace(observations), control=control, options=alone)
    assert control.frames == (EXACT,)
    assert np.sqrt((block.residual_px**2).mean()) < 1.3 * np.hypot(NOISE_PX, 0.3 / GSD_M)


def test_a_refined_model_delivers_an_rpc_with_its_error_over_the_heights_of_the_ground() -> None:
    """The stated error is that at places between those of the fit, and smaller over fewer heights."""
    rng = np.random.default_rng(2)
    model = pushbroom_over(TARGET, SHAPE, GSD_M, VIEWS[0], (-500.0, 9000.0), jitter_px=0.3, rng=rng)
    image = rigorous_parameters("image", model, SRP, sigma_m=SIGMA_M)
    refined = image.corrected(rng.normal(0.0, image.sigma))
    heights_m = (50.0, 1200.0)
    everywhere, here = refined_rpc(refined, SHAPE), refined_rpc(refined, SHAPE, heights_m)
    assert here.model is not None
    assert everywhere.model is not None
    assert everywhere.model.height_range_m == pytest.approx((-500.0, 9000.0))
    assert here.model.height_range_m == pytest.approx(heights_m)
    assert here.max_error_px < everywhere.max_error_px
    places = rng.uniform(0.02, 0.98, (4000, 2)) * SHAPE
    ground_there = refined.locate(places, rng.uniform(*heights_m, 4000))
    off_px = np.linalg.norm(here.model.project(ground_there) - places, axis=1).max()
    assert 0.8 * here.max_error_px < off_px < 1.1 * here.max_error_px
    # Jitter of 0.3 px about three axes is what no RPC follows.
    assert 0.1 < here.max_error_px < 1.0
