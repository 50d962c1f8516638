"""How long blocks of rigorous models take beside the same blocks with RPCs.

* 11 scenes over one place, three passes, 200 points that all scenes show;
* 100 scenes of ten passes side by side, 200 control points and 2,000 tie points a scene.

Run: python -m benchmarks.rigorous_block
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import AdjustableImage, image_parameters
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.geodesy import lon_lat_h_from_east_north_up, move_metres
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import SRP
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array, Frame, IntArray, Observations
from benchmarks._measuring import keep, print_table

PLACE = np.array([-8.0, 31.6, 500.0])
SHAPE, GSD_M, HEIGHTS_M = (6000, 6000), 1.5, (300.0, 1200.0)
SIGMA_M, NOISE_PX, CONTROL_M = 6.0, 0.2, (0.5, 0.8)
SIDE_M = SHAPE[0] * GSD_M
EXACT = Frame.from_sigmas(0.0, 0.0)


@dataclass(frozen=True)
class Truth:
    """What a simulation knows.

    Attributes:
        images: as delivered.
        models: as they are: off by draws of the a priori standard deviations of their parameters.
        lon_lat_h: (p, 3) points.
    """

    images: Sequence[AdjustableImage]
    models: Sequence[SensorModel]
    lon_lat_h: Array

    def observed(
        self, rng: np.random.Generator, noise_px: float, of: IntArray | None = None, most: int = 99
    ) -> Observations:
        """What the images show of points, with noise.

        Args:
            rng: source of it.
            noise_px: standard deviation of a coordinate.
            of: rows of the points, all by default.
            most: images that show a point, at most.
        """
        of = np.arange(len(self.lon_lat_h)) if of is None else of
        rows = []
        for i, (image, model) in enumerate(zip(self.images, self.models, strict=True)):
            position = model.project(self.lon_lat_h[of])
            seen = ((position >= 0.0) & (position <= np.array(image.shape) - 1.0)).all(axis=1)
            rows.append(np.column_stack([of[seen], np.full(seen.sum(), i), position[seen]]))
        table = np.concatenate(rows)
        table = table[np.lexsort((rng.random(len(table)), table[:, 0]))]
        rank = np.arange(len(table)) - np.searchsorted(table[:, 0], table[:, 0])
        table = table[rank < most]
        table = table[np.lexsort((table[:, 1], table[:, 0]))]
        return Observations(
            table[:, 0].astype(np.int64),
            table[:, 1].astype(np.int64),
            table[:, 2:] + rng.normal(0.0, noise_px, (len(table), 2)),
            np.full(len(table), noise_px),
        )

    def control(
        self, rng: np.random.Generator, of: IntArray, sigma_m: tuple[float, float], frame: Frame = EXACT
    ) -> ControlGround:
        """Known ground of some points: horizontal and vertical standard deviation, and their frame."""
        sigma = np.array([sigma_m[0], sigma_m[0], sigma_m[1]])
        common_m = rng.multivariate_normal(np.zeros(3), frame.covariance_m2)
        error_m = rng.normal(0.0, sigma, (len(of), 3)) + common_m
        return ControlGround(
            point=of.astype(np.int64),
            lon_lat_h=move_metres(self.lon_lat_h[of], error_m),
            covariance_m2=np.tile(np.diag(sigma**2), (len(of), 1, 1)),
            source=np.zeros(len(of), dtype=np.int64),
            frames=(frame,),
            names=tuple(f"P{row + 1}" for row in of.tolist()),
        )


def drawn(images: Sequence[AdjustableImage], rng: np.random.Generator) -> list[SensorModel]:
    """The models of images as they may be, by their a priori standard deviations."""
    return [image.corrected(rng.normal(0.0, image.sigma)) for image in images]


def main() -> None:
    """Print the table and keep its figures."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    measured(*eleven_scenes())  # What is compiled is loaded before.
    outcome = [measured(*case()) for case in (eleven_scenes, hundred_scenes)]
    columns: dict[str, Callable[[dict[str, Any]], object]] = {
        "scenes": lambda row: row["scenes"],
        "observations": lambda row: f"{row['observations']:,}",
        "control": lambda row: f"{row['control']:,}",
        "rigorous": lambda row: f"{row['rigorous']['cpu_s']:.2f}",
        "RPC": lambda row: f"{row['rpc']['cpu_s']:.2f}",
        "iterations": lambda row: f"{row['rigorous']['iterations']}, {row['rpc']['iterations']}",
    }
    print_table("the whole adjustment, CPU seconds", outcome, columns)
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
