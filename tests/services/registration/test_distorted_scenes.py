"""Scenes that no affine correction describes are followed with the stated accuracy, or named."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import BrokenImage, NotEnoughPoints, TurnedImage
from amers.services.imagery.source import ArrayImage
from amers.services.orthorectification.straighten import straighten, without_displacement
from amers.services.quality.normal_law import normal_ce90
from amers.services.registration.on_points import Registration, register_scene
from amers.services.sensors.correction import CorrectedModel
from amers.services.simulation.distortion import (
    Bend,
    DistortedImage,
    Distortion,
    MovedGround,
    Step,
    Turn,
    Waves,
)
from amers.services.types import Array
from tests.services.registration.test_on_points import FIRST, SIGMA_M, frame_m, per_degree, view_of
from tests.services.simulated import block, world

pytestmark = pytest.mark.long

LOST = {"repeated lines": (0.65, -40), "lost lines": (0.4, 25), "repeated at the border": (0.93, -30)}
"""Share of the lines at which some are missing, and how many; a negative number is repeated."""
WRONG = 3.0
"""True over predicted CE90 from which on a result is wrong."""


IN_THE_MIDDLE = {
    "a third moved by 6 px": (0.3, 6.0),
    "a third moved by 15 px": (0.3, 15.0),
    (HALF := "half moved by 6 px"): (0.5, 6.0),
}
"""Share of the image whose ground moved, and how far."""


def shape() -> tuple[int, int]:
    return view_of(FIRST).image.shape


def distortion(name: str) -> Distortion:
    lines, samples = shape()
    smooth: tuple[Waves | Bend, ...] = ()
    steps: tuple[Step, ...] = ()
    moved = None
    if name == "jitter":
        smooth = (Waves(np.array([[0.5, 2.5]]), np.array([0.8 * lines]), np.array([[0.3, 1.9]])),)
    elif name == "bow":
        smooth = (Bend(np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 5.0]]), 0, lines),)
    elif name in LOST:
        part, lost = LOST[name]
        steps = (Step(int(part * lines), lost),)
    elif name == "moved ground":
        centre = np.array([0.3 * lines, 0.35 * samples])
        moved = MovedGround(centre, np.array([0.27, 0.3]) * shape(), 0.4, np.array([18.0, -14.0]))
    elif name in IN_THE_MIDDLE:
        share, length_px = IN_THE_MIDDLE[name]
        half_axes_px = np.sqrt(share / np.pi) * np.array(shape())
        centre = np.array([0.45 * lines, 0.5 * samples])
        moved = MovedGround(centre, half_axes_px, 0.0, length_px * np.array([0.8, -0.6]))
    turns: dict[str, Turn] = {"swapped": "swapped", "mirrored": "mirrored", "upside down": "upside down"}
    return Distortion(shape(), smooth, steps, moved, turns.get(name, ""))


@cache
def registered(name: str) -> Registration:
    view = view_of(FIRST)
    image = DistortedImage(view.image, distortion(name))
    return register_scene(replace(view.as_scene(SIGMA_M), image=image), *block())


def errors(name: str) -> tuple[Array, Array]:
    """True errors (n, 2) in pixels of the registered model, and its stated covariances (n, 2, 2)."""
    view, how, result = view_of(FIRST), distortion(name), registered(name)
    rng = np.random.default_rng(0)
    pixel = rng.uniform(0.05, 0.95, (300, 2)) * shape()
    pixel = pixel[how.is_unique(pixel)]
    height_m = rng.uniform(*world().height_range_m, len(pixel))
    ground = view.geometry.true_model.locate(how.undistorted(pixel), height_m) + frame_m() / per_degree()
    return result.model.project(ground) - pixel, result.adjustment.covariance_at(pixel)


def found(name: str) -> dict[str, str]:
    """What is said of a scene, by the names of findings."""
    return {one.name: one.words for one in registered(name).qualification.findings}


def ratio(name: str) -> float:
    error, covariance = errors(name)
    return float(np.quantile(np.hypot(*error.T), 0.9) / np.median(normal_ce90(covariance)))


@pytest.mark.parametrize("name", ["jitter", "bow"])
def test_jitter_and_bow_are_followed_with_the_stated_accuracy(name: str) -> None:
    result = registered(name)
    assert result.qualification.verdict in ("good", "usable")
    assert result.adjustment.components
    assert ratio(name) < WRONG
    error, _ = errors(name)
    assert np.quantile(np.hypot(*error.T), 0.9) < 1.2


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["repeated lines", "lost lines"])
def test_lost_and_repeated_lines_are_followed_on_both_sides(name: str) -> None:
    result = registered(name)
    assert result.qualification.verdict in ("good", "usable")
    assert "break" in [one.kind for one in result.adjustment.components]
    assert ratio(name) < WRONG
    error, _ = errors(name)
    assert np.quantile(np.hypot(*error.T), 0.9) < 1.2


def test_lines_that_are_repeated_beyond_all_points_are_named() -> None:
    result = registered("repeated at the border")
    assert "cut the image there" in found("repeated at the border")["breaks"]
    error, covariance = errors("repeated at the border")
    assert np.hypot(*error.T).max() < 1.5
    assert np.median(normal_ce90(covariance)) < 1.5
    lines, samples = shape()
    behind = np.array([[0.97 * lines, 0.2 * samples], [0.99 * lines, 0.8 * samples]])
    assert normal_ce90(result.adjustment.covariance_at(behind)).min() > 50.0
    assert not result.qualification.coverage.holds(behind).any()


def test_a_refusal_says_at_which_lines_the_pixels_show_that_some_were_lost() -> None:
    """Five points are too few for any scene; of one whose lines are whole nothing more is said."""
    view, how = view_of(FIRST), distortion("lost lines")
    points, chips = block()
    few = points.take(np.arange(5))
    line = how.steps[0].line
    broken = replace(view.as_scene(SIGMA_M), image=DistortedImage(view.image, how))
    with pytest.raises(BrokenImage, match=rf"lost or repeated lines at line {line}: .* \(.*needed"):
        register_scene(broken, few, chips)
    with pytest.raises(NotEnoughPoints, match=r"^[0-5] usable points found, 6 needed"):
        register_scene(view.as_scene(SIGMA_M), few, chips)


@pytest.mark.parametrize("name", ["swapped", "mirrored", "upside down"])
def test_an_image_that_is_turned_is_refused_with_this_reason(name: str) -> None:
    with pytest.raises(TurnedImage, match=f"the image is {name}"):
        registered(name)


def test_ground_that_moved_is_named_and_the_rest_stays_right() -> None:
    result = registered("moved ground")
    assert "ground that moved" in found("moved ground")["points_elsewhere"]
    moved = distortion("moved ground").moved
    assert moved is not None
    assert not result.qualification.coverage.holds(moved.centre[None]).any()
    assert ratio("moved ground") < WRONG


@pytest.mark.thorough
@pytest.mark.parametrize("name", [one for one in IN_THE_MIDDLE if one != HALF])
def test_ground_that_moved_in_the_middle_is_not_taken_for_the_scene(name: str) -> None:
    """The points found first agree on the place of the ground that moved: most of them lie on it."""
    result = registered(name)
    assert result.adjustment.moved is not None
    assert "points_elsewhere" in found(name)
    moved = distortion(name).moved
    assert moved is not None
    on_it = moved.contains(result.measures.line_sample[result.measures.active])
    assert on_it.mean() < 0.1
    assert result.qualification.verdict in ("usable", "failed")
    assert ratio(name) < WRONG


@pytest.mark.thorough
def test_a_scene_of_which_half_moved_is_not_delivered() -> None:
    """Points on either half are as many: which of them is the scene's, no measure tells."""
    assert registered(HALF).qualification.verdict == "failed"
    assert ratio(HALF) < WRONG


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["jitter", "bow", "lost lines"])
def test_a_straightened_image_fits_an_rpc_when_it_is_registered_again(name: str) -> None:
    """On the same points, nothing is left to follow, and its affine model is where they are."""
    first = registered(name)
    assert isinstance(first.model, CorrectedModel)
    view = view_of(FIRST)
    image = DistortedImage(view.image, distortion(name))
    out = np.full(shape(), np.nan, dtype=np.float32)
    for one in straighten([image], first.model.correction):
        w = one.window
        out[w.line : w.line + w.lines, w.sample : w.sample + w.samples] = one.pixels[0]
    model = CorrectedModel(first.model.base, without_displacement(first.model.correction))
    scene = replace(view.as_scene(SIGMA_M), image=ArrayImage(out), model=model)
    again = register_scene(scene, *block())
    assert not again.adjustment.components
    assert again.qualification.verdict in ("good", "usable")
    pixel = np.stack(np.meshgrid(*(np.linspace(0.1, 0.9, 9) * n for n in shape()), indexing="ij"), -1)
    moved = again.adjustment.correction.apply(pixel.reshape(-1, 2)) - pixel.reshape(-1, 2)
    stated_px = normal_ce90(first.adjustment.covariance_at(pixel.reshape(-1, 2)))
    assert np.quantile(np.hypot(*moved.T) / stated_px, 0.9) < 1.5
