"""Do the 90 % regions of a scene adjustment hold the truth? Monte Carlo without pixels.

Points are seen in an image whose model is wrong by a known affine correction; `adjust_scene` estimates
it. At the corners and the centre of the image the true error is compared with the 90 % ellipse of the
stated covariance. Every combination of a number of points, a layout, an error of the points that they
share, and a law of the errors is drawn many times:

* layouts: spread over the image, half of it, a line across it, a corner, two clusters;
* shared: nothing; half to nine tenths of the variance correlated over 0.05 to 0.2 of the image; two
  blocks that meet in the scene, each with its own offset of 0.8 px on each axis, which is not stated;
* laws: normal; heavy tails (Student's t of three degrees of freedom, as precise in its centre as stated,
  and 5 % blunders); normal with sigmas stated four times too small.

A honest cell holds 85 to 95 % of the truth. More is allowed where the data cannot tell (the region
grows), less is not; a refusal is counted beside the cell. Trials are few: a cell below 85 % is marked
where an honest one would hold so little in one of twenty repetitions only. The second figure of a cell
is the median CE90 of the worst place, pixels.
Run: python -m benchmarks.coverage [--trials 200] [--jobs 2]
"""

import argparse
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import binom

from amers.services.errors import ComputationError
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.normal_law import normal_ce90
from amers.services.quality.stability import image_places
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.types import Array
from benchmarks._campaign import run_campaign
from benchmarks._measuring import keep

SHAPE = (4000, 5000)
GSD_M = 0.5
METRE_DEG = 1.0 / 111_320.0

COUNTS = (6, 8, 20, 60, 300)
LAYOUTS = ("spread", "half image", "line", "corner", "two clusters")
SHARED = ("independent", "correlated", "two blocks")
LAWS = ("normal", "heavy tails", "sigmas / 4")

MEASURE_SIGMA_PX = 0.1
POINT_SIGMA_PX = 0.3
BLOCK_OFFSET_PX = 0.8
SHIFT_SIGMA_PX = 10.0
SLOPE_SIGMA_PX = 1.0
STATED_TOO_SMALL = 4.0
LOWEST, HIGHEST = 0.85, 0.95
BY_CHANCE = 0.05
"""Probability of as little held by chance, below which a cell holds too little."""
REGION = 2.0 * np.log(10.0)
"""Square of the radius of the 90 % region of a normal law of unit covariance, in two dimensions."""


