"""Planimetric errors of a block at sites with precise ortho-images."""

import math
from dataclasses import dataclass, replace

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.geodesy import move_metres
from amers.services.imagery.source import image_gsds_m
from amers.services.matching.control_points import ChipSearch, MatchingOptions, match_points
from amers.services.matching.predict import in_image
from amers.services.matching.reference_image import Reference
from amers.services.types import (
    Acquisition,
    Array,
    ChipSource,
    ControlPoints,
    IntArray,
    Progress,
    no_progress,
)

POINTS = "points"
UNKNOWN_FRAME_SIGMA_M = 10.0
"""Sigma of the frame of a block, for the width of the search, where it is not stated."""
_NEAR_PX = 12
"""Search radius around the shift that the points of a site share, chip pixels."""
_FARTHEST_PX = 150
"""Largest search radius for that shift, chip pixels."""
_SAMPLE = 80
"""Points of a site from which the shift is found."""
_CONSENSUS_PX = 3.0
"""Points whose displacements differ by less agree on a shift, chip pixels."""
_MIN_AGREEING = 3
_MAX_CHIP_TO_SITE = 1.25
"""Chips other than the finest may be this many times coarser than the ortho-image."""
_VERTICAL = Acquisition("site", incidence_deg=0.0, azimuth_deg=0.0)
"""Of the views of a point, those from near the vertical look most like an ortho-image."""


@dataclass(frozen=True)
class Site:
    """A place of which there is an ortho-image that is more accurate than the block.

    Attributes:
        name: for people.
        is_control: whether the production used the place as control.
        reference: the ortho-image; its frame is 0 where it is unknown.
    """

    name: str
    is_control: bool
    reference: Reference


@dataclass(frozen=True)
class SiteErrors:
    """Errors of a block at a site: its positions minus those of the ortho-image.

    Attributes:
        name, is_control: of the site.
        source: what was compared: "points", or the name of an image.
        incidence_deg: of that image at the middle of the site; NaN for points.
        tried: places of the site that were searched.
        reach_m: largest error that the search could find.
        lon_lat: (m, 2) places that were found.
        error_m: (m, 2) east, north.
        covariance_m2: (m, 2, 2) declared for the errors: of the point, of the measure and of details of
            the ortho-image; NaN where nothing is declared.
        frame_m2: (2, 2) of the place of the ortho-image on the Earth; 0 where unknown.
        reasons: why places were not found, with their numbers, the largest first.
    """

    name: str
    is_control: bool
    source: str
    incidence_deg: float
    tried: int
    reach_m: float
    lon_lat: Array
    error_m: Array
    covariance_m2: Array
    frame_m2: Array
    reasons: tuple[tuple[str, int], ...]


def point_errors(
    points: ControlPoints,
    chips: ChipSource,
    site: Site,
    reach_m: float | None = None,
    progress: Progress = no_progress,
) -> SiteErrors:
    """Errors of the points of a block in a site: their chips are searched in its ortho-image.

    A chip is rectified at the height of its point, as the ortho-image is at the ground: the displacement
    between both is the error of the point. The shift that the points share is searched widely with a
    part of them; then all are searched around it.

    Args:
        points: of the block; all have the first frame.
        chips: of the points.
        site: place and ortho-image.
        reach_m: largest shift that is expected; by default three standard deviations of the frame of the
            block and of the ortho-image.
        progress: receives the fraction of the points done.
    """
    reference = site.reference
    inside = in_image(reference.model.project(points.lon_lat_h), reference.image.shape, 0.0)
    rows = np.flatnonzero(inside)
    of_site = points.take(rows)
    reach_m = expected_reach_m(points, site) if reach_m is None else reach_m
    gsd_m = _chip_gsd_m(of_site, reference)
    shift_m = np.zeros(2)
    if len(rows) and reach_m > _NEAR_PX * gsd_m:
        shift_m = _common_shift_m(of_site, chips, site, reach_m)
    moved = _moved(of_site, shift_m)
    matches = match_points(_search(site, gsd_m, _NEAR_PX), moved, chips, MatchingOptions(), progress)
    found = matches.reason == ""
    gsds_m = image_gsds_m(reference.model, moved.lon_lat_h[found])
    measure_m2 = (matches.sigma_px[found] * gsds_m) ** 2 + reference.sigma_m**2
    return SiteErrors(
        name=site.name,
        is_control=site.is_control,
        source=POINTS,
        incidence_deg=math.nan,
        tried=len(rows),
        reach_m=max(reach_m, _NEAR_PX * gsd_m),
        lon_lat=of_site.lon_lat_h[found, :2],
        error_m=-(matches.displacement_m[found] + shift_m),
        covariance_m2=of_site.covariance_m2[found][:, :2, :2] + measure_m2[:, None, None] * np.eye(2),
        frame_m2=frame_of_site_m2(site),
        reasons=reasons_of(matches.reason),
    )


