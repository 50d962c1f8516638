"""Reach of a known site: each site alone as control of a block, the others as check."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround, joined_ground
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.errors import InputError
from amers.services.geodesy import ecef_from_lon_lat_h, metres_per_degree_at, wrapped_degrees
from amers.services.quality.stability import image_places
from amers.services.types import Array, Observations


@dataclass(frozen=True)
class KnownSite:
    """A place with known ground.

    Attributes:
        name: for people.
        ground: its points; each is also observed in images of the block.
    """

    name: str
    ground: ControlGround


@dataclass(frozen=True)
class SiteCheck:
    """What a block with one known site computes at another one.

    Attributes:
        active, check: names of the sites.
        distance_km: between the middles of their points.
        points: of the check site that were computed.
        error_m: (3,) computed minus known, east, north, up; mean of these points.
        covariance_m2: (3, 3) declared for it: block, frame of the site, own errors. What the points of
            the site do not share counts in full, so that it is not exceeded by more points.
    """

    active: str
    check: str
    distance_km: float
    points: int
    error_m: Array
    covariance_m2: Array

    @property
    def residual_m(self) -> float:
        """Length of the horizontal error: the published figure."""
        return float(np.hypot(*self.error_m[:2]))


@dataclass(frozen=True)
class CornerMove:
    """How far the corners of an image move when one site is known instead of all.

    Attributes:
        active: name of the site.
        image: name of the image.
        moved_m: (4, 2) east, north, on the ground.
    """

    active: str
    image: str
    moved_m: Array


@dataclass(frozen=True)
class SiteReach:
    """How far each of several known sites carries alone.

    Attributes:
        checks: every site with every other one.
        corners: of every image, for every site.
    """

    checks: tuple[SiteCheck, ...]
    corners: tuple[CornerMove, ...]


def site_reach(
    images: Sequence[AdjustableImage],
    observations: Observations,
    sites: Sequence[KnownSite],
    others: ControlGround = NO_CONTROL,
) -> SiteReach:
    """The errors at all sites of blocks that know one of them, and the moves of the images' corners.

    The block is adjusted with all sites, then once with each. Points of a check site are observed as
    they are, and their known ground takes no part.

    Args:
        images: with what may move.
        observations: of tie points and of the points of the sites.
        sites: two or more.
        others: control of all adjustments: heights of an elevation model.

    Raises:
        InputError: fewer than two sites.
        ComputationError: a block cannot be adjusted.
    """
    if len(sites) < 2:
        raise InputError(
            f"{len(sites)} known site given, at least 2 needed: one is the check of another"
        )

    def adjusted(members: Sequence[KnownSite]) -> BlockAdjustment:
        control = joined_ground([others, *(site.ground for site in members)])
        return adjust_block(images, observations, control=control)

    whole = adjusted(sites)
    height_m = float(np.nanmedian(whole.lon_lat_h[:, 2]))
    checks, corners = [], []
    for active in sites:
        block = adjusted([active])
        checks += [_check(block, active, site) for site in sites if site is not active]
        for image, one, all_of in zip(images, block.models, whole.models, strict=True):
            places = image_places(image.shape)[:4]
            at = np.full(len(places), height_m)
            moved = _difference_m(one.locate(places, at), all_of.locate(places, at))[:, :2]
            corners.append(CornerMove(active.name, image.name, moved))
    return SiteReach(tuple(checks), tuple(corners))


def _check(block: BlockAdjustment, active: KnownSite, site: KnownSite) -> SiteCheck:
    ground = site.ground
    error_m = _difference_m(block.lon_lat_h[ground.point], ground.lon_lat_h)
    rows = np.flatnonzero(np.isfinite(error_m[:, 0]))
    first, second = (ecef_from_lon_lat_h(one.ground.lon_lat_h).mean(axis=0) for one in (active, site))
    mean_m, covariance_m2 = np.full(3, np.nan), np.full((3, 3), np.nan)
    if len(rows):
        mean_m = error_m[rows].mean(axis=0)
        own_m2 = ground.covariance_m2[rows].mean(axis=0) / len(rows)
        frames_m2 = sum(ground.frames[k].covariance_m2 for k in np.unique(ground.source[rows]))
        of_points_m2 = block.point_covariance_m2[ground.point[rows]].mean(axis=0)
        covariance_m2 = of_points_m2 + own_m2 + frames_m2 + block.frames[0].covariance_m2
    distance_km = float(np.linalg.norm(first - second)) / 1000.0
    return SiteCheck(active.name, site.name, distance_km, len(rows), mean_m, covariance_m2)


def _difference_m(computed: Array, known: Array) -> Array:
    """Computed minus known ground (n, 3), metres east, north, up."""
    difference = computed - known
    difference[:, 0] = wrapped_degrees(difference[:, 0])
    difference[:, :2] *= metres_per_degree_at(known)
    return np.asarray(difference)