@dataclass(frozen=True)
class Plane:
    """A vertical view of a plane at the equator, lines towards the south."""

    height_range_m: tuple[float, float] = (-100.0, 100.0)

    def project(self, lon_lat_h: Array) -> Array:
        """Line and sample (n, 2) of ground points (n, 3)."""
        return np.column_stack([-lon_lat_h[:, 1], lon_lat_h[:, 0]]) / (METRE_DEG * GSD_M)

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative (n, 2, 3), pixels per metre east, north, up."""
        one = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]) / GSD_M
        return np.broadcast_to(one, (len(lon_lat_h), 2, 3))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground points (n, 3) of line and sample (n, 2)."""
        lon_lat = np.column_stack([line_sample[:, 1], -line_sample[:, 0]]) * GSD_M * METRE_DEG
        return np.column_stack([lon_lat, height_m])

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Not known: a vertical view of a plane has no orbit."""
        raise NotImplementedError("a vertical view of a plane has no orbit")


@dataclass(frozen=True)
class Case:
    """One cell of the table.

    Attributes:
        count: of the points.
        layout, shared, law: one of `LAYOUTS`, `SHARED` and `LAWS`.
    """

    count: int
    layout: str
    shared: str
    law: str


@dataclass(frozen=True)
class Coverage:
    """What the trials of a case gave.

    Attributes:
        case: the cell.
        held: share of the places whose 90 % region holds the truth.
        worst_held: the same at the worst of the five places.
        worst_ce90_px: median over the trials of the stated CE90 of the worst place.
        refused: trials that the adjustment refused.
        trials: all.
    """

    case: Case
    held: float
    worst_held: float
    worst_ce90_px: float
    refused: int
    trials: int

    @property
    def too_little(self) -> bool:
        """Whether so little is held that chance does not explain it.

        The places of a trial are held together or not at all, nearly: trials count, not places.
        """
        delivered = self.trials - self.refused
        return bool(binom.cdf(round(self.held * delivered), delivered, LOWEST) < BY_CHANCE)


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=200, help="scenes of every cell (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (%(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    arguments = parser.parse_args()
    cases = [Case(*values) for values in product(COUNTS, LAYOUTS, SHARED, LAWS)]
    work = partial(measure, trials=arguments.trials, seed=arguments.seed)
    outcomes = list(
        run_campaign({str(case): case for case in cases}, work, jobs=arguments.jobs).values()
    )
    show(outcomes)
    keep("coverage", [asdict(outcome) for outcome in outcomes])


def measure(case: Case, trials: int, seed: int) -> Coverage:
    """The coverage of one case over scenes that a seed draws."""
    places = image_places(SHAPE)
    held, worst_px, refused = [], [], 0
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial, case.count])
        truth = draw_truth(rng)
        try:
            adjustment = adjust_scene(Plane(), SHAPE, draw(case, truth, rng), AdjustmentOptions())
        except ComputationError:
            refused += 1
            continue
        held.append(holds(adjustment, truth, places))
        worst_px.append(normal_ce90(adjustment.covariance_at(truth.apply(places))).max())
    if not held:
        return Coverage(case, 1.0, 1.0, 0.0, refused, trials)
    by_place = np.mean(held, axis=0)
    return Coverage(
        case, float(by_place.mean()), float(by_place.min()), float(np.median(worst_px)), refused, trials
    )


def holds(adjustment: SceneAdjustment, truth: ImageCorrection, places: Array) -> Array:
    """Whether (p,) the 90 % regions at places (p, 2) hold the truth."""
    error = adjustment.correction.apply(places) - truth.apply(places)
    covariance = adjustment.covariance_at(truth.apply(places))
    return np.asarray((error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(1) <= REGION)


def draw_truth(rng: np.random.Generator) -> ImageCorrection:
    """A correction with a shift of many pixels and drifts of about one."""
    slopes = rng.normal(0.0, SLOPE_SIGMA_PX, (2, 2))
    parameters = np.column_stack([rng.normal(0.0, SHIFT_SIGMA_PX, 2), slopes])
    return replace(no_correction(SHAPE), parameters=parameters)


def draw(case: Case, truth: ImageCorrection, rng: np.random.Generator) -> ControlObservations:
    """Points of a case, seen in an image whose model is wrong by a correction."""
    n = case.count
    unit = draw_layout(case.layout, n, rng)
    predicted = unit * (np.array(SHAPE) - 1.0)
    sigma_px = np.hypot(MEASURE_SIGMA_PX, POINT_SIGMA_PX)
    too_small = STATED_TOO_SMALL if case.law == "sigmas / 4" else 1.0
    error = sigma_px * too_small * draw_noise(case, unit, rng)
    block = (unit[:, 1] > np.median(unit[:, 1])).astype(np.int64) * (case.shared == "two blocks")
    if case.shared == "two blocks":
        error += rng.normal(0.0, BLOCK_OFFSET_PX, (2, 2))[block]
    if case.law == "heavy tails":
        wrong = rng.random(n) < 0.05
        angle, length = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(2.0, 20.0, n)
        error += np.where(wrong, length, 0.0)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return ControlObservations(
        lon_lat_h=Plane().locate(predicted, np.zeros(n)),
        line_sample=truth.apply(predicted) + error,
        sigma_px=np.full(n, MEASURE_SIGMA_PX),
        covariance_m2=np.tile((POINT_SIGMA_PX * GSD_M) ** 2 * np.eye(3), (n, 1, 1)),
        block=block,
    )


def draw_layout(layout: str, n: int, rng: np.random.Generator) -> Array:
    """Positions (n, 2), 0 to 1 along lines and samples."""
    unit = rng.random((n, 2))
    if layout == "half image":
        unit[:, 1] /= 2.0
    elif layout == "line":
        unit = 0.1 + 0.8 * unit[:, :1] + rng.normal(0.0, 0.01, (n, 2))
    elif layout == "corner":
        unit *= 0.3
    elif layout == "two clusters":
        centre = np.array([[0.2, 0.25], [0.75, 0.8]])[np.arange(n) % 2]
        unit = centre + 0.15 * (unit - 0.5)
    return unit


def draw_noise(case: Case, unit: Array, rng: np.random.Generator) -> Array:
    """Errors (n, 2) of unit variance, spread as the case says."""
    own = rng.normal(size=(case.count, 2))
    if case.law == "heavy tails":
        # The quartiles of the normal law and of Student's: half of the errors are as small as stated.
        own = rng.standard_t(3.0, (case.count, 2)) * (0.6745 / 0.7649)
    if case.shared != "correlated":
        return own
    share, length = rng.uniform(0.5, 0.9), rng.uniform(0.05, 0.2)
    distance = np.linalg.norm(unit[:, None, :] - unit[None, :, :], axis=2)
    smooth = np.linalg.cholesky(np.exp(-distance / length) + 1e-9 * np.eye(case.count))
    field = smooth @ rng.normal(size=(case.count, 2))
    return np.asarray(np.sqrt(share) * field + np.sqrt(1.0 - share) * own)


def show(outcomes: list[Coverage]) -> None:
    """Print a table for every kind of shared error; cells outside are marked."""
    console = Console(width=150)
    cells = {outcome.case: outcome for outcome in outcomes}
    for shared in SHARED:
        table = Table("points", "layout", *LAWS, title=f"90 % regions that hold the truth: {shared}")
        for count, layout in product(COUNTS, LAYOUTS):
            row = [cells[Case(count, layout, shared, law)] for law in LAWS]
            table.add_row(str(count), layout, *(in_words(cell) for cell in row))
        console.print(table)
    below = sum(outcome.held < LOWEST for outcome in outcomes)
    too_little = sum(outcome.too_little for outcome in outcomes)
    over = sum(outcome.held > HIGHEST for outcome in outcomes)
    console.print(
        f"{len(outcomes)} cells: {below} hold less than {LOWEST:.0%}, {too_little} of them by more than "
        f"chance ({BY_CHANCE:.0%}, binomial over trials); {over} hold more than {HIGHEST:.0%}"
    )


def in_words(cell: Coverage) -> str:
    """A cell of the table: share held, CE90 of the worst place, refusals, and a mark outside 85-95 %."""
    below = " [red]TOO LITTLE[/red]" if cell.too_little else " -" if cell.held < LOWEST else ""
    mark = " +" if cell.held > HIGHEST else below
    refused = f", {cell.refused} refused" if cell.refused else ""
    return f"{cell.held:.2f} ({cell.worst_held:.2f}), {cell.worst_ce90_px:.2f} px{refused}{mark}"


if __name__ == "__main__":
    main()
