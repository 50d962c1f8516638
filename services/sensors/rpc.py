"""The rational polynomial model: ground to image as ratios of cubic polynomials."""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from amers.services.errors import FormatError
from amers.services.geodesy import ecef_from_lon_lat_h, metres_per_degree
from amers.services.types import Array

VALIDITY = 2.0
"""Largest normalised ground coordinate: a model is used up to twice the range on which it was fitted.

There is no limit on image coordinates, because the image scale of some crops is that of the crop."""

_LOCATE_TOLERANCE_PX = 1e-7
_LOCATE_ITERATIONS = 20


@dataclass(frozen=True)
class RpcModel:
    """Ratios of cubic polynomials from ground to image.

    Source: NGA STDI-0002, RPC00B. Coefficients follow the order of the standard.

    Attributes:
        line_num, line_den, sample_num, sample_den: (20,) coefficients.
        image_offset, image_scale: (2,) line, sample in pixels.
        ground_offset, ground_scale: (3,) lon and lat in degrees, height in metres.
        error_bias_m, error_random_m: accuracy stated by the producer, NaN when unknown.
    """

    line_num: Array
    line_den: Array
    sample_num: Array
    sample_den: Array
    image_offset: Array
    image_scale: Array
    ground_offset: Array
    ground_scale: Array
    error_bias_m: float = math.nan
    error_random_m: float = math.nan

    @property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground the model was fitted on, metres above the ellipsoid."""
        centre, scale = float(self.ground_offset[2]), float(self.ground_scale[2])
        return centre - scale, centre + scale

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points.

        Args:
            lon_lat_h: (n, 3) degrees, degrees, metres.

        Returns:
            (n, 2) line, sample in pixels; NaN outside the model's range.
        """
        return _project(_packed(self), np.ascontiguousarray(lon_lat_h, dtype=np.float64))

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Analytic derivative of `project`.

        Returns:
            (n, 2, 3) pixels per metre east, north, up; NaN outside the model's range.
        """
        return _project_derivative(_packed(self), np.ascontiguousarray(lon_lat_h, dtype=np.float64))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights, by Newton steps until 1e-7 px.

        Args:
            line_sample: (n, 2) pixels.
            height_m: (n,) metres above the ellipsoid.

        Returns:
            (n, 3) lon, lat, height; NaN outside the model's range or where the iteration fails.
        """
        return _locate(
            _packed(self),
            np.ascontiguousarray(line_sample, dtype=np.float64),
            np.ascontiguousarray(height_m, dtype=np.float64),
        )

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Lines of sight as chords between the lowest and the highest height of the model.

        Returns:
            Origin (n, 3) ECEF metres, at the upper height, and unit direction (n, 3) downwards.
        """
        low, high = self.height_range_m
        height = np.ones(len(line_sample))
        top = ecef_from_lon_lat_h(self.locate(line_sample, high * height))
        bottom = ecef_from_lon_lat_h(self.locate(line_sample, low * height))
        direction = bottom - top
        return top, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def check_rpc(model: RpcModel, source: str) -> RpcModel:
    """The model itself, after a check that it is usable.

    Coefficients must be finite, scales positive, and denominators nonzero over the whole range;
    `locate` and `project` must reproduce a grid of image positions.

    Args:
        model: the RPC as read.
        source: name of its file, for messages.

    Raises:
        FormatError: the model is not usable; the message names the first reason.
    """
    numbers = np.concatenate(
        [
            model.line_num,
            model.line_den,
            model.sample_num,
            model.sample_den,
            model.image_offset,
            model.image_scale,
            model.ground_offset,
            model.ground_scale,
        ]
    )
    if not np.isfinite(numbers).all():
        raise FormatError(f"{source}: the RPC has numbers that are not finite")
    if (model.image_scale <= 0).any() or (model.ground_scale <= 0).any():
        raise FormatError(f"{source}: the RPC has a scale that is zero or negative")
    if abs(model.ground_offset[1]) > 90.0 or abs(model.ground_offset[0]) > 360.0:
        raise FormatError(
            f"{source}: the centre of the RPC is outside the Earth: longitude "
            f"{model.ground_offset[0]:g}, latitude {model.ground_offset[1]:g}"
        )
    axis = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    for name, den in (("line", model.line_den), ("sample", model.sample_den)):
        values = cubic_terms(grid) @ den
        if np.abs(values).min() < 1e-3 or (np.sign(values) != np.sign(values[0])).any():
            raise FormatError(
                f"{source}: the {name} denominator of the RPC vanishes within its own range"
            )
    image = model.image_offset + grid[:, :2] * model.image_scale
    height_m = model.ground_offset[2] + grid[:, 2] * model.ground_scale[2]
    misfit_px = np.abs(model.project(model.locate(image, height_m)) - image)
    if not (misfit_px < 1e-6).all():
        defined = misfit_px[np.isfinite(misfit_px)]
        worst_misfit = (
            f"the largest misfit is {defined.max():.3g} px"
            if len(defined)
            else "none of them is defined"
        )
        raise FormatError(
            f"{source}: the RPC cannot be inverted over its own range: "
            f"{int((~(misfit_px < 1e-6)).any(axis=1).sum())} of {len(grid)} grid points fail, "
            f"{worst_misfit}"
        )
    return model


def _packed(model: RpcModel) -> Array:
    """The model as one array for the kernels."""
    packed = np.empty(90)
    for k, (num, den) in enumerate(
        ((model.line_num, model.line_den), (model.sample_num, model.sample_den))
    ):
        packed[40 * k : 40 * k + 20] = num
        packed[40 * k + 20 : 40 * k + 40] = den
    packed[80:82] = model.image_offset
    packed[82:84] = model.image_scale
    packed[84:87] = model.ground_offset
    packed[87:90] = model.ground_scale
    return packed


def cubic_terms(normalised: Array) -> Array:
    """The 20 terms of RPC00B for normalised lon, lat, height (n, 3)."""
    lon, lat, h = normalised.T
    return np.column_stack(
        [
            np.ones_like(lon),
            lon,
            lat,
            h,
            lon * lat,
            lon * h,
            lat * h,
            lon * lon,
            lat * lat,
            h * h,
            lat * lon * h,
            lon**3,
            lon * lat * lat,
            lon * h * h,
            lon * lon * lat,
            lat**3,
            lat * h * h,
            lon * lon * h,
            lat * lat * h,
            h**3,
        ]
    )


@njit(inline="always", error_model="numpy")
def cubic(c: Array, o: int, x: float, y: float, z: float) -> float:
    """One polynomial in nested form: x lon, y lat, z height, coefficients from `c[o]` on."""
    return (
        c[o]
        + x
        * (
            c[o + 1]
            + x * (c[o + 7] + x * c[o + 11] + y * c[o + 14] + z * c[o + 17])
            + y * (c[o + 4] + y * c[o + 12] + z * c[o + 10])
            + z * (c[o + 5] + z * c[o + 13])
        )
        + y
        * (c[o + 2] + y * (c[o + 8] + y * c[o + 15] + z * c[o + 18]) + z * (c[o + 6] + z * c[o + 16]))
        + z * (c[o + 3] + z * (c[o + 9] + z * c[o + 19]))
    )


@njit(inline="always", error_model="numpy")
def _cubic_gradient(c: Array, o: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Derivatives of one polynomial by x, y, z."""
    dx = (
        c[o + 1]
        + x * (2.0 * c[o + 7] + 3.0 * x * c[o + 11] + 2.0 * y * c[o + 14] + 2.0 * z * c[o + 17])
        + y * (c[o + 4] + y * c[o + 12] + z * c[o + 10])
        + z * (c[o + 5] + z * c[o + 13])
    )
    dy = (
        c[o + 2]
        + y * (2.0 * c[o + 8] + 3.0 * y * c[o + 15] + 2.0 * z * c[o + 18] + 2.0 * x * c[o + 12])
        + x * (c[o + 4] + x * c[o + 14] + z * c[o + 10])
        + z * (c[o + 6] + z * c[o + 16])
    )
    dz = (
        c[o + 3]
        + z * (2.0 * c[o + 9] + 3.0 * z * c[o + 19] + 2.0 * x * c[o + 13] + 2.0 * y * c[o + 16])
        + x * (c[o + 5] + x * c[o + 17] + y * c[o + 10])
        + y * (c[o + 6] + y * c[o + 18])
    )
    return dx, dy, dz


