"""Blocks of images with rigorous models whose attitude, orbit and focal length are off as expected."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.geodesy import move_metres
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, Frame, IntArray, Observations

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
