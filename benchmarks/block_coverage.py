"""Do the 90 % regions of a block adjustment hold the truth? Monte Carlo without pixels.

Images whose models are off by a shift of 3 px (one standard deviation) and by drifts and skews drawn
evenly up to a limit see points with a noise of 0.2 px and blunders of up to 30 px. The adjustment knows
the standard deviation of the shifts, and takes that of the drifts as 0.2 px until it has estimated it.
Every layout is drawn many times with every limit and every share of blunders:

* ring: five images from all sides; pair: two of opposite sides; star: one image between six others;
* strip: sixteen images in a row, each over more than half of the next, from four sides in turn;
* groups: two rings ten kilometres apart, which must be refused by name.

A cell gives the share of points whose region holds their error relative to the median error of the
block, the share whose region on the Earth does, the share of blocks whose frame does, east, north and
up, and how many blocks were refused. A scene that took no part in the block is registered on its points,
and the shares of its corners and centre are given likewise.
Run: python -m benchmarks.block_coverage [--trials 40] [--layouts ring,pair] [--jobs 2]
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cache, partial
from itertools import product
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.errors import ComputationError
from amers.services.geodesy import lon_lat_h_from_east_north_up, metres_per_degree, move_metres
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.quality.stability import image_places
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, Observations
from benchmarks._campaign import run_campaign
from benchmarks._measuring import keep

SHAPE = (4000, 4000)
GROUND_M = 150.0
RELIEF_M = 60.0
SHIFT_PX, SLOPE_PX, NOISE_PX, BLUNDER_PX = 3.0, 0.2, 0.2, 30.0
MEASURE_SIGMA_PX = 0.1
SEEN = 0.8
MOST_POINTS = 300
"""On which the scene is registered."""
POINTS_PER_KM2 = 26.0
LAYOUTS = ("ring", "pair", "star", "strip", "groups")
DRIFTS_PX = (0.0, 0.3, 1.0)
BLUNDERS = (0.0, 0.1, 0.3)
CONFIDENCE = 0.9


@dataclass(frozen=True)
class Case:
    """One cell of the table: a layout, the largest drift, the share of blunders."""

    layout: str
    drift_px: float
    blunders: float


@dataclass(frozen=True)
class Coverage:
    """What the trials of a case gave.

    Attributes:
        case: the cell.
        relative, on_earth: share of points whose region holds their error.
        chance: standard deviation of `relative` by the draw of the blocks, whose points share errors.
        frame: (3,) share of blocks whose frame holds east, north, up.
        scene_relative, scene_on_earth: share of the places of registered scenes whose region holds.
        sigma_up_m: median over the blocks of the stated sigma of heights relative to the frame.
        refused: blocks that the adjustment refused.
        reasons: first words of the refusals.
        trials: all.
    """

    case: Case
    relative: float
    on_earth: float
    chance: float
    frame: tuple[float, float, float]
    scene_relative: float
    scene_on_earth: float
    sigma_up_m: float
    refused: int
    reasons: tuple[str, ...]
    trials: int


@dataclass(frozen=True)
class Layout:
    """Images, the rectangle of ground (west, east, south, north) they see, metres, and a later scene."""

    views: tuple[ViewGeometry, ...]
    extent_m: tuple[float, float, float, float]
    scene: ViewGeometry


def main() -> None:
    """Print the table and keep its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40, help="blocks of every cell (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (%(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (%(default)s)")
    parser.add_argument("--layouts", default=",".join(LAYOUTS), help="some of %(default)s")
    arguments = parser.parse_args()
    cases = [Case(*values) for values in product(arguments.layouts.split(","), DRIFTS_PX, BLUNDERS)]
    work = partial(measure, trials=arguments.trials, seed=arguments.seed)
    outcomes = list(
        run_campaign({str(case): case for case in cases}, work, jobs=arguments.jobs).values()
    )
    show(outcomes)
    keep("block_coverage", [asdict(outcome) for outcome in outcomes])


