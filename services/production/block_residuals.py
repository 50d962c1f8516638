"""Residuals and corrections of images and points in their block, and images that do not fit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.bundle import BlockAdjustment
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, IntArray, Observations

FITS = "fits"
_FEWEST = 12
"""Measures that hold the six parameters of an image with some to spare."""
_LEAST_USED = 0.6
"""Share of the measures of an image that agree in a sound block."""
_LARGEST_RATIO = 2.0
"""Residuals of an image over those of the middle image."""


@dataclass(frozen=True)
class ImageFit:
    """How one image fits.

    Attributes:
        name: of the image.
        measures: of points in the image.
        used: measures that agree.
        rms_px: residuals of these, line and sample.
        off_m: by how much the delivered model was off at the centre, metres east and north.
        stated_m: standard deviation that was stated for it, a coordinate.
        verdict: "fits", or what is odd.
    """

    name: str
    measures: int
    used: int
    rms_px: tuple[float, float]
    off_m: tuple[float, float]
    stated_m: float
    verdict: str


@dataclass(frozen=True)
class PointFits:
    """How n points fit.

    Attributes:
        images: (n,) images that measure the point.
        used: (n,) measures that agree.
        rms_px: (n,) length of the residuals of these, root mean square.
        largest_px: (n,) the longest.
    """

    images: IntArray
    used: IntArray
    rms_px: Array
    largest_px: Array


def image_fits(
    scenes: Sequence[Scene], measures: Observations, adjustment: BlockAdjustment
) -> tuple[ImageFit, ...]:
    """How every image of a block fits.

    Args:
        scenes: as delivered.
        measures: m of them, that the block was adjusted on.
        adjustment: of the block.
    """
    rms_px = np.full((len(scenes), 2), np.nan)
    count = np.zeros((len(scenes), 2), dtype=np.int64)
    for i in range(len(scenes)):
        own = measures.image == i
        used = own & adjustment.active
        count[i] = own.sum(), used.sum()
        if used.any():
            rms_px[i] = np.sqrt((adjustment.residual_px[used] ** 2).mean(axis=0))
    middle_px = float(np.nanmedian(np.linalg.norm(rms_px, axis=1)))
    return tuple(
        _image_fit(
            scene,
            _shift_px(scene, adjustment.models[i]),
            tuple(count[i].tolist()),
            rms_px[i],
            middle_px,
        )
        for i, scene in enumerate(scenes)
    )


def _shift_px(scene: Scene, adjusted: SensorModel) -> Array:
    """By how much (2,) the middle of an image moved."""
    middle = (np.array([scene.image.shape]) - 1.0) / 2.0
    height_m = np.array([np.mean(scene.model.height_range_m)])
    return np.asarray((adjusted.project(scene.model.locate(middle, height_m)) - middle)[0])


def _image_fit(
    scene: Scene, shift_px: Array, count: tuple[int, int], rms_px: Array, middle_px: float
) -> ImageFit:
    to_ground = np.linalg.inv(scene.model.project_derivative(scene_centre(scene)[None, :])[0, :, :2])
    off_m = to_ground @ shift_px
    sigmas = float(np.abs(shift_px).max()) * scene_gsd_m(scene) / scene.sigma_m
    ratio = float(np.linalg.norm(rms_px)) / max(middle_px, 1e-9)
    measures, used = count
    odd = []
    if used < _FEWEST:
        odd.append(f"{used} measures: it needs more common ground with other images")
    if used < _LEAST_USED * measures:
        odd.append(
            f"{measures - used} of {measures} measures disagree: clouds, changes or a wrong model"
        )
    if sigmas > MAX_ERROR_SIGMAS:
        odd.append(f"off by {sigmas:.1f} times the accuracy stated for it")
    if ratio > _LARGEST_RATIO:
        odd.append(f"residuals {ratio:.1f} times the median of the images: its model is bent")
    return ImageFit(
        name=scene.acquisition.image_id,
        measures=measures,
        used=used,
        rms_px=(float(rms_px[0]), float(rms_px[1])),
        off_m=(float(off_m[0]), float(off_m[1])),
        stated_m=scene.sigma_m,
        verdict="; ".join(odd) or FITS,
    )


def point_fits(rows: IntArray, measures: Observations, adjustment: BlockAdjustment) -> PointFits:
    """How points of a block, given by their rows in the adjustment (n,), fit."""
    count = len(adjustment.lon_lat_h)
    used = measures.take(np.flatnonzero(adjustment.active)).point
    length_px = np.linalg.norm(adjustment.residual_px[adjustment.active], axis=1)
    n_used = np.bincount(used, minlength=count)
    square = np.bincount(used, weights=length_px**2, minlength=count)
    largest = np.zeros(count)
    np.maximum.at(largest, used, length_px)
    return PointFits(
        images=np.bincount(measures.point, minlength=count)[rows],
        used=n_used[rows],
        rms_px=np.sqrt(square[rows] / np.maximum(n_used[rows], 1)),
        largest_px=largest[rows],
    )
