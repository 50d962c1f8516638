"""A scene: an image, its model and its acquisition, the input of registration and production."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull

from amers.services.geodesy import continuous, ecef_from_east_north_up
from amers.services.imagery.pixel_checks import PixelFinding, pixel_findings
from amers.services.imagery.source import ImageSource, image_gsd_m
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import ParameterSet
from amers.services.statements import Statements
from amers.services.types import Acquisition, Array

FOOTPRINT_PER_SIDE = 8
"""Positions along each side of an image that are located for its footprint."""


@dataclass(frozen=True)
class Scene:
    """One image with a model of its geometry.

    Attributes:
        image: its pixels.
        model: from ground to image.
        acquisition: how the image was taken.
        sigma_m: horizontal accuracy of the model before registration, one standard deviation a
            coordinate, metres.
        parameter_set: what is free in its rigorous model where scenes are registered together; None for
            a correction in the image.
        statements: of its files.
        pixel_findings: what is wrong with its pixels; None before they were measured.
    """

    image: ImageSource
    model: SensorModel
    acquisition: Acquisition
    sigma_m: float
    parameter_set: ParameterSet | None = None
    statements: Statements = ()
    pixel_findings: tuple[PixelFinding, ...] | None = None


def with_pixel_findings(scene: Scene) -> Scene:
    """A scene whose pixels were measured: by `read_scene`'s caller with its bands, or here without."""
    if scene.pixel_findings is not None:
        return scene
    return replace(scene, pixel_findings=pixel_findings(scene.image).findings)


def scene_centre(scene: Scene) -> Array:
    """Ground position (3,) of the centre of the image, at the middle height of its model."""
    centre = (np.array(scene.image.shape, dtype=np.float64) - 1.0) / 2.0
    height_m = sum(scene.model.height_range_m) / 2.0
    return scene.model.locate(centre[None, :], np.array([height_m]))[0]


def scene_gsd_m(scene: Scene) -> float:
    """Ground sampling at the centre of the image, metres."""
    return image_gsd_m(scene.model, scene_centre(scene))


def image_border(shape: tuple[int, int]) -> Array:
    """Positions (m, 2) along the outer edge of an image of (lines, samples), pixels; not closed."""
    lines, samples = shape
    t = np.linspace(0.0, 1.0, FOOTPRINT_PER_SIDE, endpoint=False)
    corners = np.array(
        [
            [-0.5, -0.5],
            [-0.5, samples - 0.5],
            [lines - 0.5, samples - 0.5],
            [lines - 0.5, -0.5],
        ]
    )
    return np.concatenate(
        [a + t[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )


def scene_footprint(scene: Scene, heights_m: tuple[float, float] | None = None) -> Array:
    """Outline of the ground that the image can show between two heights.

    Args:
        scene: the image.
        heights_m: lowest and highest ground; None for those of the model.

    Returns:
        (m, 2) lon, lat of the convex hull of the border of the image at both heights,
        counter-clockwise, not closed. Longitudes are continuous: they exceed 180 degrees where the
        outline crosses the antimeridian.
    """
    border = image_border(scene.image.shape)
    rings = [
        scene.model.locate(border, np.full(len(border), height_m))[:, :2]
        for height_m in heights_m or scene.model.height_range_m
    ]
    outline = np.concatenate(rings)
    outline = outline[np.isfinite(outline).all(axis=1)]
    outline[:, 0] = outline[0, 0] + (outline[:, 0] - outline[0, 0] + 180.0) % 360.0 - 180.0
    return np.asarray(outline[ConvexHull(outline).vertices])


def common_footprint(scenes: Sequence[Scene], heights_m: tuple[float, float] | None = None) -> Array:
    """The outlines of scenes of the same ground, one after the other.

    Args:
        scenes: the images.
        heights_m: lowest and highest ground; None for those of each model.

    Returns:
        (m, 2) lon, lat as of `scene_footprint`, in longitudes that are continuous over all scenes.
    """
    return continuous(np.concatenate([scene_footprint(scene, heights_m) for scene in scenes]))


def view_direction(model: SensorModel, line_sample: Array, lon_lat_h: Array) -> tuple[Array, Array]:
    """Incidence and azimuth of the directions from ground points to the sensor.

    Args:
        model: of the image.
        line_sample: (n, 2) positions of the points in the image, pixels.
        lon_lat_h: (n, 3) the points.

    Returns:
        Incidence (n,) and azimuth (n,), degrees.
    """
    _, direction = model.line_of_sight(line_sample)
    incidence = np.empty(len(lon_lat_h))
    azimuth = np.empty(len(lon_lat_h))
    for i, point in enumerate(lon_lat_h):
        east, north, up = -direction[i] @ ecef_from_east_north_up(point)
        incidence[i] = np.degrees(np.arctan2(np.hypot(east, north), up))
        azimuth[i] = np.degrees(np.arctan2(east, north)) % 360.0
    return incidence, azimuth