def measure(case: Case, trials: int, seed: int) -> Coverage:
    """The coverage of one case over blocks that a seed draws."""
    held: list[Held] = []
    reasons: list[str] = []
    for trial in range(trials):
        rng = np.random.default_rng([seed, trial])
        truth, images, observations = draw(case, rng)
        try:
            held.append(holds(adjust_block(images, observations), truth, case, rng))
        except ComputationError as error:
            reasons.append(str(error)[:60])
    unknown = (float("nan"),) * len(Held._fields)
    shares = Held(*np.mean(held, axis=0)) if held else Held(*unknown)
    return Coverage(
        case,
        relative=float(shares.relative),
        on_earth=float(shares.on_earth),
        chance=float(np.std([of.relative for of in held]) / np.sqrt(len(held)))
        if held
        else float("nan"),
        frame=(float(shares.east), float(shares.north), float(shares.up)),
        scene_relative=float(shares.scene_relative),
        scene_on_earth=float(shares.scene_on_earth),
        sigma_up_m=float(np.median([of.sigma_up_m for of in held])) if held else float("nan"),
        refused=len(reasons),
        reasons=tuple(sorted(set(reasons))),
        trials=trials,
    )


class Held(NamedTuple):
    """What one block holds: shares of its points, its frame, a scene; median sigma of its heights."""

    relative: float
    on_earth: float
    east: float
    north: float
    up: float
    scene_relative: float
    scene_on_earth: float
    sigma_up_m: float


def holds(block: BlockAdjustment, truth: Array, case: Case, rng: np.random.Generator) -> Held:
    """What the regions of a block hold of the truth (p, 3) about its points, and of a scene on them."""
    found = np.flatnonzero(np.isfinite(block.lon_lat_h[:, 0]))
    east, north = metres_per_degree(float(truth[0, 1]), GROUND_M)
    error_m = (block.lon_lat_h[found] - truth[found]) * [east, north, 1.0]
    frame_error_m = np.median(error_m, axis=0)
    covariance, frame = block.point_covariance_m2[found], block.frames[0].covariance_m2
    limit = chi2.ppf(CONFIDENCE, 3)
    relative = whitened_square(error_m - frame_error_m, covariance) <= limit
    on_earth = whitened_square(error_m, covariance + frame) <= limit
    of_frame = frame_error_m**2 <= chi2.ppf(CONFIDENCE, 1) * np.diagonal(frame)
    sigma_up_m = float(np.median(np.sqrt(covariance[:, 2, 2])))
    scene = layout(case.layout).scene
    slopes = rng.uniform(-case.drift_px, case.drift_px, (2, 2))
    errors = np.column_stack([rng.normal(0.0, SHIFT_PX, 2), slopes])
    correction = replace(no_correction(SHAPE), parameters=errors)
    of_scene = scene_held(block, truth, frame_error_m, scene, correction)
    return Held(
        float(relative.mean()), float(on_earth.mean()), *map(float, of_frame), *of_scene, sigma_up_m
    )


