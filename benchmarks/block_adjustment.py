"""The block adjustment beside Ceres and scipy, and how it grows with the number of images.

* Ceres (pyceres, the extra `peers`): the same least squares, images and points, from the same start. Its
  residuals are called in Python, so that its own C++ part, the linear solver, is told apart.
* scipy `least_squares` with its robust losses: a ring of five images, 30 % of the observations wrong.
* growth: passes side by side, each size in a process of its own, CPU time and peak memory; powers of the
  number of images fitted from 500 on project 10,000 and 75,000 images.

Run: python -m benchmarks.block_adjustment [--images 100] [--sizes 125,250,500,1000,2000]
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from scipy import sparse
from scipy.optimize import least_squares as scipy_least_squares
from scipy.spatial import cKDTree

from amers.services.adjustment.block_gauge import Gauge
from amers.services.adjustment.block_parts import Weights, block_parts
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.block_solution import State, least_squares, normals
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL
from amers.services.adjustment.normal_equations import Equations
from amers.services.adjustment.parameters import (
    BlockPriors,
    ImageParameters,
    block_priors,
    image_parameters,
)
from amers.services.geodesy import metres_per_degree, move_metres
from amers.services.types import Array, BoolArray, Observations
from benchmarks._measuring import keep, memory_mib, print_table
from benchmarks.block_coverage import GROUND_M, RELIEF_M, SHAPE, Case, draw, origin, view

STEP_M = 2000.0
"""Between images of 4 km, along a pass and across."""
SHIFT_PX, SLOPE_PX, DRIFT_PX, NOISE_PX, BLUNDER_PX = 3.0, 0.2, 0.3, 0.2, 30.0
PER_PASS = 25
"""Images of a pass, at most."""
MOST_VIEWS = 6
_SIDES_DEG = (45.0, 225.0, 135.0, 315.0)
_REACH_M = 2900.0
"""From the middle of an image beyond its corners."""
PER_IMAGE = 300
LOSSES = ("soft_l1", "cauchy")
LARGE = (10_000, 75_000)
console = Console()


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=100, help="beside Ceres (%(default)s)")
    parser.add_argument("--sizes", default="125,250,500,1000,2000", help="images (%(default)s)")
    parser.add_argument(
        "--one", type=int, help="adjust one block of so many images and print its figures"
    )
    parser.add_argument("--per-image", type=int, default=PER_IMAGE, help="points (%(default)s)")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(grown(arguments.one, arguments.per_image)))
        return
    outcome = {
        "ceres": beside_ceres(arguments.images),
        "scipy": [beside_scipy(blunders) for blunders in (0.0, 0.3)],
        "growth": growth([int(size) for size in arguments.sizes.split(",")], arguments.per_image),
    }
    keep("block_adjustment", outcome)


def plain_problem(
    images: list[ImageParameters], observations: Observations, n_points: int
) -> tuple[BlockProblem, BlockPriors, State]:
    """Least squares of all observations and priors, without control, and where they begin."""
    priors = block_priors(images, [])
    options = BlockOptions(converged_px=1e-6)
    problem = BlockProblem(images, observations, NO_CONTROL, options, n_points, priors.size)
    return problem, priors, State(np.zeros((len(images), priors.size)), problem.start())


def cost(problem: BlockProblem, priors: BlockPriors, values: Array, lon_lat_h: Array) -> float:
    """Half the sum of squares of residuals and parameters in units of their sigmas."""
    weight = priors.shape + priors.locating.diagonal()
    residual = problem.equations(values, lon_lat_h).residual
    return float(0.5 * ((residual**2).sum() + (weight * values.ravel() ** 2).sum()))


def beside_ceres(n_images: int) -> dict[str, Any]:
    """Cost and time of both solvers on one problem."""
    truth, images, observations, _ = large_block(n_images, PER_IMAGE, seed=1)
    problem, priors, start = plain_problem(images, observations, len(truth))
    # Ceres knows no gauge: here the observations tell all they seem to.
    rows = len(start.values) * priors.size
    free = Gauge(np.zeros(n_images, dtype=np.int64), *(np.zeros((rows, c)) for c in (3, 0, 0)))
    weights = Weights(np.ones(len(observations)), np.empty(0))

    def solved() -> State:
        parts = block_parts(problem)
        return least_squares(parts, priors, free, normals(parts, start.place, weights)).state

    solved()
    begun = time.process_time()
    state = solved()
    outcome: dict[str, Any] = {
        "images": n_images,
        "points": len(truth),
        "observations": len(observations),
        "cost": cost(problem, priors, state.values, state.lon_lat_h),
        "cpu_s": time.process_time() - begun,
        "iterations": state.iterations,
    }
    try:
        from benchmarks._ceres import solved_by_ceres
    except ImportError:
        console.print("pyceres is not installed (pip install '.[peers]'): Ceres is left out")
        return outcome
    outcome["ceres"] = solved_by_ceres(problem, priors, start)
    columns: dict[str, Callable[[Any], object]] = {
        "": lambda row: row[0],
        "cost": lambda row: f"{row[1]['cost']:.4f}",
        "CPU s": lambda row: f"{row[1]['cpu_s']:.2f}",
        "of it linear solver": lambda row: (
            f"{row[1]['linear_solver_s']:.2f}" if row[0] == "Ceres" else None
        ),
        "iterations": lambda row: row[1]["iterations"],
    }
    title = f"{n_images} images, {len(truth):,} points, {len(observations):,} observations"
    print_table(title, [("Amers", outcome), ("Ceres", outcome["ceres"])], columns)
    return outcome


def beside_scipy(blunders: float) -> dict[str, Any]:
    """Median error of the points, relative to the block, of both robust adjustments of a ring."""
    truth, images, observations = draw(Case("ring", 0.3, blunders), np.random.default_rng(7))
    outcome: dict[str, Any] = {"blunders": blunders, "observations": len(observations)}
    adjust_block(images, observations)
    begun = time.process_time()
    found = adjust_block(images, observations).lon_lat_h
    outcome["cpu_s"] = time.process_time() - begun
    outcome["error_m"] = relative_error_m(found, truth)
    console.print(f"ring, {blunders:.0%} wrong: Amers {in_words(outcome)}")
    for loss in LOSSES:
        begun = time.process_time()
        found, message = by_scipy(images, observations, len(found), loss)
        outcome[loss] = {
            "cpu_s": time.process_time() - begun,
            "error_m": relative_error_m(found, truth),
            "message": message,
        }
        console.print(f"  scipy, {loss}: {in_words(outcome[loss])} ({message})")
    return outcome


def in_words(outcome: dict[str, Any]) -> str:
    """Error and time."""
    return f"{outcome['error_m']:.2f} m in {outcome['cpu_s']:.2f} s"


def relative_error_m(found: Array, truth: Array) -> float:
    """Median distance of points from the truth, but for a translation."""
    east, north = metres_per_degree(float(truth[0, 1]), float(truth[0, 2]))
    error_m = (found - truth[: len(found)]) * [east, north, 1.0]
    return float(np.nanmedian(np.linalg.norm(error_m - np.nanmedian(error_m, axis=0), axis=1)))


def by_scipy(
    images: list[ImageParameters], observations: Observations, n_points: int, loss: str
) -> tuple[Array, str]:
    """The points (p, 3) of scipy's robust least squares with analytic sparse derivatives."""
    problem, priors, start = plain_problem(images, observations, n_points)
    seen = np.unique(observations.point)
    n_values, weight = start.values.size, np.sqrt(priors.shape + priors.locating.diagonal())

    def equations(x: Array) -> Equations:
        moved = np.zeros((n_points, 3))
        moved[seen] = x[n_values:].reshape(-1, 3)
        values = x[:n_values].reshape(start.values.shape)
        return problem.equations(values, move_metres(start.lon_lat_h, moved))

    def residual(x: Array) -> Array:
        return np.concatenate([equations(x).residual.ravel(), weight * x[:n_values]])

    def derivative(x: Array) -> sparse.csr_matrix:
        at = equations(x)
        row = np.arange(2 * len(at.point)).reshape(-1, 2, 1)
        k = at.by_parameters.shape[2]
        of_images = (at.block * k)[:, None, None] + np.arange(k)
        of_points = n_values + 3 * np.searchsorted(seen, at.point)[:, None, None] + np.arange(3)
        parts = [
            sparse.coo_matrix(
                (-part.ravel(), [np.broadcast_to(a, part.shape).ravel() for a in (row, column)]),
                (2 * len(at.point), len(x)),
            )
            for part, column in ((at.by_parameters, of_images), (at.by_ground, of_points))
        ]
        own = sparse.hstack([sparse.diags(weight), sparse.csr_matrix((n_values, 3 * len(seen)))])
        return sparse.vstack([parts[0] + parts[1], own]).tocsr()

    begin = np.zeros(n_values + 3 * len(seen))
    found = scipy_least_squares(residual, begin, derivative, x_scale="jac", loss=loss, max_nfev=200)
    moved = np.full((n_points, 3), np.nan)
    moved[seen] = found.x[n_values:].reshape(-1, 3)
    return move_metres(start.lon_lat_h, moved), str(found.message)


