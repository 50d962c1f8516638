"""Positions of a scene matched on a reference ortho-image, rendered into the geometry of the scene."""

from dataclasses import dataclass, field

import numpy as np

from amers.services.errors import InputError
from amers.services.imagery.gaps import bridged
from amers.services.imagery.source import (
    ArrayImage,
    ImageSource,
    ReducedImage,
    Window,
    block_means,
    image_gsds_m,
    interpolate_nodes,
    low_pass,
    sample_image,
)
from amers.services.lines_of_sight import intersect_terrain
from amers.services.matching.control_points import PointMatches
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.matching.radiometry import mark_clouds, patch_statistics
from amers.services.sensors.base import SensorModel
from amers.services.statements import Statements
from amers.services.terrain import Terrain
from amers.services.types import (
    UNKNOWN_FRAME,
    Array,
    FloatImage,
    Frame,
    IntArray,
    Progress,
    ViewMeasures,
    no_progress,
)

NO_HEIGHT_SIGMA_M = 5000.0
"""Sigma of unknown heights: land reaches from -430 to 8,850 m."""
_NODE_PX = 4
"""Pixels of a level between the lines of sight that are intersected with the terrain."""


@dataclass(frozen=True)
class Reference:
    """A reference ortho-image and the terrain under it.

    Attributes:
        image: its pixels.
        model: an ortho model.
        terrain: the ground, with the sigma of its heights; None assumes height zero, which only a scene
            without parallax allows.
        sigma_m: position of a detail relative to the rest of the image, one standard deviation a
            coordinate.
        common_sigma_m: error that all positions measured on the image share, one standard deviation a
            coordinate: shadows and roofs lean the same way everywhere.
        frame: position of the whole image on the Earth, and of the heights of the terrain.
        statements: of its files.
    """

    image: ImageSource
    model: SensorModel
    terrain: Terrain | None
    sigma_m: float
    common_sigma_m: float
    frame: Frame = UNKNOWN_FRAME
    statements: Statements = ()

    def height_sigma_m(self, lon_lat: Array) -> Array:
        """One standard deviation (n,) of the heights of places at (n, 2), metres."""
        if self.terrain is None:
            return np.full(len(lon_lat), NO_HEIGHT_SIGMA_M)
        return self.terrain.sigma_m(lon_lat)


@dataclass(frozen=True)
class ReferenceMatchingOptions:
    """How places are matched on a reference.

    Attributes:
        window_px: side of the window of the reference that is correlated, pixels of the level; odd.
        correlation: when a correlation peak is accepted.
    """

    window_px: int = 41
    correlation: CorrelationOptions = field(default_factory=lambda: CorrelationOptions(min_score=0.7))

    def __post_init__(self) -> None:
        """Reject windows that have no centre or too little content."""
        if self.window_px < 11 or self.window_px % 2 == 0:
            raise InputError(f"window_px: {self.window_px} given, an odd number of at least 11 expected")


@dataclass(frozen=True)
class Places:
    """Places of a level of a scene, and the ground that a model locates there.

    Attributes:
        model: of the scene.
        reference: what the scene is matched against.
        cell: (n, 2) pixels of the level; pixel c covers `factor` pixels of the scene from c * factor on.
        factor: pixels of the scene per pixel of the level.
        line_sample: (n, 2) centres of these pixels, pixels of the scene.
        lon_lat_h: (n, 3) the ground.
        nodes: (n, k, k, 2) positions in the reference of nodes around each place, pixels.
    """

    model: SensorModel
    reference: Reference
    cell: IntArray
    factor: int
    line_sample: Array
    lon_lat_h: Array
    nodes: Array


