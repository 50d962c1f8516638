"""The correction of a sensor model as a JSON document; every registration writes it.

With `t = ((line, sample) - centre) / half_size`, a position of the delivered model moves by
`parameters (1, t_line, t_sample)`, and by a displacement on a grid where there is one: bilinear between
nodes, constant beyond them. It jumps at the lines `breaks`, where lines of the image were lost or
repeated. The centre of the first pixel is (0, 0).
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.text_files import load_json
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, Frame

CORRECTION_FORMAT = "amers-image-correction/1"
PROFILE_FORMAT = "amers-image-correction/2"
"""Of a correction by line, as it was written before grids were; it is read only."""
GRID_FORMAT = "amers-image-correction/3"
"""Of a correction on a grid: a reader that does not know it must not take the affine part alone."""
OF_RIGOROUS = "rigorous model"
"""How `applies_to` begins for the correction of an adjusted rigorous model."""

_PROFILE = {
    "displacement_px": (2,),
    "variance_px2": (2,),
    "with_parameters_px2": (2, 3),
}
"""Attributes of a profile, and the shape of each for a node."""

_SMALLEST_RING = 4
"""Positions of a closed ring, the last of which is the first."""
_DECIMALS, _HELD_DECIMALS = 6, 1
"""Of the values at the nodes of a grid, and of an outline."""


def format_correction(
    stated: CorrectionAccuracy,
    order: str,
    *,
    applies_to: str,
    carried: str,
    held: Sequence[Array] | None = None,
) -> str:
    """The JSON document of a correction.

    Args:
        stated: the correction, from positions of the delivered model to true ones, and its accuracy.
        order: "shift", "drift" or "affine".
        applies_to: one sentence on the origin of the delivered model.
        carried: one sentence on the files that contain the correction, and their accuracy.
        held: rings (n, 2) of line and sample of the area for which accuracy is stated, holes after the
            rings around them; None where it is not known.
    """
    correction = stated.correction
    grid = correction.displacement
    document: dict[str, Any] = {
        "format": GRID_FORMAT if grid else CORRECTION_FORMAT,
        "applies_to": applies_to,
        "carried": carried,
        "pixel_origin": "the centre of the first pixel is line 0, sample 0",
        "formula": "(line, sample) + parameters_px (1, t_line, t_sample)"
        + (" + displacement.displacement_px at (line, sample), bilinear" if grid else "")
        + ", t = ((line, sample) - centre_px) / half_size_px",
        "order": order,
        "parameters_px": correction.parameters.tolist(),
        "centre_px": correction.centre.tolist(),
        "half_size_px": correction.half_size.tolist(),
        "covariance_px2": _rows(stated.covariance_px2),
        "local_sigma_px": stated.local_sigma_px.tolist(),
        "frame_covariance_m2": _rows(stated.frame.covariance_m2),
        "apart_px": stated.apart_px,
    }
    if grid is not None:
        document["displacement"] = {
            "line": grid.line.tolist(),
            "sample": grid.sample.tolist(),
            "displacement_px": grid.displacement_px.round(_DECIMALS).tolist(),
            "variance_px2": grid.variance_px2.round(_DECIMALS).tolist(),
            "position_variance_px2": _at_nodes(stated, grid),
            "breaks": grid.breaks.tolist(),
        }
    if held is not None:
        document["held_outline_px"] = [ring.round(_HELD_DECIMALS).tolist() for ring in held]
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _at_nodes(stated: CorrectionAccuracy, grid: DisplacementGrid) -> list[Any]:
    """Variance of a corrected position, line and sample, at each node: of all its errors together.

    What the displacement adds to the variance of the parameters may be negative: both err together.
    """
    nodes = np.stack(np.meshgrid(grid.line, grid.sample, indexing="ij"), axis=-1)
    covariance = stated.relative_px2(stated.correction.apply(nodes.reshape(-1, 2)))
    variance = np.diagonal(covariance, axis1=1, axis2=2).round(_DECIMALS)
    known = [[v if math.isfinite(v) else None for v in both] for both in variance.tolist()]
    columns = len(grid.sample)
    return [known[first : first + columns] for first in range(0, len(known), columns)]


def parse_correction(text: str, source: str = "correction") -> ImageCorrection:
    """The correction of a JSON document.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the document has another form, or its correction folds or mirrors the image.
    """
    document = load_json(text, source)
    formats = (CORRECTION_FORMAT, PROFILE_FORMAT, GRID_FORMAT)
    if not isinstance(document, dict) or document.get("format") not in formats:
        raise FormatError(f"{source}: expected a document of the format {' or '.join(formats)}")
    correction = ImageCorrection(
        parameters=_numbers(document, "parameters_px", (2, 3), source),
        centre=_numbers(document, "centre_px", (2,), source),
        half_size=_numbers(document, "half_size_px", (2,), source),
    )
    if not (correction.half_size > 0.0).all():
        raise FormatError(f"{source}: half_size_px: expected positive numbers")
    if not np.linalg.det(correction.jacobian) > 0.0:
        raise FormatError(
            f"{source}: parameters_px: expected a correction that neither folds nor mirrors the image"
        )
    if document["format"] == GRID_FORMAT:
        return replace(correction, displacement=_grid(document, source))
    if document["format"] == PROFILE_FORMAT:
        return replace(correction, displacement=_profile(document, correction, source))
    return correction


def is_of_rigorous(text: str, source: str = "correction") -> bool:
    """Whether the correction of a document applies to a rigorous model, not to the delivered RPC."""
    document = load_json(text, source)
    return isinstance(document, dict) and str(document.get("applies_to")).startswith(OF_RIGOROUS)


def parse_correction_accuracy(text: str, source: str = "correction") -> CorrectionAccuracy:
    """The correction of a JSON document with the covariance of its errors.

    The frame is unknown in documents that were written before it was stated.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: as `parse_correction`, or a covariance has another form.
    """
    correction = parse_correction(text, source)
    document = load_json(text, source)
    apart_px = document.get("apart_px", 0.0)
    if not isinstance(apart_px, int | float) or not 0.0 <= apart_px < math.inf:
        raise FormatError(f"{source}: apart_px: expected a number that is not negative")
    return CorrectionAccuracy(
        correction,
        _covariance(document, "covariance_px2", 6, source),
        _numbers(document, "local_sigma_px", (2,), source),
        Frame(_covariance(document, "frame_covariance_m2", 3, source)),
        float(apart_px),
        _held(document, source),
    )


def _held(document: dict[str, Any], source: str) -> tuple[Array, ...] | None:
    """The rings of the area for which accuracy is stated; None in documents without it."""
    rings = document.get("held_outline_px")
    if rings is None:
        return None
    place = f"{source}: held_outline_px"
    if not isinstance(rings, list) or not all(isinstance(ring, list) for ring in rings):
        raise FormatError(f"{place}: expected a list of rings of line and sample")
    out = tuple(_numbers({"ring": ring}, "ring", (len(ring), 2), place) for ring in rings)
    if any(len(ring) < _SMALLEST_RING for ring in out):
        raise FormatError(f"{place}: expected rings of {_SMALLEST_RING} positions or more")
    return out


def _grid(document: dict[str, Any], source: str) -> DisplacementGrid:
    """The displacement of a document."""
    grid, place = document.get("displacement"), f"{source}: displacement"
    if not isinstance(grid, dict):
        raise FormatError(f"{place}: expected an object with nodes and their displacements")
    nodes = [_ascending(grid, name, place) for name in ("line", "sample")]
    shape = (len(nodes[0]), len(nodes[1]), 2)
    values = [_numbers(grid, name, shape, place) for name in ("displacement_px", "variance_px2")]
    jumps = grid.get("breaks", [])
    count = len(jumps) if isinstance(jumps, list) else 0
    breaks = _numbers({"breaks": jumps}, "breaks", (count,), place)
    return DisplacementGrid(nodes[0], nodes[1], values[0], values[1], breaks)


def _ascending(nodes: dict[str, Any], name: str, source: str) -> Array:
    """Two ascending numbers or more."""
    values = nodes.get(name)
    places = _numbers(nodes, name, (len(values) if isinstance(values, list) else 2,), source)
    if len(places) < 2 or not (np.diff(places) > 0.0).all():
        raise FormatError(f"{source}: {name}: expected two ascending numbers or more")
    return places


def _profile(document: dict[str, Any], correction: ImageCorrection, source: str) -> DisplacementGrid:
    """The profile of a document: its variance is linear between the edges of the image."""
    nodes = document.get("profile")
    if not isinstance(nodes, dict) or not isinstance(nodes.get("line"), list):
        raise FormatError(
            f"{source}: profile: expected an object with the lists line, {', '.join(_PROFILE)}"
        )
    line = _ascending(nodes, "line", f"{source}: profile")
    values = {
        name: _numbers(nodes, name, (len(line), *shape), f"{source}: profile")
        for name, shape in _PROFILE.items()
    }
    if (values["variance_px2"] < 0.0).any():
        raise FormatError(f"{source}: profile: variance_px2: expected numbers that are not negative")
    sample = correction.centre[1] + correction.half_size[1] * np.array([-1.0, 1.0])
    t = np.ones((len(line), 2, 3))
    t[:, :, 1] = (line[:, None] - correction.centre[0]) / correction.half_size[0]
    t[:, :, 2] = [-1.0, 1.0]
    shared = 2.0 * np.einsum("kcp,kmp->kmc", values["with_parameters_px2"], t)
    displacement_px = np.repeat(values["displacement_px"][:, None], 2, axis=1)
    return DisplacementGrid(line, sample, displacement_px, values["variance_px2"][:, None] + shared)


def _rows(covariance: Array) -> list[list[float | None]]:
    """The rows of a matrix, null where it is unknown."""
    return [[v if math.isfinite(v) else None for v in row] for row in covariance.tolist()]


def _covariance(document: dict[str, Any], name: str, size: int, source: str) -> Array:
    """A covariance matrix; NaN where it is null, all of it where it is missing."""
    rows = document.get(name, [[None] * size] * size)
    try:
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (size, size) or np.isinf(values).any():
        raise FormatError(f"{source}: {name}: expected {size} x {size} numbers or nulls")
    known = np.nan_to_num(values)
    if not np.allclose(known, known.T) or (np.linalg.eigvalsh(known) < -1e-9).any():
        raise FormatError(f"{source}: {name}: expected a covariance matrix")
    return values


def _numbers(document: dict[str, Any], name: str, shape: tuple[int, ...], source: str) -> Array:
    try:
        values = np.array(document.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != shape or not np.isfinite(values).all():
        expected = " x ".join(map(str, shape))
        raise FormatError(f"{source}: {name}: expected {expected} finite numbers")
    return values
