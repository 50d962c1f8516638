"""Least-squares fit of a rational polynomial model to another sensor model."""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from amers.services.errors import CoverageError, FormatError
from amers.services.geodesy import longitudes_near
from amers.services.sensors.base import SensorModel
from amers.services.sensors.rpc import RpcModel, check_rpc, cubic_terms
from amers.services.types import Array

RIDGES = (1e-5, 1e-3, 1e-1)
"""Dampings of the coefficients relative to a misfit of one normalised unit, without which the 39
coefficients of a smooth model are not determined. Where a model is not smooth, a weak damping lets the
denominators vanish, and a stronger one fits better."""

CLOSE_ENOUGH_PX = 1e-3
"""A fit within this error is used without a search for a better one: a tenth of what a refined RPC may
differ from its model."""

_ITERATIONS = 8
_CONVERGED = 1e-9
"""Iterations end when no normalised coefficient changes by more than this."""
_GRIDS = ((8, 8, 4), (16, 16, 8))
"""Lines, samples and heights of the grids of points of a fit. The first one suffices for a smooth model;
256 points determine 39 coefficients."""
_MARGIN = 1.02
"""Extent of the grid of points, relative to the image."""
_CHECK_NODES = (37, 37, 7)
"""Lines, samples and heights of the grid of check points, most of them between the nodes."""
_CHECK_MARGIN = 0.98
"""Extent of the grid of check points, relative to the image."""


@dataclass(frozen=True)
class RpcFit:
    """A fitted RPC and its distance from the original model.

    Attributes:
        model: the rational polynomials.
        max_error_px, rms_error_px: distance in the image over a finer grid of check points, which the
            fit does not use; infinite where the RPC is undefined.
    """

    model: RpcModel
    max_error_px: float
    rms_error_px: float


def fit_rpc(model: SensorModel, shape: tuple[int, int], height_range_m: tuple[float, float]) -> RpcFit:
    """The RPC that fits a sensor model over an image and a range of heights.

    Each coordinate is a ratio with its own denominator. The ratio is multiplied out and solved by
    linear least squares. Each iteration is weighted by the denominator of the previous one and damped
    around its coefficients, so that the damping causes no bias. The first fit within `CLOSE_ENOUGH_PX`
    is returned: the grids of points and the dampings are tried in turn, the cheapest first. If none is
    that close, line and sample have the damping that is best for each: lines that shake need a strong
    one, which would take much from the samples of a narrow image. The closest is returned whose
    denominators do not vanish in its range; if all do, the closest.

    Source: Tao and Hu (2001), "A comprehensive study of the rational function model".

    Args:
        model: the model to fit.
        shape: lines and samples of the image.
        height_range_m: lowest and highest ground; also the height range of the RPC.

    Raises:
        CoverageError: the model cannot locate the whole image over the range of heights.
    """
    check_image, check_ground = _grid(model, shape, height_range_m, _CHECK_NODES, _CHECK_MARGIN)
    fits: list[RpcFit] = []
    for nodes in _GRIDS:
        image, ground = _grid(model, shape, height_range_m, nodes, _MARGIN)
        of_grid = []
        for ridge in RIDGES:
            fitted = _fit(image, ground, shape, height_range_m, ridge)
            off_px = np.nan_to_num(fitted.project(check_ground) - check_image, nan=np.inf)
            of_grid.append((fitted, off_px))
            alone = _judged(fitted, off_px)
            if alone.max_error_px < CLOSE_ENOUGH_PX:
                return alone
        for (lines, of_lines), (samples, of_samples) in itertools.product(of_grid, of_grid):
            both = replace(lines, sample_num=samples.sample_num, sample_den=samples.sample_den)
            fits.append(_judged(both, np.column_stack([of_lines[:, 0], of_samples[:, 1]])))
    closest = sorted(fits, key=lambda fit: fit.max_error_px)
    return next((fit for fit in closest if _is_usable(fit.model)), closest[0])


def _judged(model: RpcModel, off_px: Array) -> RpcFit:
    """A fitted RPC that is off by (n, 2) at the check points."""
    error_px = np.linalg.norm(off_px, axis=1)
    return RpcFit(model, float(error_px.max()), float(np.sqrt(np.mean(error_px**2))))


def _is_usable(model: RpcModel) -> bool:
    """Whether readers accept an RPC; its range has corners beyond a turned image, without any point."""
    try:
        check_rpc(model, "fit")
    except FormatError:
        return False
    return True


@dataclass(frozen=True)
class GroundFit:
    """The inverse of an RPC: from normalised (sample, line, height) to normalised longitude, latitude.

    Attributes:
        lon_num, lon_den, lat_num, lat_den: (20,) in the order of RPC00B, with sample instead of
            longitude and line instead of latitude; normalised by the offsets and scales of the RPC.
        max_error_px: largest distance in the image between a check position and the projection of its
            ground by the RPC; infinite where the ground is undefined.
    """

    lon_num: Array
    lon_den: Array
    lat_num: Array
    lat_den: Array
    max_error_px: float


def fit_to_ground(model: RpcModel) -> GroundFit:
    """The rational polynomials from the image to the ground that invert an RPC over its whole range.

    A DIMAP file contains them beside the RPC. They are fitted by the method of `fit_rpc` and checked
    between its nodes, and the first one within `CLOSE_ENOUGH_PX` is returned.

    Args:
        model: the RPC, whose offsets and scales also normalise the inverse.
    """
    check, _ = _normalised_pairs(model, _CHECK_NODES, _CHECK_MARGIN)
    fits = []
    for nodes in _GRIDS:
        positions, ground = _normalised_pairs(model, nodes, _MARGIN)
        terms = cubic_terms(positions)
        for ridge in RIDGES:
            lon_num, lon_den = _fit_ratio(terms, ground[:, 0], ridge)
            lat_num, lat_den = _fit_ratio(terms, ground[:, 1], ridge)
            fit = GroundFit(lon_num, lon_den, lat_num, lat_den, np.inf)
            fits.append(replace(fit, max_error_px=_inverse_error_px(model, fit, check)))
            if fits[-1].max_error_px < CLOSE_ENOUGH_PX:
                return fits[-1]
    return min(fits, key=lambda fit: fit.max_error_px)


