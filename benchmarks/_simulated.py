"""Control points of simulated ground, measured as they would be, whose truth is known."""

from collections.abc import Callable, Sequence

import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.imagery.scene import Scene, scene_gsd_m, view_direction
from amers.services.imagery.source import ImageSource, ReducedImage, reduce_image, render_chip
from amers.services.matching.multi_image import chip_inside, chip_saliency, refine_on_chips, stored_chip
from amers.services.simulation.world import World
from amers.services.types import UNKNOWN_FRAME, Array, ChipArray, ControlPoints, Views

LEAST_SALIENCY = 0.3


def lay_points(
    world: World, references: Sequence[Scene], lon_lat: Array, gsds_m: tuple[float, ...]
) -> tuple[ControlPoints, Callable[[int], ChipArray]]:
    """Points measured on chips of images whose models are true, and intersected.

    A place at its true height would not do: its chip shows roofs and slopes around it, and is found
    where the whole of it agrees.

    Args:
        world: gives the heights to begin with.
        references: two images or more, with their true models.
        lon_lat: (n, 2) where points may lie; those that some image does not show whole, that are not
            found in all of them, or that are not salient are left out.
        gsds_m: ground samplings of the chips, finest first; points are measured on the finest.

    Returns:
        The points, and what cuts the chips (views, 101, 101) of the point of a row.
    """
    models = [scene.model for scene in references]
    sources = {gsd_m: [reduced_for(scene, gsd_m) for scene in references] for gsd_m in gsds_m}
    start = np.column_stack([lon_lat, world.height_m(lon_lat)])
    for scene in references:
        start = start[chip_inside(scene.model, scene.image.shape, start, gsds_m[-1], 2)]
    seen = refine_on_chips(references, start, gsds_m[0]).observations
    found = intersect(models, seen, len(start))
    saliency = np.array(
        [
            chip_saliency(render_chip(sources[gsds_m[0]][0], models[0], point, gsds_m[0]))
            for point in start
        ]
    )
    kept = np.isfinite(found.lon_lat_h[:, 0]) & (found.rays == len(references))
    kept &= saliency >= LEAST_SALIENCY
    ground, n = found.lon_lat_h[kept], int(kept.sum())
    views = [(gsd_m, image) for gsd_m in gsds_m for image in range(len(references))]
    image = np.tile([image for _, image in views], n)
    directions = [view_direction(model, model.project(ground), ground) for model in models]
    each = np.repeat(np.arange(n), len(views))
    incidence_deg, azimuth_deg = (
        np.array([direction[angle] for direction in directions])[image, each] for angle in (0, 1)
    )
    points = ControlPoints(
        id=np.arange(n, dtype=np.int64),
        lon_lat_h=ground,
        covariance_m2=found.covariance_m2[kept],
        block=np.zeros(n, dtype=np.int64),
        frames=(UNKNOWN_FRAME,),
        saliency=saliency[kept],
        health=np.ones(n),
        views=Views(
            start=np.arange(n + 1, dtype=np.int64) * len(views),
            gsd_m=np.tile([gsd_m for gsd_m, _ in views], n),
            image=image,
            incidence_deg=incidence_deg,
            azimuth_deg=azimuth_deg,
            health=np.ones(len(image)),
            images=tuple(scene.acquisition for scene in references),
        ),
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=np.arange(n, dtype=np.int64) * len(views),
        chip_files=("chips",),
    )

    def cut(row: int) -> ChipArray:
        return np.stack(
            [
                stored_chip(render_chip(sources[gsd_m][image], models[image], ground[row], gsd_m))
                for gsd_m, image in views
            ]
        )

    return points, cut


def reduced_for(scene: Scene, gsd_m: float) -> ImageSource | ReducedImage:
    """The image, or what `render_chip` would reduce it to for every chip of a ground sampling."""
    factor = int(gsd_m / scene_gsd_m(scene) / 2.0)
    return reduce_image(scene.image, factor) if factor > 1 else scene.image