@njit(inline="always")
def _normalised_lon(lon: float, offset: float, scale: float) -> float:
    """Normalised longitude, within 180 degrees of the offset."""
    d = lon - offset
    if d > 180.0:
        d -= 360.0
    elif d < -180.0:
        d += 360.0
    return d / scale


_FAST = {"contract", "arcp", "nsz", "reassoc"}
"""Optimisations that let the compiler vectorise a batch; NaN keeps its meaning."""

_BATCH = 256
"""Points that a kernel computes at once: their coordinates fit in the first-level cache."""


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project(packed: Array, ground: Array) -> Array:
    n = len(ground)
    out = np.empty((n, 2))
    c = packed.copy()
    x = np.empty(_BATCH)
    y = np.empty(_BATCH)
    z = np.empty(_BATCH)
    line = np.empty(_BATCH)
    sample = np.empty(_BATCH)
    per_lon, per_lat, per_h = 1.0 / c[87], 1.0 / c[88], 1.0 / c[89]
    for first in range(0, n, _BATCH):
        size = min(_BATCH, n - first)
        for i in range(size):
            d = ground[first + i, 0] - c[84]
            d -= 360.0 if d > 180.0 else (-360.0 if d < -180.0 else 0.0)
            x[i] = d * per_lon
            y[i] = (ground[first + i, 1] - c[85]) * per_lat
            z[i] = (ground[first + i, 2] - c[86]) * per_h
        for i in range(size):
            line[i] = cubic(c, 0, x[i], y[i], z[i]) / cubic(c, 20, x[i], y[i], z[i])
        for i in range(size):
            sample[i] = cubic(c, 40, x[i], y[i], z[i]) / cubic(c, 60, x[i], y[i], z[i])
        for i in range(size):
            inside = abs(x[i]) <= VALIDITY and abs(y[i]) <= VALIDITY and abs(z[i]) <= VALIDITY
            out[first + i, 0] = line[i] * c[82] + c[80] if inside else np.nan
            out[first + i, 1] = sample[i] * c[83] + c[81] if inside else np.nan
    return out


