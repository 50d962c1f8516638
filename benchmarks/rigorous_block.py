"""How long blocks of rigorous models take beside the same blocks with RPCs.

* 11 scenes over one place, three passes, 200 points that all scenes show;
* 100 scenes of ten passes side by side, 200 control points and 2,000 tie points a scene.

Run: python -m benchmarks.rigorous_block
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.parameters import AdjustableImage, image_parameters
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.geodesy import lon_lat_h_from_east_north_up
from amers.services.sensors.parameter_sets import SRP
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array
from benchmarks._measuring import keep
from benchmarks._rigorous_block import Truth, drawn

PLACE = np.array([-8.0, 31.6, 500.0])
SHAPE, GSD_M, HEIGHTS_M = (6000, 6000), 1.5, (300.0, 1200.0)
SIGMA_M, NOISE_PX, CONTROL_M = 6.0, 0.2, (0.5, 0.8)
SIDE_M = SHAPE[0] * GSD_M
console = Console()


def main() -> None:
    """Print the table and keep its figures."""
    table = Table(title="the whole adjustment, CPU seconds")
    for name in ("scenes", "observations", "control", "rigorous", "RPC", "iterations"):
        table.add_column(name)
    outcome = []
    # What is compiled is loaded before.
    measured(*eleven_scenes())
    for case in (eleven_scenes, hundred_scenes):
        row = measured(*case())
        outcome.append(row)
        table.add_row(
            str(row["scenes"]),
            f"{row['observations']:,}",
            f"{row['control']:,}",
            f"{row['rigorous']['cpu_s']:.2f}",
            f"{row['rpc']['cpu_s']:.2f}",
            f"{row['rigorous']['iterations']}, {row['rpc']['iterations']}",
        )
    console.print(table)
    keep("rigorous_block", outcome)


def eleven_scenes() -> tuple[list[PushbroomModel], Array, int, int]:
    """Three passes over one place: models, points (p, 3), how many are control, views of a point."""
    directions = [(4.0 + 7.0 * (k % 4), (101.0, 281.0, 15.0)[k // 4]) for k in range(11)]
    models = [pushbroom_over(PLACE, SHAPE, GSD_M, view, HEIGHTS_M) for view in directions]
    return models, points_in(np.zeros(2), 0.8 * SIDE_M, 200, 1), 200, 11


def hundred_scenes() -> tuple[list[PushbroomModel], Array, int, int]:
    """Ten passes of ten scenes that overlap by 60 % along and across the track."""
    step_m = 0.4 * SIDE_M
    models = []
    for k in range(100):
        off = np.array([[(k // 10 - 4.5) * step_m, (k % 10 - 4.5) * step_m, 0.0]])
        target = lon_lat_h_from_east_north_up(off, PLACE)[0]
        target[2] = PLACE[2]
        view = (5.0 + 3.0 * (k // 10 % 5), (101.0, 281.0)[k // 10 % 2])
        models.append(pushbroom_over(target, SHAPE, GSD_M, view, HEIGHTS_M))
    side_m = 9.0 * step_m + 0.8 * SIDE_M
    return models, points_in(np.zeros(2), side_m, 2200 * 100 // 5, 2), 4000, 5


def points_in(middle_m: Array, side_m: float, count: int, seed: int) -> Array:
    """Points (count, 3) in a square."""
    rng = np.random.default_rng(seed)
    place = middle_m + rng.uniform(-0.5, 0.5, (count, 2)) * side_m
    points = lon_lat_h_from_east_north_up(np.column_stack([place, np.zeros(count)]), PLACE)
    points[:, 2] = rng.uniform(*HEIGHTS_M, count)
    return points


def measured(
    models: Sequence[PushbroomModel], points: Array, control: int, views: int
) -> dict[str, Any]:
    """CPU times of the block of rigorous models, and of that of RPCs fitted to them."""
    out: dict[str, Any] = {"scenes": len(models), "control": control}
    for kind in ("rigorous", "rpc"):
        images: list[AdjustableImage] = []
        for k, model in enumerate(models):
            if kind == "rigorous":
                images.append(rigorous_parameters(f"scene {k + 1}", model, SRP, sigma_m=SIGMA_M))
                continue
            rpc = fit_rpc(model, SHAPE, HEIGHTS_M).model
            shift_px = SIGMA_M / GSD_M
            images.append(
                image_parameters(f"scene {k + 1}", rpc, SHAPE, shift_px=shift_px, slope_px=0.5)
            )
        rng = np.random.default_rng(3)
        truth = Truth(images, drawn(images, rng), points)
        observations = truth.observed(rng, NOISE_PX, most=views)
        known = truth.control(rng, np.arange(control), CONTROL_M)
        begun = time.process_time()
        block = adjust_block(images, observations, control=known)
        out[kind] = {
            "cpu_s": time.process_time() - begun,
            "iterations": block.iterations,
            "scale": block.sigma_px,
        }
        out["observations"] = len(observations)
    return out


if __name__ == "__main__":
    main()
