"""A correction with a displacement beyond the affine one: universal kriging, with its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.misfit.displacement_components import Along, Component, with_components
from amers.services.misfit.structure import Residuals
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray

_MEDIAN_OF_LARGER = 1.0512
"""Median of the larger of two magnitudes of the standard normal law."""
_AS_BAD = 0.8
"""Share of the worst residual from which on measures are dropped with it."""
_OF_THE_AFFINE = 9
"""Places along each axis to which the affine part of a displacement is fitted."""
_NODES_A_PERIOD = 32
_NODES_A_LENGTH = 8
_NODES_A_GAP = 9
_FEWEST_NODES = 33
_NODES_OF_BROKEN = 513
"""Nodes along a broken image: parts that no point holds are uncertain by tens of pixels, and what the
affine parameters have of it is taken out of the variance of the others, quadratic between nodes."""
_MOST_NODES = 1025, 129
"""Along the lines, which shake, and along the samples."""
_MOST_NODES_OF_BOTH = 65
"""Along each axis, where a displacement depends on both."""
_WHERE: dict[Along, tuple[slice, slice]] = {
    "lines": (slice(None), slice(1)),
    "samples": (slice(1), slice(None)),
    "swath": (slice(None), slice(None)),
    "image": (slice(None), slice(None)),
}
"""Nodes that differ for components along the lines, along the samples, and along both."""


@dataclass(frozen=True)
class ProfileSolution:
    """A correction with a displacement beyond the affine one.

    Attributes:
        parameters: (2, k) of the design.
        covariance: (2, k, k) of them.
        displacement: on a grid.
    """

    parameters: Array
    covariance: Array
    displacement: DisplacementGrid


def agreeing_with(
    residuals: Residuals, components: Sequence[Component], expected: Array, tolerance: float
) -> BoolArray:
    """Measures (n,) that lie within a tolerance of what the others predict of them, one by one.

    Args:
        residuals: of all measures.
        components: of the profile.
        expected: (2, k) a priori weights of the parameters.
        tolerance: standard deviations.
    """
    full = with_components(residuals.regular, components)
    kept = np.arange(len(residuals.misfit))
    projection = _projection(full, expected)
    while len(kept) > residuals.design.shape[1] + 2:
        precision = np.maximum(np.diagonal(projection, axis1=1, axis2=2), 1e-12)
        rest = (projection @ full.misfit[kept].T[:, :, None])[..., 0]
        magnitude = np.abs(rest / np.sqrt(precision)).max(axis=0)
        worst = float(magnitude.max())
        if worst <= tolerance * max(float(np.median(magnitude)) / _MEDIAN_OF_LARGER, 1e-9):
            break
        # The worst spoils what is predicted of its neighbours; others as bad are wrong by themselves.
        stays = magnitude < _AS_BAD * worst
        kept, projection = kept[stays], _projection_without(projection, ~stays)
    agrees = np.zeros(len(residuals.misfit), dtype=bool)
    agrees[kept] = True
    return agrees


def _projection(full: Residuals, expected: Array) -> Array:
    """Weights (2, n, n) of measures in each coordinate, less what the parameters take up.

    Times the measures, over the roots of its diagonal, they are what the others leave, in sigmas.
    """
    inverse = np.linalg.inv(full.covariance)
    weighted = inverse @ full.design
    normal = full.design.T @ weighted + expected[:, :, None] * np.eye(expected.shape[1])
    inverse -= weighted @ np.linalg.pinv(normal, hermitian=True) @ np.swapaxes(weighted, 1, 2)
    return np.asarray(inverse)


def _projection_without(projection: Array, dropped: BoolArray) -> Array:
    """That of the measures that stay, by the Schur complement of those that are dropped."""
    rows = projection[:, ~dropped]
    among = np.linalg.pinv(projection[:, dropped][:, :, dropped], hermitian=True)
    across = rows[:, :, dropped]
    return np.asarray(rows[:, :, ~dropped] - across @ among @ np.swapaxes(across, 1, 2))


def solve_displacement(
    residuals: Residuals, components: Sequence[Component], expected: Array, shape: tuple[int, int]
) -> ProfileSolution:
    """Estimate and covariance of parameters and displacement.

    Args:
        residuals: of the active measures, with a covariance that includes all their errors.
        components: of the displacement.
        expected: (2, k) a priori weights of the parameters.
        shape: lines and samples of the image, which the nodes cover.
    """
    line, sample = _nodes(components, residuals, shape)
    places = _places(components, residuals, line, sample, shape)
    full = with_components(residuals, components)
    both = [_coordinate(k, full, components, expected[k], places) for k in range(2)]
    breaks = np.array([one.at_px + one.length_px / 2.0 for one in components if one.kind == "break"])
    displacement = np.stack([one.displacement for one in both], -1)
    variance = np.stack([one.variance for one in both], -1)
    return ProfileSolution(
        np.array([one.parameters for one in both]),
        np.array([one.covariance for one in both]),
        DisplacementGrid(line, sample, displacement, variance, breaks),
    )


@dataclass(frozen=True)
class _Places:
    """Where a displacement is computed: at its nodes, and at e places evenly over the image.

    Attributes:
        nodes: (l, m, 2) lines and samples.
        t: (l, m, 3) derivatives by the affine parameters at the nodes.
        t_evenly: (e, 3) those at the even places.
        seen: for each direction, covariance (2, l or 1, m or 1, n), by coordinate, of nodes and points.
        seen_evenly: (2, e, n) that of the even places.
        among_evenly: (e, e) of each component, correlation of the even places, over what chips see.
    """

    nodes: Array
    t: Array
    t_evenly: Array
    seen: list[Array]
    seen_evenly: Array
    among_evenly: list[Array]


def _places(
    components: Sequence[Component],
    residuals: Residuals,
    line: Array,
    sample: Array,
    shape: tuple[int, int],
) -> _Places:
    """The places of nodes at lines (l,) and samples (m,)."""
    nodes = np.stack(np.meshgrid(line, sample, indexing="ij"), axis=-1)
    frame = no_correction(shape)
    # What moves whole lines is the same at all nodes of a line: one column is enough.
    parts = [
        (nodes[_WHERE[along]], [one for one in components if one.along == along])
        for along in dict.fromkeys(one.along for one in components)
    ]
    axes = [np.linspace(nodes[0], nodes[-1], _OF_THE_AFFINE) for nodes in (line, sample)]
    evenly = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return _Places(
        nodes,
        by_affine(nodes, frame),
        by_affine(evenly, frame),
        [_seen(some, of_some, residuals.line_sample) for some, of_some in parts],
        _seen(evenly[None], components, residuals.line_sample)[:, 0],
        [one.correlation(evenly, evenly) / one.seen**2 for one in components],
    )


@dataclass(frozen=True)
class _Coordinate:
    """Lines or samples: parameters (k,) with covariance (k, k), displacement and variance (l, m)."""

    parameters: Array
    covariance: Array
    displacement: Array
    variance: Array


def _coordinate(
    k: int, full: Residuals, components: Sequence[Component], expected: Array, places: _Places
) -> _Coordinate:
    """The solution of one coordinate, by a priori weights (k,) of its parameters."""
    inverse = np.linalg.inv(full.covariance[k])
    weighted = inverse @ full.design
    normal = full.design.T @ weighted + np.diag(expected)
    own = np.asarray(np.linalg.pinv(normal, hermitian=True), np.float64)
    value = own @ (weighted.T @ full.misfit[:, k])
    rest = full.misfit[:, k] - full.design @ value
    seen, t = [both[k] for both in places.seen], places.t
    gain = [one @ inverse for one in seen]
    moved = sum(one @ full.design for one in gain)
    explained = sum(np.einsum("kmn,kmn->km", first, second) for first in gain for second in seen)
    unseen = sum(one.variance_px2[k] / one.seen**2 * one.share(places.nodes) for one in components)
    left = padded(t, len(own)) - moved
    total = unseen - explained + (left @ own * left).sum(axis=-1)
    mean = np.broadcast_to(sum(one @ rest for one in gain), t.shape[:2])
    # Its affine part belongs to the parameters: both are uncertain by much more than their sum.
    affine, uncertain = _affine_part(
        places,
        full,
        variances_px2=[one.variance_px2[k] for one in components],
        seen=places.seen_evenly[k],
        inverse=inverse,
        own=own,
        rest=rest,
    )
    value[:3] += affine
    own[:3, :3] = uncertain
    variance = np.maximum(total, 0.0) - (t @ uncertain * t).sum(axis=-1)
    return _Coordinate(value, own, mean - t @ affine, variance)


def _affine_part(
    places: _Places,
    full: Residuals,
    *,
    variances_px2: list[float],
    seen: Array,
    inverse: Array,
    own: Array,
    rest: Array,
) -> tuple[Array, Array]:
    """The affine part (3,) of the displacement of one coordinate, and the covariance (3, 3) of both.

    Args:
        places: of the displacement.
        full: the measures.
        variances_px2: of the components.
        seen: (e, n) covariance of the even places and the measures.
        inverse: (n, n) weights of the measures.
        own: (k, k) covariance of the parameters.
        rest: (n,) what the parameters leave of the measures.
    """
    fitted = np.linalg.pinv(places.t_evenly)
    gain = seen @ inverse
    left = padded(places.t_evenly, len(own)) - gain @ full.design
    pairs = zip(variances_px2, places.among_evenly, strict=True)
    among = sum(variance * shared for variance, shared in pairs)
    errors = among - gain @ seen.T + left @ own @ left.T
    return fitted @ gain @ rest, fitted @ errors @ fitted.T


def by_affine(places: Array, frame: ImageCorrection) -> Array:
    """Derivatives (..., 3) of a coordinate at places (..., 2) by the affine parameters."""
    return np.concatenate(
        [np.ones((*places.shape[:-1], 1)), (places - frame.centre) / frame.half_size], axis=-1
    )


def padded(t: Array, count: int) -> Array:
    """Derivatives (..., 3) by the affine parameters with zeros for the others of `count`."""
    return np.concatenate([t, np.zeros((*t.shape[:-1], count - 3))], axis=-1)


def _seen(places: Array, components: Sequence[Component], line_sample: Array) -> Array:
    """Covariance (2, k, m, n), by coordinate, of places (k, m, 2) and what chips show at points."""
    flat = places.reshape(-1, 2)
    total = sum(one.covariance(flat, line_sample) / one.seen for one in components)
    return np.asarray(total).reshape(2, *places.shape[:2], -1)


def joined(covariance: Array) -> Array:
    """Covariance (6, 6) of the parameters of line and sample, from those of each (2, k, k)."""
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = covariance[:, :3, :3]
    return both


def _nodes(
    components: Sequence[Component], residuals: Residuals, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Lines (k,) and samples (m,) of the nodes: close enough for short components, and at steps.

    They cover the places of the points and of the whole image, wherever the model expects it.
    """
    both = []
    for axis, most in enumerate(_MOST_NODES):
        place, moved = residuals.line_sample[:, axis], residuals.misfit[:, axis]
        last = shape[axis] - 1.0
        low = float(min(0.0, place.min(), -moved.max()))
        high = float(max(last, place.max(), last - moved.min()))
        along = [one for one in components if axis in range(2)[one.axes] or one.along == "swath"]
        if any(one.along == "image" for one in along):
            most = _MOST_NODES_OF_BOTH
        steps = [
            one.at_px / _NODES_A_PERIOD if one.kind == "period" else one.length_px / _NODES_A_LENGTH
            for one in along
            if not one.is_step and axis in range(2)[one.axes]
        ]
        gaps = [
            np.linspace(one.at_px, one.at_px + one.length_px, _NODES_A_GAP)
            for one in along
            if one.is_step
        ]
        spacing = min(steps, default=high - low)
        fewest = _NODES_OF_BROKEN if any(one.kind == "break" for one in along) else _FEWEST_NODES
        if any(one.is_seam for one in along):
            # Beyond the points, seams leave pixels open: see `_NODES_OF_BROKEN`.
            fewest = most
        count = int(np.clip((high - low) / spacing, fewest, most)) if along else 2
        both.append(np.unique(np.concatenate([np.linspace(low, high, count), *gaps])))
    return both[0], both[1]
