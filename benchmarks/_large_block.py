"""Blocks of any number of images for the benchmark of the adjustment: passes side by side."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.geodesy import metres_per_degree
from amers.services.types import Array, BoolArray, Observations
from benchmarks.block_coverage import GROUND_M, RELIEF_M, SHAPE, origin, view

STEP_M = 2000.0
"""Between images of 4 km, along a pass and across."""
SHIFT_PX, SLOPE_PX, DRIFT_PX, NOISE_PX, BLUNDER_PX = 3.0, 0.2, 0.3, 0.2, 30.0
PER_PASS = 25
"""Images of a pass, at most."""
MOST_VIEWS = 6
_SIDES_DEG = (45.0, 225.0, 135.0, 315.0)
_REACH_M = 2900.0
"""From the middle of an image beyond its corners."""


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