def growth(sizes: list[int], per_image: int) -> dict[str, Any]:
    """Figures of every size, and the powers that project them."""
    rows = []
    for size in sizes:
        command = [sys.executable, "-m", "benchmarks.block_adjustment", "--one", str(size)]
        command += ["--per-image", str(per_image)]
        rows.append(json.loads(subprocess.run(command, check=True, capture_output=True).stdout))
    keys = ("images", "points", "observations", "cpu_s", "peak_mib", "iterations")
    columns = {key: lambda row, key=key: f"{row[key]:,.0f}" for key in keys}
    print_table("growth of the whole adjustment, robust start and covariances included", rows, columns)
    last = [row for row in rows if row["images"] >= 500] or rows
    projected = {}
    for name, taken in (("cpu_s", 0.0), ("peak_mib", float(last[0]["before_mib"]))):
        images = np.log([row["images"] for row in last])
        power, factor = np.polyfit(images, np.log([row[name] - taken for row in last]), 1)
        projected[name] = {
            "power": float(power),
            **{str(n): float(taken + np.exp(factor + power * np.log(n))) for n in LARGE},
        }
    console.print(projected)
    return {"measured": rows, "projected": projected}


def grown(n_images: int, per_image: int) -> dict[str, float]:
    """Figures of one block in a process of its own, with compiled code loaded before."""
    _, *warm = large_block(400, 20, seed=0)
    adjust_block(warm[0], warm[1], passes=warm[2])
    _, images, observations, passes = large_block(n_images, per_image, seed=1, blunders=0.05)
    before_mib = memory_mib("VmRSS")
    begun = time.process_time()
    block = adjust_block(images, observations, passes=passes)
    return {
        "images": n_images,
        "points": int(np.isfinite(block.lon_lat_h[:, 0]).sum()),
        "observations": len(observations),
        "cpu_s": time.process_time() - begun,
        "before_mib": before_mib,
        "peak_mib": memory_mib("VmHWM"),
        "iterations": block.iterations,
        "scale": block.sigma_px,
    }


