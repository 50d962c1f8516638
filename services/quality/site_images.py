"""Planimetric errors of the images of a block at sites, measured in the geometry of each image."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amers.services.imagery.scene import Scene, view_direction
from amers.services.imagery.source import image_gsd_m
from amers.services.matching.predict import in_image
from amers.services.matching.reference_image import (
    ReferenceMatchingOptions,
    match_places,
    visible_places,
)
from amers.services.quality.site_errors import Site, SiteErrors, frame_of_site_m2, reasons_of
from amers.services.terrain import Terrain
from amers.services.types import Array

_PLACES = 225
"""Places of a site that are compared with one image."""
_FARTHEST_PX = 60
"""Largest search radius, pixels of the coarser of both images."""
_MATCHING = ReferenceMatchingOptions()


def least_inclined(
    scenes: Sequence[Scene], site: Site, terrain: Terrain | None, count: int
) -> list[Scene]:
    """At most `count` of the images that show the middle of a site, the least inclined there first."""
    middle = _grid(site, terrain, 1)
    shown = []
    for number, scene in enumerate(scenes):
        seen = scene.model.project(middle)
        if in_image(seen, scene.image.shape, 0.0).all():
            incidence_deg, _ = view_direction(scene.model, seen, middle)
            shown.append((float(incidence_deg[0]), number))
    return [scenes[number] for _, number in sorted(shown)[:count]]


def image_errors(
    scene: Scene,
    site: Site,
    terrain: Terrain | None,
    reach_m: float,
) -> SiteErrors:
    """Errors of the positions that an image gives at a site, by its model and the terrain.

    The ortho-image and the terrain are rendered into the geometry of the image, and compared there.
    What is displaced is the error of the model and of the terrain: an ortho-image made by them would
    show the ground that far off. The places lie evenly over the site.

    Args:
        scene: with the adjusted model of the block.
        site: place and ortho-image.
        terrain: of the site; None only for images that are ortho-images.
        reach_m: largest error that is expected.

    Raises:
        InputError: heights move what the image shows, and there is no terrain.
        CoverageError: the terrain does not reach the site.
    """
    reference = replace(site.reference, terrain=terrain)
    middle = _grid(site, terrain, 1)
    incidence_deg, _ = view_direction(scene.model, scene.model.project(middle), middle)
    ground = _grid(site, terrain, round(math.sqrt(_PLACES)))
    line_sample = scene.model.project(ground[np.isfinite(ground).all(axis=1)])
    line_sample = line_sample[in_image(line_sample, scene.image.shape, 0.0)]
    scene_m = image_gsd_m(scene.model, middle[0])
    factor = max(1, int(image_gsd_m(reference.model, middle[0]) / scene_m))
    places = visible_places(scene.model, reference, line_sample, factor, _MATCHING.window_px)
    radius_px = min(max(2, math.ceil(reach_m / (factor * scene_m))), _FARTHEST_PX)
    matches = match_places(scene.image, places, radius_px, _MATCHING)
    found = matches.reason == ""
    n = int(found.sum())
    return SiteErrors(
        name=site.name,
        is_control=site.is_control,
        source=scene.acquisition.image_id,
        incidence_deg=float(incidence_deg[0]),
        tried=len(places.cell),
        reach_m=radius_px * factor * scene_m,
        lon_lat=places.lon_lat_h[found, :2],
        error_m=matches.displacement_m[found],
        covariance_m2=np.full((n, 2, 2), np.nan),
        frame_m2=frame_of_site_m2(site),
        reasons=reasons_of(matches.reason),
    )


def _grid(site: Site, terrain: Terrain | None, per_side: int) -> Array:
    """Ground positions (n, 3) evenly over a site; the height is 0 without a terrain."""
    shape = np.array(site.reference.image.shape, dtype=np.float64)
    axes = [(np.arange(per_side) + 0.5) / per_side * size - 0.5 for size in shape]
    line_sample = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    ground = site.reference.model.locate(line_sample, np.zeros(len(line_sample)))
    if terrain is not None:
        ground[:, 2] = terrain.height_m(ground[:, :2])
    return ground