def _inverse_error_px(model: RpcModel, fit: GroundFit, check: Array) -> float:
    """Largest distance of normalised positions (n, 3) from the projections of their ground."""
    if not len(check):
        return np.inf
    terms = cubic_terms(check)
    lon = terms @ fit.lon_num / (terms @ fit.lon_den)
    lat = terms @ fit.lat_num / (terms @ fit.lat_den)
    located = np.column_stack([lon, lat, check[:, 2]])
    projected_px = model.project(model.ground_offset + located * model.ground_scale)
    expected_px = model.image_offset + check[:, [1, 0]] * model.image_scale
    error_px = np.linalg.norm(projected_px - expected_px, axis=1)
    return float(np.nan_to_num(error_px, nan=np.inf).max())


def _normalised_pairs(
    model: RpcModel, nodes: tuple[int, int, int], extent: float
) -> tuple[Array, Array]:
    """Normalised (sample, line, height) over the range of an RPC, and their normalised ground.

    Positions whose ground is outside the range of the RPC are omitted.
    """
    line, sample, height = (
        axis.ravel() for axis in np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in nodes))
    )
    positions = np.column_stack([extent * sample, extent * line, min(extent, 1.0) * height])
    image = model.image_offset + positions[:, [1, 0]] * model.image_scale
    ground = model.locate(image, model.ground_offset[2] + positions[:, 2] * model.ground_scale[2])
    ground[:, 0] = longitudes_near(ground[:, 0], model.ground_offset[0])
    valid = np.isfinite(ground).all(axis=1)
    return positions[valid], ((ground - model.ground_offset) / model.ground_scale)[valid]


def _fit(
    image: Array,
    ground: Array,
    shape: tuple[int, int],
    height_range_m: tuple[float, float],
    ridge: float,
) -> RpcModel:
    """The RPC fitted to image positions (n, 2) of ground points (n, 3), line and sample separately."""
    size = np.array(shape, dtype=np.float64)
    image_offset, image_scale = (size - 1.0) / 2.0, size / 2.0
    lon = longitudes_near(ground[:, 0], ground[0, 0])
    low = np.array([lon.min(), ground[:, 1].min(), height_range_m[0]])
    high = np.array([lon.max(), ground[:, 1].max(), height_range_m[1]])
    ground_offset, ground_scale = (low + high) / 2.0, (high - low) / 2.0
    terms = cubic_terms((np.column_stack([lon, ground[:, 1:]]) - ground_offset) / ground_scale)
    normalised = (image - image_offset) / image_scale
    line_num, line_den = _fit_ratio(terms, normalised[:, 0], ridge)
    sample_num, sample_den = _fit_ratio(terms, normalised[:, 1], ridge)
    return RpcModel(
        line_num,
        line_den,
        sample_num,
        sample_den,
        image_offset,
        image_scale,
        ground_offset,
        ground_scale,
    )


def _grid(
    model: SensorModel,
    shape: tuple[int, int],
    height_range_m: tuple[float, float],
    nodes: tuple[int, int, int],
    extent: float,
) -> tuple[Array, Array]:
    """Image positions (n, 2) over an image scaled by `extent`, and their ground (n, 3)."""
    size = np.array(shape, dtype=np.float64)
    centre, half = (size - 1.0) / 2.0, extent * size / 2.0
    middle = sum(height_range_m) / 2.0
    half_height = min(extent, 1.0) * (height_range_m[1] - height_range_m[0]) / 2.0
    line, sample, height = np.meshgrid(
        centre[0] + half[0] * np.linspace(-1.0, 1.0, nodes[0]),
        centre[1] + half[1] * np.linspace(-1.0, 1.0, nodes[1]),
        middle + half_height * np.linspace(-1.0, 1.0, nodes[2]),
        indexing="ij",
    )
    image = np.column_stack([line.ravel(), sample.ravel()])
    ground = model.locate(image, height.ravel())
    undefined = int(np.isnan(ground).any(axis=1).sum())
    if undefined:
        raise CoverageError(
            f"the model locates only {len(image) - undefined} of {len(image)} positions over "
            f"{shape[0]} x {shape[1]} px and heights {height_range_m[0]:g} to {height_range_m[1]:g} m, "
            "all of them expected"
        )
    return image, ground


def _fit_ratio(terms: Array, value: Array, ridge: float) -> tuple[Array, Array]:
    """Numerator and denominator (20,) of one coordinate; the first term of the denominator is 1."""
    design = np.hstack([terms, -value[:, None] * terms[:, 1:]])
    coefficients = np.zeros(39)
    damping = ridge * np.sqrt(len(value)) * np.eye(39)
    for _ in range(_ITERATIONS):
        weight = 1.0 / (1.0 + terms[:, 1:] @ coefficients[20:])
        misfit = weight * (value - design @ coefficients)
        stacked = np.vstack([weight[:, None] * design, damping])
        step = np.linalg.lstsq(stacked, np.concatenate([misfit, np.zeros(39)]), rcond=None)[0]
        coefficients = coefficients + step
        if np.abs(step).max() < _CONVERGED:
            break
    return coefficients[:20], np.concatenate([[1.0], coefficients[20:]])