def large_block(
    n_images: int, per_image: int, seed: int, blunders: float = 0.0
) -> tuple[Array, list[ImageParameters], Observations, list[BoolArray]]:
    """True points (p, 3), images as delivered, what is observed, and the masks of the passes.

    Args:
        n_images: in passes of 25 side by side; each ground is seen four times, from 12 degrees.
        per_image: about so many points in an image, of two to six views.
        seed: of errors and points.
        blunders: share of wrong observations, up to 30 px off.
    """
    rng = np.random.default_rng(seed)
    along, column = np.arange(n_images) % PER_PASS, np.arange(n_images) // PER_PASS
    middle = np.column_stack([column, along]) * STEP_M
    low, high = middle.min(axis=0) - 1700.0, middle.max(axis=0) + 1700.0
    count = round(float(np.prod(high - low)) / (SHAPE[0] * SHAPE[1]) * per_image)
    place = rng.uniform(low, high, (count, 2))
    up = rng.uniform(-RELIEF_M, RELIEF_M, count)
    east, north = metres_per_degree(float(origin()[1]), GROUND_M)
    truth = origin() + np.column_stack([place / [east, north], up])
    near = cKDTree(place)
    first = [view(0.0, 0.0, 12.0, side).rpc for side in _SIDES_DEG]
    images, rows = [], []
    for i in range(n_images):
        rpc = first[(along[i] + 2 * column[i]) % len(first)]
        moved = rpc.ground_offset + np.append(middle[i] / [east, north], 0.0)
        model = replace(rpc, ground_offset=moved)
        image = image_parameters(f"image {i + 1}", model, SHAPE, shift_px=SHIFT_PX, slope_px=SLOPE_PX)
        images.append(image)
        errors = np.column_stack(
            [rng.normal(0.0, SHIFT_PX, 2), rng.uniform(-DRIFT_PX, DRIFT_PX, (2, 2))]
        )
        candidates = np.array(sorted(near.query_ball_point(middle[i], _REACH_M)), dtype=np.int64)
        position = model.project(truth[candidates])
        t = (position - image.zero.centre) / image.zero.half_size
        inside = (np.abs(t) < 1.0).all(axis=1)
        observed = image.corrected(errors[image.free]).correction.apply(position[inside])
        rows.append(np.column_stack([candidates[inside], np.full(len(observed), i), observed]))
    table = np.concatenate(rows)
    table = table[np.lexsort((rng.random(len(table)), table[:, 0]))]
    point = table[:, 0].astype(np.int64)
    rank = np.arange(len(point)) - np.searchsorted(point, point)
    table = table[(rank < MOST_VIEWS) & (np.bincount(point)[point] >= 2)]
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    wrong = rng.random(len(table)) < blunders
    table[:, 2:] += rng.normal(0.0, NOISE_PX, (len(table), 2))
    table[wrong, 2:] += rng.uniform(-BLUNDER_PX, BLUNDER_PX, (int(wrong.sum()), 2))
    kept, point = np.unique(table[:, 0].astype(np.int64), return_inverse=True)
    observations = Observations(
        point.astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2:].copy(),
        np.full(len(table), NOISE_PX),
    )
    passes = [column == c for c in range(int(column.max()) + 1)]
    return truth[kept], images, observations, [mask for mask in passes if mask.sum() > 1]


if __name__ == "__main__":
    main()