@njit(inline="always", error_model="numpy")
def _value_and_gradient(
    c: Array, o: int, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Value of one normalised ratio, and its derivatives by x, y, z."""
    num = cubic(c, o, x, y, z)
    den = cubic(c, o + 20, x, y, z)
    nx, ny, nz = _cubic_gradient(c, o, x, y, z)
    dx, dy, dz = _cubic_gradient(c, o + 20, x, y, z)
    inverse = 1.0 / den
    value = num * inverse
    return (
        value,
        (nx - value * dx) * inverse,
        (ny - value * dy) * inverse,
        (nz - value * dz) * inverse,
    )


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project_derivative(packed: Array, ground: Array) -> Array:
    n = len(ground)
    out = np.empty((n, 2, 3))
    c = packed.copy()
    x = np.empty(_BATCH)
    y = np.empty(_BATCH)
    z = np.empty(_BATCH)
    gradient = np.empty((3, _BATCH))
    for first in range(0, n, _BATCH):
        size = min(_BATCH, n - first)
        for i in range(size):
            x[i] = _normalised_lon(ground[first + i, 0], c[84], c[87])
            y[i] = (ground[first + i, 1] - c[85]) / c[88]
            z[i] = (ground[first + i, 2] - c[86]) / c[89]
        for k in range(2):
            for i in range(size):
                _, gx, gy, gz = _value_and_gradient(c, 40 * k, x[i], y[i], z[i])
                gradient[0, i] = c[82 + k] / c[87] * gx
                gradient[1, i] = c[82 + k] / c[88] * gy
                gradient[2, i] = c[82 + k] / c[89] * gz
            for i in range(size):
                inside = abs(x[i]) <= VALIDITY and abs(y[i]) <= VALIDITY and abs(z[i]) <= VALIDITY
                for axis in range(3):
                    out[first + i, k, axis] = gradient[axis, i] if inside else np.nan
        for i in range(size):
            east, north = metres_per_degree(ground[first + i, 1], ground[first + i, 2])
            for k in range(2):
                out[first + i, k, 0] /= east
                out[first + i, k, 1] /= north
    return out


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _newton_step(  # noqa: PLR0917 - tuples of arrays are compiled to other roundings
    c: Array, u: Array, v: Array, z: Array, x: Array, y: Array, miss: Array, size: int
) -> int:
    """Move the ground positions of a batch by one step; returns the number that had not converged.

    All coordinates are normalised. Positions that leave the range become NaN. `miss` becomes the
    distance before the step, 1 at the tolerance.
    """
    per_line = c[82] / _LOCATE_TOLERANCE_PX
    per_sample = c[83] / _LOCATE_TOLERANCE_PX
    moving = 0
    for i in range(size):
        line, lx, ly, _lz = _value_and_gradient(c, 0, x[i], y[i], z[i])
        sample, sx, sy, _sz = _value_and_gradient(c, 40, x[i], y[i], z[i])
        du = u[i] - line
        dv = v[i] - sample
        inverse = 1.0 / (lx * sy - ly * sx)
        moved_x = x[i] + (du * sy - dv * ly) * inverse
        moved_y = y[i] + (dv * lx - du * sx) * inverse
        inside = abs(moved_x) <= 2.0 * VALIDITY and abs(moved_y) <= 2.0 * VALIDITY
        x[i] = moved_x if inside else np.nan
        y[i] = moved_y
        miss[i] = max(abs(du) * per_line, abs(dv) * per_sample)
        moving += 1 if inside and miss[i] > 1.0 else 0
    return moving


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _locate(packed: Array, image: Array, height: Array) -> Array:
    n = len(image)
    out = np.empty((n, 3))
    c = packed.copy()
    u = np.empty(_BATCH)
    v = np.empty(_BATCH)
    z = np.empty(_BATCH)
    x = np.empty(_BATCH)
    y = np.empty(_BATCH)
    miss = np.empty(_BATCH)
    for first in range(0, n, _BATCH):
        size = min(_BATCH, n - first)
        for i in range(size):
            u[i] = (image[first + i, 0] - c[80]) / c[82]
            v[i] = (image[first + i, 1] - c[81]) / c[83]
            normalised = (height[first + i] - c[86]) / c[89]
            z[i] = normalised if abs(normalised) <= VALIDITY else np.nan
        x[:size] = 0.0
        y[:size] = 0.0
        for _ in range(_LOCATE_ITERATIONS):
            if _newton_step(c, u, v, z, x, y, miss, size) == 0:
                break
        for i in range(size):
            located = abs(x[i]) <= VALIDITY and abs(y[i]) <= VALIDITY and miss[i] <= 1.0
            lon = c[84] + x[i] * c[87]
            lon -= 360.0 if lon > 180.0 else (-360.0 if lon < -180.0 else 0.0)
            out[first + i, 0] = lon if located else np.nan
            out[first + i, 1] = c[85] + y[i] * c[88] if located else np.nan
            out[first + i, 2] = height[first + i] if located else np.nan
    return out
