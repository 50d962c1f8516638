"""Control points at given places: their saliency, and their views in images that agree."""

from collections.abc import Sequence

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.control_points import chip_pixels
from amers.services.matching.multi_image import chip_saliency, stored_chip
from amers.services.production.point_views import shows_nearly_whole_chip, views_at_levels
from amers.services.production.view_agreement import AgreedViews
from amers.services.types import Array, ControlPoints, Frame, IntArray


def detail_saliency(scene: Scene, lon_lat_h: Array, gsd_m: float) -> float:
    """The saliency of the chip of a point (3,) as it is stored; 0 where a tenth of it is missing."""
    chip = render_chip(scene.image, scene.model, lon_lat_h, gsd_m)
    return chip_saliency(chip_pixels(stored_chip(chip)))


def detail_points(
    agreed: AgreedViews,
    rows: IntArray,
    lon_lat_h: Array,
    covariance_m2: Array,
    *,
    saliency: Array,
    frame: Frame,
    gsds_m: Sequence[float],
) -> ControlPoints:
    """Control points of one chip file, with the views that agree and show the chips nearly whole.

    Args:
        agreed: of all the points.
        rows: (n,) of the points to take, ascending.
        lon_lat_h: (n, 3).
        covariance_m2: (n, 3, 3) of east, north, up.
        saliency: (n,).
        frame: of the block.
        gsds_m: ground samplings of the chips, finest first, metres.
    """
    n = len(rows)
    found = agreed.take(rows)
    levels = [
        found.take(shows_nearly_whole_chip(agreed.scenes, found, lon_lat_h, gsd_m)) for gsd_m in gsds_m
    ]
    views = views_at_levels(agreed.scenes, levels, lon_lat_h, gsds_m)
    return ControlPoints(
        id=np.arange(n, dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=covariance_m2,
        block=np.zeros(n, dtype=np.int64),
        frames=(frame,),
        saliency=saliency,
        health=np.ones(n),
        views=views,
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=views.start[:-1].copy(),
        chip_files=("chips",),
    )