def frame_of_site_m2(site: Site) -> Array:
    """Covariance (2, 2) of the place of an ortho-image on the Earth; 0 where unknown."""
    return np.nan_to_num(site.reference.frame.covariance_m2[:2, :2])


def reasons_of(reason: np.ndarray) -> tuple[tuple[str, int], ...]:
    """Reasons (n,) of places that were not found, "" for the others, with their numbers."""
    names, counts = np.unique(reason[reason != ""], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return tuple((str(names[k]), int(counts[k])) for k in order)


def expected_reach_m(points: ControlPoints, site: Site) -> float:
    """The largest horizontal shift that is expected between a block and the ortho-image of a site."""
    frame_m = points.frames[0].sigma_m
    frame_m = UNKNOWN_FRAME_SIGMA_M if math.isnan(frame_m) else frame_m
    of_site_m = float(np.nan_to_num(site.reference.frame.sigma_m))
    local_m = float(np.sqrt(np.median(np.trace(points.covariance_m2[:, :2, :2], axis1=1, axis2=2) / 2)))
    return MAX_ERROR_SIGMAS * math.sqrt(frame_m**2 + of_site_m**2 + local_m**2)


def _chip_gsd_m(points: ControlPoints, reference: Reference) -> float:
    """Ground sampling of the chips to search: the coarsest without loss of detail, else the finest."""
    gsds_m, views = np.unique(points.views.gsd_m, return_counts=True)
    if not len(points):
        return 1.0
    largest_m = _MAX_CHIP_TO_SITE * float(image_gsds_m(reference.model, points.lon_lat_h[:1])[0])
    usable = (gsds_m <= largest_m) & (views >= 0.8 * views[0])
    return float(gsds_m[usable].max(initial=gsds_m[0]))


def _search(site: Site, gsd_m: float, radius_px: int) -> ChipSearch:
    reference = site.reference
    return ChipSearch(reference.image, reference.model, _VERTICAL, gsd_m, radius_px)


def _common_shift_m(points: ControlPoints, chips: ChipSource, site: Site, reach_m: float) -> Array:
    """The displacement (2,) east, north on which most of some points agree; 0 where they do not."""
    gsds_m = np.unique(points.views.gsd_m)
    near_enough = gsds_m[reach_m <= _FARTHEST_PX * gsds_m]
    gsd_m = max(float(near_enough.min(initial=gsds_m[-1])), _chip_gsd_m(points, site.reference))
    radius_px = min(math.ceil(reach_m / gsd_m), _FARTHEST_PX)
    rows = np.unique(np.linspace(0, len(points) - 1, _SAMPLE).astype(np.int64))
    sample: IntArray = rows[: len(points)]
    search = _search(site, gsd_m, radius_px)
    matches = match_points(search, points.take(sample), chips, MatchingOptions())
    off_m = matches.displacement_m[matches.reason == ""]
    if len(off_m) < _MIN_AGREEING:
        return np.zeros(2)
    agreeing = np.linalg.norm(off_m[:, None] - off_m[None, :], axis=2) <= _CONSENSUS_PX * gsd_m
    best = agreeing[np.argmax(agreeing.sum(axis=1))]
    return np.median(off_m[best], axis=0) if best.sum() >= _MIN_AGREEING else np.zeros(2)


def _moved(points: ControlPoints, shift_m: Array) -> ControlPoints:
    step = np.tile([*shift_m, 0.0], (len(points), 1))
    return replace(points, lon_lat_h=move_metres(points.lon_lat_h, step))