def visible_places(
    model: SensorModel, reference: Reference, line_sample: Array, factor: int, window_px: int
) -> Places:
    """The places nearest to image positions (n, 2) whose windows lie inside the reference.

    Args:
        model: of the scene.
        reference: what the scene is matched against.
        line_sample: (n, 2) pixels of the scene.
        factor: pixels of the scene per pixel of the level.
        window_px: side of the window that is correlated, pixels of the level.

    Raises:
        CoverageError: the terrain does not reach the scene.
        InputError: the scene has a parallax, and there is no terrain.
    """
    cell = np.floor((line_sample + 0.5) / factor).astype(np.int64)
    centre = np.asarray(cell * float(factor) + (factor - 1) / 2.0, dtype=np.float64)
    half = -(-(window_px // 2) // _NODE_PX)
    offset = np.arange(-half, half + 1) * float(_NODE_PX * factor)
    around = centre[:, None, None, :] + np.stack(np.meshgrid(offset, offset, indexing="ij"), axis=-1)
    ground = locate_on_terrain(model, around.reshape(-1, 2), reference.terrain)
    nodes = np.asarray(reference.model.project(ground).reshape(around.shape), dtype=np.float64)
    inside = np.isfinite(nodes).all(axis=(1, 2, 3))
    inside &= ((nodes >= 0.0) & (nodes <= np.array(reference.image.shape) - 1.0)).all(axis=(1, 2, 3))
    lon_lat_h = ground.reshape(*around.shape[:3], 3)[:, half, half]
    return Places(
        model, reference, cell[inside], factor, centre[inside], lon_lat_h[inside], nodes[inside]
    )


def match_places(
    image: ImageSource | ReducedImage,
    places: Places,
    radius_px: int,
    options: ReferenceMatchingOptions,
    progress: Progress = no_progress,
) -> PointMatches:
    """Positions in a scene of the ground at its places, as the reference shows that ground.

    The reference and its terrain are rendered into the geometry of the scene, so that the displacement
    is the error of the model. The scene itself is averaged, never resampled.

    Args:
        image: the scene, or its reduction by the factor of the places.
        places: all of them are tried.
        radius_px: search radius, pixels of the level.
        options: thresholds.
        progress: receives the fraction of the places done.
    """
    n, factor = len(places.cell), places.factor
    reference = places.reference
    line_sample = np.full((n, 2), np.nan)
    sigma_px = np.full(n, np.nan)
    score = np.full(n, np.nan)
    reason = np.full(n, "", dtype="<U16")
    statistics = []
    gsds_m = (image_gsds_m(model, places.lon_lat_h) for model in (places.model, reference.model))
    ratios = (factor * np.divide(*gsds_m)).tolist()
    for i, ratio in enumerate(ratios):
        if i % 64 == 0:
            progress(i / n, f"searching {n} places at 1:{factor}")
        positions = interpolate_nodes(places.nodes[i], options.window_px, _NODE_PX)
        chip = sample_image(reference.image, positions, ratio)
        patch = _level_patch(image, places.cell[i], options.window_px // 2 + radius_px, factor)
        peak = find_chip(low_pass(patch, 1.0 / ratio), chip, options.correlation)
        score[i], reason[i] = peak.score, peak.reason
        statistics.append(patch_statistics(patch))
        if peak.reason == FOUND:
            line_sample[i] = places.line_sample[i] + peak.row_col * factor
            sigma_px[i] = peak.sigma_px * factor
    derivative = places.model.project_derivative(places.lon_lat_h)[:, :, :2]
    displacement_px = line_sample - places.line_sample
    found = reason == FOUND
    mark_clouds(reason, statistics)
    return PointMatches(
        line_sample=line_sample,
        displacement_m=np.asarray(
            np.linalg.solve(derivative, displacement_px[:, :, None])[:, :, 0], np.float64
        ),
        sigma_px=sigma_px,
        score=score,
        views=found.astype(np.int64),
        reason=reason,
        by_gradient=np.zeros(n, dtype=bool),
        common_covariance_m2=reference.common_sigma_m**2 * np.eye(2),
        view_measures=ViewMeasures(np.arange(n), np.zeros(n, dtype=np.int64), score, found, reason),
    )


def locate_on_terrain(model: SensorModel, line_sample: Array, terrain: Terrain | None) -> Array:
    """Ground positions (n, 3) lon, lat, height of image positions (n, 2), on the terrain or at height 0.

    Raises:
        InputError: the scene has a parallax, and there is no terrain.
    """
    if terrain is not None:
        return intersect_terrain(model, line_sample, terrain)
    middle_m = np.array([sum(model.height_range_m) / 2.0])
    if model.project_derivative(model.locate(line_sample[:1], middle_m))[0, :, 2].any():
        raise InputError(
            "a terrain model is needed: the positions in this scene depend on the height of the ground. "
            "Give a terrain with the reference image"
        )
    return model.locate(line_sample, np.zeros(len(line_sample)))


def _level_patch(
    image: ImageSource | ReducedImage, cell: IntArray, half: int, factor: int
) -> FloatImage:
    """Pixels (2 half + 1, 2 half + 1) of a level around one of its pixels, small gaps bridged."""
    line, sample = (int(v) - half for v in cell)
    size = 2 * half + 1
    if isinstance(image, ReducedImage):
        return bridged(ArrayImage(image.pixels).read(Window(line, sample, size, size)))
    window = Window(line * factor, sample * factor, size * factor, size * factor)
    return bridged(block_means(image.read(window), factor))
