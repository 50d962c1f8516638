"""Ground that moved beside all else that displaces neighbours: bands, relief, motion of any kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.misfit.affine_fit import FREE, AffineFit
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.moved_ground import moved_ground
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_motion import SceneMotion
from amers.services.types import Array, BoolArray, IntArray

SHAPE = (4000, 3000)
COUNT = 90
SIGMA_PX = 0.4
TOLERANCE = 4.0
MOVED_PX = np.array([2.0, 1.5])
"""Six times what points scatter."""


@dataclass(frozen=True)
class Scene:
    """Measures of a scene, with noise of the stated sigmas.

    Attributes:
        t: (n, 2) places, from -1 to 1 over the image.
        moved_px: (n, 2) what displaces them.
        height_m: (n,) of the ground.
    """

    t: Array
    moved_px: Array
    height_m: Array

    @property
    def position_px(self) -> Array:
        """(n, 2)."""
        return np.asarray((np.array(SHAPE) - 1.0) / 2.0 + self.t * np.array(SHAPE) / 2.0)

    def fit(self, stated: float = 1.0) -> AffineFit:
        """What an affine correction has to explain; the stated sigmas are times the true ones."""
        n = len(self.t)
        noise_px = SIGMA_PX * np.random.default_rng(2).normal(size=(n, 2))
        variance = np.full((n, 2), (stated * SIGMA_PX) ** 2)
        return AffineFit(self.t, self.moved_px + noise_px, variance, np.zeros((n, 0)), np.zeros((2, 0)))

    def log_evidence(
        self,
        components: Sequence[Component] = (),
        *,
        stated: float = 1.0,
        seen: BoolArray | None = None,
        agreeing: BoolArray | None = None,
    ) -> float:
        """Of ground that moved, beside motion with which some measures agree; 0 where none is found."""
        n, fit = len(self.t), self.fit(stated)
        seen = np.ones(n, dtype=np.bool_) if seen is None else seen
        measured = PlacedMeasures(
            self.position_px, self.height_m, np.zeros(2), 0.0, np.eye(n), 64.0, SHAPE, True
        )
        start = fit.robust_solution(seen, FREE["affine"])
        clipped = fit.clipped(start, 2.0 * TOLERANCE * fit.scale(start, seen, FREE["affine"]))
        motion = SceneMotion(tuple(components), (), seen if agreeing is None else agreeing)
        found = moved_ground(measured, fit, clipped, motion, seen=seen, tolerance=TOLERANCE)
        return found.log_evidence if found else 0.0


def area_that_moved(area: Callable[[Array], BoolArray]) -> tuple[Scene, BoolArray]:
    """A scene of which an area moved, and the points (n,) that lie there."""
    t = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 2))
    return Scene(t, area(t)[:, None] * MOVED_PX, np.zeros(COUNT)), area(t)


def disc(t: Array) -> BoolArray:
    return np.asarray(((t - [0.2, -0.1]) ** 2).sum(axis=1) < 0.6**2)


def like_a_disc(*parts: tuple[float, float]) -> list[Component]:
    """Smooth motion of some lengths and variances, that comes near to a disc that moved."""
    return [
        Component("smooth", length_px, np.nan, variance * np.array([1.0, 0.56]), along="image")
        for length_px, variance in parts
    ]


FEW_LENGTHS = like_a_disc((300.0, 0.3), (900.0, 0.6))
MANY_LENGTHS = like_a_disc((150.0, 0.1), (400.0, 0.2), (1000.0, 0.5))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_band_of_lines_or_of_samples_that_is_out_of_place_is_no_ground_that_moved(axis: int) -> None:
    """Although an ellipse over it makes the measures much more likely than all but a band does."""
    t = np.random.default_rng([8, 0]).uniform(-1.0, 1.0, (COUNT, 2))
    t[:, 1 - axis] *= 0.45
    band = (t[:, axis] > -0.21) & (t[:, axis] < 0.39)
    assert Scene(t, band[:, None] * MOVED_PX, np.zeros(COUNT)).log_evidence() == 0.0
    assert area_that_moved(disc)[0].log_evidence() > 30.0


def test_errors_that_neighbours_share_are_no_ground_that_moved() -> None:
    """Errors that are alike over a fifth of the image, of which an ellipse holds the largest."""
    rng = np.random.default_rng([7, 2])
    t = rng.uniform(-1.0, 1.0, (COUNT, 2))
    scene = Scene(t, np.zeros((COUNT, 2)), np.zeros(COUNT))
    apart_px = np.linalg.norm(scene.position_px[:, None] - scene.position_px[None], axis=2)
    correlation = np.exp(-apart_px / (0.2 * np.sqrt(np.prod(SHAPE)))) + 1e-9 * np.eye(COUNT)
    shared_px = 2.0 * np.linalg.cholesky(correlation) @ rng.normal(size=(COUNT, 2))
    assert replace(scene, moved_px=shared_px).log_evidence() == 0.0


def test_a_hill_that_the_model_sees_from_another_side_is_no_ground_that_moved() -> None:
    level, on_it = area_that_moved(disc)
    height_m = np.where(on_it, 60.0, 20.0) + np.random.default_rng(4).normal(0.0, 1.0, COUNT)
    assert replace(level, height_m=height_m).log_evidence() == 0.0
    elsewhere = np.random.default_rng(5).permutation(height_m)
    assert replace(level, height_m=elsewhere).log_evidence() > 30.0


def test_five_points_at_least_lie_on_the_ground_that_moved() -> None:
    scene, on_it = area_that_moved(disc)
    evidence = [scene.log_evidence(seen=~on_it | (np.cumsum(on_it) <= count)) for count in (4, 8)]
    assert evidence[0] == 0.0
    assert evidence[1] > 8.0


def test_motion_is_as_likely_whatever_sigmas_are_stated_too_small() -> None:
    """Its variance is off by what the stated variances are off by."""
    scene, _ = area_that_moved(disc)
    evidence = [
        scene.log_evidence([one.scaled(stated**2) for one in MANY_LENGTHS], stated=stated)
        for stated in (0.8, 0.6)
    ]
    assert evidence[0] == pytest.approx(evidence[1], rel=1e-3)
    assert scene.log_evidence(stated=0.8) > evidence[0] + 1.0, "it is the second best"


def log_likelihood(
    scene: Scene, fit: AffineFit, components: Sequence[Component], agreeing: BoolArray
) -> float:
    """Of the agreeing measures, and of each other one given these, no less likely than 4 sigmas off."""
    design = np.column_stack([np.ones(len(scene.t)), scene.t])
    laws, strays = 0.0, np.zeros((2, 2, int((~agreeing).sum())))
    for k in range(2):
        covariance = np.diag(fit.variance[:, k])
        for one in components:
            covariance = covariance + one.covariance(scene.position_px, scene.position_px)[k]
        inverse = np.linalg.inv(covariance[np.ix_(agreeing, agreeing)])
        normal = design[agreeing].T @ inverse @ design[agreeing]
        parameters = np.linalg.solve(normal, design[agreeing].T @ inverse @ fit.misfit[agreeing, k])
        left = fit.misfit[:, k] - design @ parameters

        def square_and_volume(
            rows: IntArray, left: Array = left, covariance: Array = covariance
        ) -> Array:
            law = covariance[np.ix_(rows, rows)]
            return np.array([left[rows] @ np.linalg.solve(law, left[rows]), np.linalg.slogdet(law)[1]])

        known = np.flatnonzero(agreeing)
        among = square_and_volume(known)
        laws += float(among.sum())
        for i, row in enumerate(np.flatnonzero(~agreeing)):
            strays[k, :, i] = square_and_volume(np.append(known, row)) - among
    return -0.5 * float(laws + np.minimum(strays[:, 0].sum(axis=0), 16.0).sum() + strays[:, 1].sum())


def test_what_makes_a_motion_likelier_than_another_is_the_law_of_its_measures_one_by_one() -> None:
    """Those that do not agree are predicted by their neighbours, and one far off counts as 4 sigmas."""
    scene, _ = area_that_moved(disc)
    agreeing = np.arange(COUNT) % 4 > 0
    moved_px = scene.moved_px.copy()
    moved_px[[0, 40]] += 8.0
    scene = replace(scene, moved_px=moved_px)
    stated = 1.2
    of_few, of_many = (
        scene.log_evidence(one, stated=stated, agreeing=agreeing) for one in (FEW_LENGTHS, MANY_LENGTHS)
    )
    expected = [
        log_likelihood(scene, scene.fit(stated), one, agreeing) for one in (FEW_LENGTHS, MANY_LENGTHS)
    ]
    assert of_few - of_many == pytest.approx(expected[1] - expected[0], rel=1e-3)
    assert abs(of_few - of_many) > 0.5
    assert scene.log_evidence(stated=stated) > max(of_few, of_many), "nothing else is as likely"
