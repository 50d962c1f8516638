"""Control from ortho-images: horizontal positions of image details in the ortho-images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.conventions import CHIP_SIZE, MAX_ERROR_SIGMAS
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import image_gsd_m, render_chip
from amers.services.matching.correlate import FOUND, find_chip
from amers.services.matching.multi_image import (
    RefinementOptions,
    chip_inside,
    reference_chip,
    seen_whole,
)
from amers.services.matching.reference_image import Reference
from amers.services.production.ground_parts import image_parts
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, BoolArray, Frame, Progress, no_progress

_SEARCH = RefinementOptions()
_FIRST_REACH_PX = 60
"""Largest search radius for the shift of a block; chips are made coarser for a larger one."""
_SAMPLE = 60
"""Points that show this shift."""
_CONSENSUS_PX = 2.0
"""Displacements this close to each other agree."""
_MIN_FOUND = 6
"""Fewest points that agree on the shift."""


@dataclass(frozen=True)
class ControlOrtho:
    """An ortho-image that places a block.

    Attributes:
        name: for messages and reports.
        reference: its pixels and its accuracy; the terrain is not used.
    """

    name: str
    reference: Reference


@dataclass(frozen=True)
class OrthoSearch:
    """An ortho-image, and how it is searched.

    Attributes:
        name: of the results.
        reference: the ortho-image.
        gsd_m: ground sampling of the chips, metres.
        radius_px: search radius, chip pixels.
        shift_m: (2,) east, north, where the search begins.
    """

    name: str
    reference: Reference
    gsd_m: float
    radius_px: int
    shift_m: Array

    def inside(self, lon_lat_h: Array) -> BoolArray:
        """Which points (n, 3) can be searched on the ortho-image."""
        shape = self.reference.image.shape
        return chip_inside(self.reference.model, shape, lon_lat_h, self.gsd_m, self.radius_px)


def known_on_ortho(
    scenes: Sequence[Scene],
    frame: Frame,
    lon_lat_h: Array,
    ortho: ControlOrtho,
    *,
    gsd_m: float,
    name: str,
    work: Work,
    progress: Progress,
) -> ControlGround:
    """The points of a block that an ortho-image shows, with their positions on it; heights are unknown.

    A chip of the images is searched on the ortho-image at the place of the point: first those of some
    points within three standard deviations of both frames, which show the shift, then all around it.

    Args:
        scenes: with models that agree.
        frame: of the scenes on the Earth.
        lon_lat_h: (n, 3) the points, those near each other following each other.
        ortho: that is searched.
        gsd_m: ground sampling of the finest chips, metres.
        name: of the results of the search.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Raises:
        NotEnoughPoints: too few points lie on the ortho-image, or agree there.
    """
    reference = ortho.reference
    gsd_m = max(gsd_m, image_gsd_m(reference.model, lon_lat_h[0]))
    shift_m = _shift(scenes, frame, lon_lat_h, ortho, gsd_m=gsd_m, name=name, work=work)
    search = OrthoSearch(f"{name}-all", reference, gsd_m, _SEARCH.radius_px, shift_m)
    found = _found(scenes, lon_lat_h, search, work, progress)
    step_m = np.column_stack([found["displacement_m"], np.zeros(len(found["row"]))])
    place = move_metres(lon_lat_h[found["row"]], step_m)
    variance_m2 = found["sigma_m"] ** 2 + reference.sigma_m**2
    covariance_m2 = variance_m2[:, None, None] * np.eye(3)
    covariance_m2[:, 2, 2] = np.inf
    common_m2 = reference.common_sigma_m**2 * np.diag([1.0, 1.0, 0.0])
    return ControlGround(
        point=found["row"],
        lon_lat_h=place,
        covariance_m2=covariance_m2,
        source=np.zeros(len(place), dtype=np.int64),
        frames=(Frame(reference.frame.covariance_m2 + common_m2),),
        names=place_names(ortho.name, place),
    )


def place_names(source: str, lon_lat_h: Array) -> tuple[str, ...]:
    """Names of points of a source by their places (n, 3)."""
    return tuple(f"{source}:{lon:.5f},{lat:.5f}" for lon, lat, _ in lon_lat_h.tolist())


def _shift(
    scenes: Sequence[Scene],
    frame: Frame,
    lon_lat_h: Array,
    ortho: ControlOrtho,
    *,
    gsd_m: float,
    name: str,
    work: Work,
) -> Array:
    """Displacement (2,) of the block on the ortho-image, within three standard deviations of both."""
    reach_m = MAX_ERROR_SIGMAS * math.hypot(frame.sigma_m, ortho.reference.frame.sigma_m)
    coarse_m = max(gsd_m, reach_m / _FIRST_REACH_PX)
    radius_px = math.ceil(reach_m / coarse_m) + _SEARCH.radius_px
    search = OrthoSearch(f"{name}-shift", ortho.reference, coarse_m, radius_px, np.zeros(2))
    rows = np.flatnonzero(search.inside(lon_lat_h))
    sample = rows[np.linspace(0, len(rows) - 1, min(_SAMPLE, len(rows))).astype(np.int64)]
    found_m = np.empty((0, 2))
    if len(sample):
        found_m = _found(scenes, lon_lat_h[sample], search, work, no_progress)["displacement_m"]
    distance_m = np.linalg.norm(found_m[:, None] - found_m[None, :], axis=2)
    agreeing = distance_m <= _CONSENSUS_PX * coarse_m
    count = agreeing.sum(axis=1)
    if count.max(initial=0) < max(_MIN_FOUND, len(found_m) / 2.0):
        raise NotEnoughPoints(
            int(count.max(initial=0)),
            _MIN_FOUND,
            f"points that agree on a shift of at most {reach_m:.3g} m, of {len(sample)} tried on the "
            f"ortho-image {ortho.name}: it shows other ground, looks too different, or lies farther off "
            "than its accuracy and that of the images state; state another accuracy "
            "(--control-ortho-sigma-m, --sigma-m), or leave it out",
        )
    return np.asarray(found_m[agreeing[np.argmax(count)]].mean(axis=0))


def _found(
    scenes: Sequence[Scene], lon_lat_h: Array, search: OrthoSearch, work: Work, progress: Progress
) -> Arrays:
    """The points that are found: rows (m,), displacements (m, 2) east, north, and sigmas (m,)."""
    parts, images = image_parts(scenes, lon_lat_h)

    def arguments(number: int) -> tuple[Any, ...]:
        return [scenes[i] for i in images[number]], lon_lat_h[parts[number]], search

    names = [f"{search.name}-{number:06d}" for number in range(len(parts))]
    work.run(ortho_task, [(name, partial(arguments, i)) for i, name in enumerate(names)], progress)
    found = [work.kept[name] for name in names]
    rows = [part.start + one["row"] for part, one in zip(parts, found, strict=True)]
    return {
        "row": np.concatenate(rows),
        "displacement_m": np.concatenate([one["displacement_m"] for one in found]),
        "sigma_m": np.concatenate([one["sigma_m"] for one in found]),
    }


def ortho_task(scenes: Sequence[Scene], lon_lat_h: Array, search: OrthoSearch) -> Arrays:
    """The points of one part that an ortho-image shows around the shift of its search."""
    at = move_metres(lon_lat_h, np.tile([*search.shift_m, 0.0], (len(lon_lat_h), 1)))
    seen_by = seen_whole(scenes, lon_lat_h, search.gsd_m)
    reference, gsd_m = search.reference, search.gsd_m
    row, displacement_m, sigma_m = [], [], []
    for i in np.flatnonzero(search.inside(at)).tolist():
        if not seen_by[i]:
            continue
        _, chip = reference_chip(scenes, seen_by[i], lon_lat_h[i], gsd_m)
        size = CHIP_SIZE + 2 * search.radius_px
        patch = render_chip(reference.image, reference.model, at[i], gsd_m, size)
        peak = find_chip(patch, chip, _SEARCH.correlation)
        if peak.reason == FOUND:
            row.append(i)
            displacement_m.append(search.shift_m + peak.row_col[::-1] * [gsd_m, -gsd_m])
            sigma_m.append(max(peak.sigma_px, _SEARCH.min_sigma_px) * gsd_m)
    return {
        "row": np.array(row, dtype=np.int64),
        "displacement_m": np.array(displacement_m).reshape(-1, 2),
        "sigma_m": np.array(sigma_m),
    }
