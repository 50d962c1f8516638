"""Planned images, sites and points of a block that does not exist yet."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.adjustment.planning import planned_observations
from amers.services.errors import InputError
from amers.services.geodesy import continuous, lon_lat_h_from_east_north_up, metres_per_degree_at
from amers.services.map_grid import MapGrid, utm_of
from amers.services.sensors.base import SensorModel
from amers.services.sensors.ortho import OrthoModel, ReliefDisplacement
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations

_HEIGHT_MARGIN_M = 1000.0
_RADIUS = 0.1
"""Radius of a site over the spacing of the points."""
_MIN_POINTS, _MAX_POINTS = 20, 20_000
"""Points of the ground that a plan computes."""


@dataclass(frozen=True)
class PlannedImage:
    """An image that does not exist yet.

    Attributes:
        name: for people.
        lon_lat: (2,) position of its middle.
        size_m: along and across the track.
        gsd_m: ground sampling.
        incidence_deg, azimuth_deg: direction from the ground to the satellite.
        sigma_m: accuracy of its model on the Earth, each coordinate.
        slope: sigma of drifts and skews, pixels per pixel.
        sigma_px: of a measure of a point.
        pass_name: images of one name may share errors; "" shares none.
        is_ortho: an ortho-image, which tells no heights.
    """

    name: str
    lon_lat: tuple[float, float]
    size_m: tuple[float, float]
    gsd_m: float
    incidence_deg: float
    azimuth_deg: float
    sigma_m: float
    slope: float = 1e-4
    sigma_px: float = 0.2
    pass_name: str = ""
    is_ortho: bool = False


@dataclass(frozen=True)
class SiteSigmas:
    """What is known of the ground at a site, one standard deviation, horizontal and up.

    Attributes:
        points: number of them.
        sigma_m: of each point.
        frame_sigma_m: of the error that all points of the site share.
    """

    points: int = 5
    sigma_m: tuple[float, float] = (0.3, 0.3)
    frame_sigma_m: tuple[float, float] = (0.3, 0.3)


@dataclass(frozen=True)
class PlannedSite:
    """A site that is known, or may be."""

    name: str
    lon_lat: tuple[float, float]
    sigmas: SiteSigmas = SiteSigmas()


@dataclass(frozen=True)
class PlannedHeights:
    """Sigmas of an elevation model: of each height, and of all of them together."""

    sigma_m: float
    frame_sigma_m: float


@dataclass(frozen=True)
class BlockPlan:
    """A configuration.

    Attributes:
        images: two or more.
        spacing_m: of the points that images have in common.
        ground_m: height of the ground.
        sites: known ground.
        heights: of an elevation model at all points; None without one.
        candidates: places where a site may be added.
        added: sites that may be added, one after the other.
    """

    images: tuple[PlannedImage, ...]
    spacing_m: float
    ground_m: float = 0.0
    sites: tuple[PlannedSite, ...] = ()
    heights: PlannedHeights | None = None
    candidates: tuple[PlannedSite, ...] = ()
    added: int = 1


@dataclass(frozen=True)
class PlanGeometry:
    """The images, points and observations of a plan.

    Attributes:
        images: with what may move.
        lon_lat_h: (p, 3) the points: those of the ground, of the sites, and of the candidates.
        site: (p,) number of the site or, behind them, of the candidate; -1 for ground.
        observations: of all points.
        pass_members: masks of images that may share errors.
    """

    images: tuple[ImageParameters, ...]
    lon_lat_h: Array
    site: IntArray
    observations: Observations
    pass_members: tuple[BoolArray, ...]


def plan_geometry(plan: BlockPlan) -> PlanGeometry:
    """The images, points and observations of a plan.

    Raises:
        InputError: fewer than two images, two of one name, or too few or too many points.
    """
    names = [image.name for image in plan.images]
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"{len(names)} images with {len(set(names))} names, two or more with their own expected"
        )
    images = tuple(_image(image, plan.ground_m) for image in plan.images)
    ground = _ground(images, plan)
    if not _MIN_POINTS <= len(ground) <= _MAX_POINTS:
        raise InputError(
            f"{len(ground):,} points with a spacing of {plan.spacing_m:g} m, {_MIN_POINTS} to "
            f"{_MAX_POINTS:,} expected: state another `spacing_m`"
        )
    around = [_site_points(site, plan) for site in (*plan.sites, *plan.candidates)]
    lon_lat_h = np.concatenate([ground, *around])
    site = np.concatenate(
        [np.full(len(ground), -1)] + [np.full(len(a), k) for k, a in enumerate(around)]
    )
    everything = [np.ones(len(lon_lat_h), dtype=np.bool_)] * len(images)
    sigma_px = np.array([image.sigma_px for image in plan.images])
    observations = planned_observations(images, lon_lat_h, everything, sigma_px)
    of_pass = np.array([image.pass_name for image in plan.images])
    passes = [of_pass == name for name in np.unique(of_pass[of_pass != ""])]
    return PlanGeometry(
        images, lon_lat_h, site, observations, tuple(mask for mask in passes if mask.sum() > 1)
    )


def observed_and_known(
    plan: BlockPlan, geometry: PlanGeometry, known: Sequence[int]
) -> tuple[Observations, ControlGround]:
    """The observations of the ground and of some sites, and the known ground."""
    used = (geometry.site < 0) | np.isin(geometry.site, list(known))
    observations = geometry.observations.take(used[geometry.observations.point])
    sites = (*plan.sites, *plan.candidates)
    control = [_control(sites[k], np.flatnonzero(geometry.site == k), geometry) for k in known]
    if plan.heights is not None:
        point = np.unique(observations.point)
        flat = np.diag([np.inf, np.inf, plan.heights.sigma_m**2])
        control.append(
            ControlGround(
                point=point,
                lon_lat_h=geometry.lon_lat_h[point],
                covariance_m2=np.tile(flat, (len(point), 1, 1)),
                source=np.zeros(len(point), dtype=np.int64),
                frames=(Frame.from_sigmas(np.nan, plan.heights.frame_sigma_m),),
                names=tuple(f"height {k}" for k in point.tolist()),
            )
        )
    return observations, joined_ground(control)


def _image(image: PlannedImage, ground_m: float) -> ImageParameters:
    lines, samples = (max(2, round(size / image.gsd_m)) for size in image.size_m)
    model: SensorModel
    if image.is_ortho:
        model = _ortho(image, (lines, samples), ground_m)
    else:
        heights_m = ground_m - _HEIGHT_MARGIN_M, ground_m + _HEIGHT_MARGIN_M
        target = np.array([*image.lon_lat, ground_m])
        direction = image.incidence_deg, image.azimuth_deg
        model = pushbroom_over(target, (lines, samples), image.gsd_m, direction, heights_m)
    return image_parameters(
        image.name,
        model,
        (lines, samples),
        shift_px=image.sigma_m / image.gsd_m,
        slope_px=image.slope * max(lines, samples) / 2.0,
    )


def _ortho(image: PlannedImage, shape: tuple[int, int], ground_m: float) -> OrthoModel:
    """An ortho-image north up, whose terrain is displaced away from the satellite."""
    crs = utm_of(*image.lon_lat)
    step = np.array([[0.0, image.gsd_m], [-image.gsd_m, 0.0]])
    at_zero = MapGrid(crs, np.zeros(2), step, shape)
    middle = at_zero.xy(at_zero.line_sample(np.array([image.lon_lat])))[0]
    origin = middle - step @ ((np.array(shape) - 1.0) / 2.0)
    azimuth = np.radians(image.azimuth_deg)
    away = -np.tan(np.radians(image.incidence_deg)) * np.array([np.sin(azimuth), np.cos(azimuth)])
    per_metre = np.column_stack([away, np.zeros((2, 2))])
    displacement = ReliefDisplacement(partial(_level, ground_m), per_metre)
    return OrthoModel(MapGrid(crs, origin, step, shape), displacement=displacement)


def _level(height_m: float, lon_lat: Array) -> Array:
    return np.full(len(lon_lat), height_m)


def _ground(images: Sequence[ImageParameters], plan: BlockPlan) -> Array:
    """Points (n, 3) on a lattice that an image shows."""
    corners = []
    for image in images:
        line, sample = image.shape
        places = np.array([[0, 0], [0, sample], [line, sample], [line, 0]], dtype=np.float64)
        corners.append(image.model.locate(places, np.full(4, plan.ground_m)))
    outline = continuous(np.concatenate(corners)[:, :2])
    low, high = outline.min(axis=0), outline.max(axis=0)
    middle = np.array([[*(low + high) / 2.0, plan.ground_m]])
    step = plan.spacing_m / metres_per_degree_at(middle)[0]
    counts = np.ceil((high - low) / step)
    if counts.prod() > 100.0 * _MAX_POINTS:
        raise InputError(
            f"a spacing of {plan.spacing_m:g} m gives {counts.prod():,.0f} points, at most "
            f"{_MAX_POINTS:,} expected: state a larger `spacing_m`"
        )
    axes = [np.arange(low[k] + step[k] / 2.0, high[k], step[k]) for k in range(2)]
    lon_lat = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    lon_lat_h = np.column_stack([lon_lat, np.full(len(lon_lat), plan.ground_m)])
    shown = np.zeros(len(lon_lat_h), dtype=np.bool_)
    for image in images:
        position = image.model.project(lon_lat_h)
        shown |= ((position >= 0.0) & (position <= np.array(image.shape) - 1.0)).all(axis=1)
    return lon_lat_h[shown]


def _site_points(site: PlannedSite, plan: BlockPlan) -> Array:
    """The points (n, 3) of a site, on a circle."""
    turn = 2.0 * np.pi * np.arange(site.sigmas.points) / site.sigmas.points
    radius_m = _RADIUS * plan.spacing_m
    east_north = radius_m * np.column_stack([np.cos(turn), np.sin(turn)])
    enu = np.column_stack([east_north, np.zeros(len(turn))])
    return lon_lat_h_from_east_north_up(enu, np.array([*site.lon_lat, plan.ground_m]))


def _control(site: PlannedSite, point: IntArray, geometry: PlanGeometry) -> ControlGround:
    horizontal_m, up_m = site.sigmas.sigma_m
    own = np.diag([horizontal_m, horizontal_m, up_m]) ** 2
    return ControlGround(
        point=point,
        lon_lat_h=geometry.lon_lat_h[point],
        covariance_m2=np.tile(own, (len(point), 1, 1)),
        source=np.zeros(len(point), dtype=np.int64),
        frames=(Frame.from_sigmas(*site.sigmas.frame_sigma_m),),
        names=tuple(f"{site.name} {k + 1}" for k in range(len(point))),
    )
