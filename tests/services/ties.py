"""Simulated tie points without pixels: observations and truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.geodesy import metres_per_degree
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Array, BoolArray, Observations
from tests.services.simulated import world


@dataclass(frozen=True)
class Ties:
    """Observations of points with known ground positions.

    Attributes:
        lon_lat_h: (p, 3) true positions of the points.
        observations: of the points.
        wrong: (m,) observations that are blunders.
    """

    lon_lat_h: Array
    observations: Observations
    wrong: BoolArray


def make_ties(
    geometries: Sequence[ViewGeometry],
    rng: np.random.Generator,
    count: int = 300,
    noise_px: float = 0.2,
    blunders: float = 0.0,
    shift_px: Array | None = None,
    seen: float = 1.0,
) -> Ties:
    """Simulated observations of points in images, with noise and blunders.

    Args:
        geometries: the images; their RPCs project the points.
        rng: source of positions, noise and blunders.
        count: number of points.
        noise_px: noise of each coordinate, which is also the stated sigma.
        blunders: share of observations that are up to 30 px away.
        shift_px: (n, 2) error of the RPC of each image.
        seen: share of the images that observe a point; at least two do.
    """
    n_images, shape = len(geometries), np.array(geometries[0].plan.shape)
    image = rng.uniform(0.1, 0.9, (count, 2)) * shape
    ground = geometries[0].true_model.locate(image, rng.uniform(*world().height_range_m, count))
    sees = rng.random((count, n_images)) < seen
    sees[np.arange(count), rng.integers(0, n_images, count)] = True
    sees[sees.sum(axis=1) < 2] = True
    point, of_image = np.nonzero(sees)
    line_sample = np.empty((len(point), 2))
    for i, geometry in enumerate(geometries):
        rows = of_image == i
        line_sample[rows] = geometry.rpc.project(ground[point[rows]])
    line_sample += rng.normal(0.0, 1.0, line_sample.shape) * noise_px
    if shift_px is not None:
        line_sample += shift_px[of_image]
    wrong = rng.random(len(point)) < blunders
    line_sample[wrong] += rng.uniform(-30.0, 30.0, (int(wrong.sum()), 2))
    observations = Observations(
        point.astype(np.int64), of_image.astype(np.int64), line_sample, np.full(len(point), noise_px)
    )
    return Ties(ground, observations, wrong)


def difference_m(lon_lat_h: Array, truth: Array) -> Array:
    """Errors (n, 3) of computed points, metres east, north and up."""
    east, north = metres_per_degree(float(truth[0, 1]), float(truth[0, 2]))
    return np.asarray((lon_lat_h - truth) * [east, north, 1.0])


def whitened_square(error: Array, covariance: Array) -> Array:
    """Mean square (n,) of errors (n, k) normalised by their covariances (n, k, k)."""
    solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return np.asarray((error * solved).sum(axis=1) / error.shape[1])


def without(ties: Ties, rows: BoolArray) -> Ties:
    """The ties without some observations."""
    return replace(ties, observations=ties.observations.take(~rows), wrong=ties.wrong[~rows])
