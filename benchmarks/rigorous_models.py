"""Rigorous models: agreement with what producers computed, and speed beside the RPC fitted to each.

With AMERS_REAL_DATA, a folder of real metadata, the first table has the mean, standard deviation and
largest difference from each oracle, line and sample, in pixels. The second one has CPU times of one
thread for random positions over the image and 1,000 m of height, medians of runs in turn, for the model
and for the RPC fitted to it. Run: python -m benchmarks.rigorous_models
"""

import os

# Numba reads this when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.orbit import pushbroom_over
from benchmarks import _rigorous_oracles as oracles
from benchmarks._measuring import cpu_medians_s, keep

HEIGHTS_M = (0.0, 1000.0)


@dataclass(frozen=True)
class Speed:
    """Speed and exactness of one model, and of the RPC fitted to it."""

    product: str
    project_per_s: float
    locate_per_s: float
    round_trip_px: float
    rpc_project_per_s: float
    rpc_locate_per_s: float
    rpc_fit_error_px: float


def main() -> None:
    """Measure, print the tables and store the outcomes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    models = {"simulated, 0.5 m": _simulated()}
    models["simulated, with light"] = replace(_simulated(), light_path=oracles.ALL_EFFECTS)
    agreement = []
    if "AMERS_REAL_DATA" in os.environ:
        folder = Path(os.environ["AMERS_REAL_DATA"]) / oracles.METADATA
        for comparison, effects in _comparisons(folder):
            agreement.append(_agreement(comparison, effects))
            models[comparison.product] = comparison.model
        _show("Differences from oracles, pixels (line, sample)", agreement)
    speeds = [
        vars(_speed(name, model, arguments.points, arguments.repeats)) for name, model in models.items()
    ]
    _show("Speed (points per second of one thread) and exactness", speeds)
    keep("rigorous_models", {"agreement": agreement, "speed": speeds})


def _simulated() -> PushbroomModel:
    """A simulated image of 12,000 x 9,000 px with an incidence of 25 degrees and jitter."""
    target = np.array([5.4, 43.6, 250.0])
    return pushbroom_over(target, (12000, 9000), 0.5, (25.0, 130.0), HEIGHTS_M, jitter_px=0.5)


def _comparisons(folder: Path) -> Iterator[tuple[oracles.Comparison, str]]:
    """All comparisons, and the effects of light in the model; those by default come last."""
    yield oracles.pleiades_grid(folder), ""
    for name in oracles.PLEIADES:
        yield oracles.pleiades_rpc(folder, name), ""
    for name in oracles.WORLDVIEW:
        for effects, light_path in oracles.LIGHT_PATHS.items():
            yield oracles.worldview(folder, name, light_path), effects
    for name in oracles.SPOT:
        if name != "SPOT5.DIM":
            yield oracles.spot_corners_without_attitude(folder, name), ""
        yield oracles.spot_corners(folder, name), ""
    yield oracles.spot_2_rpc(folder), ""
    yield oracles.spot_6_corners(folder), ""


def _agreement(comparison: oracles.Comparison, effects: str) -> dict[str, Any]:
    difference_px = comparison.difference_px
    return {
        "product": comparison.product,
        "oracle": comparison.oracle,
        "effects": effects,
        "mean": difference_px.mean(axis=0).round(4).tolist(),
        "std": difference_px.std(axis=0).round(4).tolist(),
        "largest": round(float(np.abs(difference_px).max()), 4),
        "positions": len(difference_px),
    }


def _speed(name: str, model: PushbroomModel, points: int, repeats: int) -> Speed:
    rng = np.random.default_rng(1)
    image = rng.uniform(0.0, 1.0, (points, 2)) * (np.array(model.image_shape) - 1.0)
    height = rng.uniform(*HEIGHTS_M, points)
    ground = model.locate(image, height)
    fit = fit_rpc(model, model.image_shape, HEIGHTS_M)
    taken_s = cpu_medians_s(
        {
            "project": lambda: model.project(ground),
            "locate": lambda: model.locate(image, height),
            "rpc project": lambda: fit.model.project(ground),
            "rpc locate": lambda: fit.model.locate(image, height),
        },
        repeats,
    )
    return Speed(
        product=name,
        project_per_s=points / taken_s["project"],
        locate_per_s=points / taken_s["locate"],
        round_trip_px=float(np.abs(model.project(ground) - image).max()),
        rpc_project_per_s=points / taken_s["rpc project"],
        rpc_locate_per_s=points / taken_s["rpc locate"],
        rpc_fit_error_px=fit.max_error_px,
    )


def _show(title: str, rows: list[dict[str, Any]]) -> None:
    table = Table(*rows[0], title=title)
    for row in rows:
        table.add_row(
            *(f"{cell:.3g}" if isinstance(cell, float) else str(cell) for cell in row.values())
        )
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