def scene_held(
    block: BlockAdjustment,
    truth: Array,
    frame_error_m: Array,
    scene: ViewGeometry,
    correction: ImageCorrection,
) -> tuple[float, float]:
    """Shares of the corners and the centre of a scene whose regions hold the truth.

    The scene sees the points where they truly are, with a noise of 0.1 px.

    Args:
        block: adjusted.
        truth: (p, 3) of its points.
        frame_error_m: (3,) east, north, up, that its points share.
        scene: the geometry of the image, which took no part in the block.
        correction: the true one.

    Returns:
        Share relative to the points, share on the Earth.
    """
    shape = scene.plan.shape
    rng = np.random.default_rng(len(truth))
    position = correction.apply(scene.rpc.project(truth))
    seen = ((position >= 0.0) & (position <= np.array(shape) - 1.0)).all(axis=1)
    seen = seen[: len(block.lon_lat_h)] & np.isfinite(block.lon_lat_h[:, 0])
    rows = rng.permutation(np.flatnonzero(seen))[:MOST_POINTS]
    to_px = scene.rpc.project_derivative(truth[rows]).mean(axis=0)
    adjustment = adjust_scene(
        scene.rpc,
        shape,
        ControlObservations(
            lon_lat_h=block.lon_lat_h[rows],
            line_sample=position[rows] + rng.normal(0.0, MEASURE_SIGMA_PX, (len(rows), 2)),
            sigma_px=np.full(len(rows), MEASURE_SIGMA_PX),
            covariance_m2=block.point_covariance_m2[rows],
            deformation_px2=to_px @ block.frames[0].shared_m2 @ to_px.T,
        ),
    )
    places = image_places(shape)
    height_m = np.full(len(places), np.median(truth[rows, 2]))
    ground = scene.rpc.locate(places, height_m)
    in_block = move_metres(ground, np.tile(frame_error_m, (len(ground), 1)))
    true_px = correction.apply(scene.rpc.project(ground))
    covariance = adjustment.covariance_at(true_px)
    by_ground = scene.rpc.project_derivative(ground)
    frame = by_ground @ block.frames[0].covariance_m2 @ by_ground.transpose(0, 2, 1)
    relative_px = adjustment.correction.apply(scene.rpc.project(in_block)) - true_px
    on_earth_px = adjustment.correction.apply(scene.rpc.project(ground)) - true_px
    return _share(relative_px, covariance), _share(on_earth_px, covariance + frame)


def _share(error_px: Array, covariance: Array) -> float:
    square = (error_px * np.linalg.solve(covariance, error_px[:, :, None])[:, :, 0]).sum(axis=1)
    return float((square <= chi2.ppf(CONFIDENCE, 2)).mean())


def whitened_square(error: Array, covariance: Array) -> Array:
    """Squares (n,) of errors (n, 3) in units of their covariances (n, 3, 3)."""
    return np.asarray((error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(axis=1))


def draw(case: Case, rng: np.random.Generator) -> tuple[Array, list[ImageParameters], Observations]:
    """True points (p, 3), the images as delivered, and what is observed in them."""
    planned = layout(case.layout)
    west, east, south, north = planned.extent_m
    count = round((east - west) * (north - south) * 1e-6 * POINTS_PER_KM2)
    ground = np.column_stack(
        [rng.uniform(west, east, count), rng.uniform(south, north, count), np.zeros(count)]
    )
    truth = lon_lat_h_from_east_north_up(ground, origin())
    truth[:, 2] = GROUND_M + rng.uniform(-RELIEF_M, RELIEF_M, count)
    images, rows = [], []
    for i, view in enumerate(planned.views):
        image = image_parameters(f"image {i + 1}", view.rpc, SHAPE, shift_px=SHIFT_PX, slope_px=SLOPE_PX)
        images.append(image)
        errors = np.column_stack(
            [rng.normal(0.0, SHIFT_PX, 2), rng.uniform(-case.drift_px, case.drift_px, (2, 2))]
        )
        position = view.rpc.project(truth)
        observed = image.corrected(errors[image.free]).correction.apply(position)
        t = (position - image.zero.centre) / image.zero.half_size
        seen = np.flatnonzero((np.abs(t) < 1.0).all(axis=1) & (rng.random(count) < SEEN))
        rows.append(np.column_stack([seen, np.full(len(seen), i), observed[seen]]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    point = table[:, 0].astype(np.int64)
    table = table[np.bincount(point)[point] >= 2]
    line_sample = table[:, 2:] + rng.normal(0.0, NOISE_PX, (len(table), 2))
    wrong = rng.random(len(table)) < case.blunders
    line_sample[wrong] += rng.uniform(-BLUNDER_PX, BLUNDER_PX, (int(wrong.sum()), 2))
    observations = Observations(
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        line_sample,
        np.full(len(table), NOISE_PX),
    )
    return truth, images, observations


@cache
def layout(name: str) -> Layout:
    """The images of a layout."""
    if name == "ring":
        return Layout(_ring(0.0, 5), (-1700.0, 1700.0, -1700.0, 1700.0), _scene(0.0))
    if name == "pair":
        views = (view(0.0, 0.0, 15.0, 90.0), view(0.0, 0.0, 15.0, 270.0))
        return Layout(views, (-1700.0, 1700.0, -1700.0, 1700.0), _scene(0.0))
    if name == "star":
        turns = np.arange(6) * np.pi / 3.0
        around = tuple(
            view(1500.0 * np.sin(a), 1500.0 * np.cos(a), 18.0, float(np.degrees(a))) for a in turns
        )
        star = (view(0.0, 0.0, 2.0, 0.0), *around)
        return Layout(star, (-3000.0, 3000.0, -3000.0, 3000.0), _scene(0.0))
    if name == "strip":
        sides = (45.0, 225.0, 135.0, 315.0)
        strip = tuple(view(1500.0 * k, 0.0, 12.0, sides[k % 4]) for k in range(16))
        return Layout(strip, (-1800.0, 24300.0, -1700.0, 1700.0), _scene(11_000.0))
    groups = _ring(0.0, 3) + _ring(10_000.0, 3)
    return Layout(groups, (-1700.0, 11_700.0, -1700.0, 1700.0), _scene(0.0))


def _ring(east_m: float, count: int) -> tuple[ViewGeometry, ...]:
    return tuple(view(east_m, 0.0, 15.0, 30.0 + 360.0 * k / count) for k in range(count))


def _scene(east_m: float) -> ViewGeometry:
    return view(east_m, 0.0, 8.0, 200.0)


def view(east_m: float, north_m: float, incidence_deg: float, azimuth_deg: float) -> ViewGeometry:
    """The geometry of an image of 4 x 4 km around a place."""
    place = lon_lat_h_from_east_north_up(np.array([[east_m, north_m, 0.0]]), origin())[0]
    plan = ViewPlan(
        "image",
        (float(place[0]), float(place[1])),
        SHAPE,
        1.0,
        incidence_deg,
        azimuth_deg,
        datetime(2024, 6, 1, 10, tzinfo=UTC),
    )
    return plan_geometry(world(), plan, np.random.default_rng(0))


@cache
def world() -> World:
    """Gives images their ground; its relief does not matter here."""
    return make_world(np.random.default_rng(1), size_m=1000.0, posting_m=2.0)


def origin() -> Array:
    """The middle of the first images, (3,)."""
    return np.append(world().centre_lon_lat, GROUND_M)


def show(outcomes: Sequence[Coverage]) -> None:
    """Print the table."""
    table = Table(
        title="truth held by 90 % regions: relative / on the Earth / frame E, N, U / scene; refused"
    )
    table.add_column("layout, drift")
    for blunders in BLUNDERS:
        table.add_column(f"{blunders:.0%} blunders")
    for first in range(0, len(outcomes), len(BLUNDERS)):
        row = outcomes[first : first + len(BLUNDERS)]
        case = row[0].case
        table.add_row(f"{case.layout}, {case.drift_px:g} px", *(in_words(cell) for cell in row))
    Console().print(table)


def in_words(cell: Coverage) -> str:
    """A cell of the table."""
    refused = f"; {cell.refused} of {cell.trials} refused" if cell.refused else ""
    if cell.refused == cell.trials:
        return "refused"
    frame = ", ".join(f"{share:.2f}" for share in cell.frame)
    scene = f"{cell.scene_relative:.2f}, {cell.scene_on_earth:.2f}"
    return f"{cell.relative:.2f} / {cell.on_earth:.2f} / {frame} / {scene}{refused}"


if __name__ == "__main__":
    main()
