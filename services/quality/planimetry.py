"""Planimetric quality of a block: CE90 by site and kind of site, declared and measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from amers.services.quality.accuracy import Accuracy, NormalisedError, accuracy, normalised_error
from amers.services.quality.normal_law import normal_ce90
from amers.services.quality.site_errors import POINTS, SiteErrors
from amers.services.types import Array, Frame, IntArray

Source = Literal["points", "images"]
CHECK_ONLY, CONTROL = "check-only sites", "control sites"
_CHI_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))
"""Median length of a normal error of unit sigma a coordinate."""


@dataclass(frozen=True)
class ImageAtSite:
    """An image of the block at a site.

    Attributes:
        name: of the image.
        incidence_deg: at the middle of the site.
        accuracy: of its positions there.
    """

    name: str
    incidence_deg: float
    accuracy: Accuracy


@dataclass(frozen=True)
class SiteQuality:
    """The errors of a block at one site.

    Attributes:
        name: of the site.
        is_control: whether the production used it as control.
        lon, lat: the middle of the places found; null when there are none.
        tried: places that were searched.
        reach_m: largest error that the search could find.
        accuracy: of the places found.
        images: image by image; empty where points were compared.
        reasons: why places were not found, as text.
    """

    name: str
    is_control: bool
    lon: float
    lat: float
    tried: int
    reach_m: float
    accuracy: Accuracy
    images: tuple[ImageAtSite, ...]
    reasons: str


@dataclass(frozen=True)
class SiteGroup:
    """The errors of a block at several sites together.

    Attributes:
        name: "all sites", "check-only sites" or "control sites".
        sites: number of sites where something was found.
        accuracy: places of one site share errors, which the interval of CE90 takes into account.
    """

    name: str
    sites: int
    accuracy: Accuracy


@dataclass(frozen=True)
class PlanimetricQuality:
    """The planimetry of a block at sites with precise ortho-images.

    Attributes:
        source: "points" when the chips of the points were searched in the ortho-images, "images" when
            images of the block were.
        sites: each of them.
        groups: all sites, check-only sites, control sites; one group where there is only one kind.
        relative: all sites, without the median shift, which the block shares as an error of its frame.
        declared_ce90_m: of the median point, relative to the frame, with the measure; null for images.
        normalised: the errors without their mean, in units of what is declared for them; n is 0 for
            images.
        typical_ratio: the same without the influence of outliers, as a ratio: median length over that of
            a normal law.
        shift_east_m, shift_north_m: the median shift.
        normalised_frame: that shift in units of the declared frame of the block and of the ortho-images;
            n is 0 where the frame is not declared.
    """

    source: Source
    sites: tuple[SiteQuality, ...]
    groups: tuple[SiteGroup, ...]
    relative: Accuracy
    declared_ce90_m: float
    normalised: NormalisedError
    typical_ratio: float
    shift_east_m: float
    shift_north_m: float
    normalised_frame: NormalisedError


def planimetric_quality(
    errors: Sequence[SiteErrors], source: Source, frame: Frame
) -> PlanimetricQuality:
    """The planimetry of a block from its errors at sites.

    Args:
        errors: one or more for every site; those of one site have its name.
        source: what was compared.
        frame: of the block.
    """
    names = list(dict.fromkeys(one.name for one in errors))
    error_m = np.concatenate([one.error_m for one in errors])
    covariance_m2 = np.concatenate([one.covariance_m2 for one in errors])
    site = np.concatenate([np.full(len(one.error_m), names.index(one.name)) for one in errors])
    of_name = {name: [one for one in errors if one.name == name] for name in names}
    is_control = np.array([of_name[name][0].is_control for name in names])
    n = len(error_m)
    shift_m = np.median(error_m, axis=0) if n else np.full(2, np.nan)
    # A mean out of n errors takes a part of each: n - 1 are free.
    free = (error_m - error_m.mean(axis=0)) * np.sqrt(n / (n - 1.0)) if n > 1 else error_m[:0]
    known = np.isfinite(covariance_m2).all(axis=(1, 2))
    declared_m = normal_ce90(covariance_m2[known])
    of_sites = np.mean([of_name[name][0].frame_m2 for name in names], axis=0) / max(len(names), 1)
    frame_m2 = frame.covariance_m2[:2, :2] + of_sites
    return PlanimetricQuality(
        source=source,
        sites=tuple(_site_quality(of_name[name]) for name in names),
        groups=_groups(error_m, site, is_control),
        relative=accuracy(error_m - shift_m, site),
        declared_ce90_m=float(np.median(declared_m)) if len(declared_m) else float("nan"),
        normalised=normalised_error(free, covariance_m2[: len(free)]),
        typical_ratio=_typical_ratio(free, covariance_m2[: len(free)]),
        shift_east_m=float(shift_m[0]),
        shift_north_m=float(shift_m[1]),
        normalised_frame=normalised_error(shift_m[None], frame_m2[None]),
    )


def _site_quality(errors: Sequence[SiteErrors]) -> SiteQuality:
    error_m = np.concatenate([one.error_m for one in errors])
    lon_lat = np.concatenate([one.lon_lat for one in errors])
    middle = np.median(lon_lat, axis=0) if len(lon_lat) else np.full(2, np.nan)
    image = np.repeat(np.arange(len(errors)), [len(one.error_m) for one in errors])
    reasons: dict[str, int] = {}
    for one in errors:
        for reason, count in one.reasons:
            reasons[reason] = reasons.get(reason, 0) + count
    words = (f"{count} {reason}" for reason, count in sorted(reasons.items(), key=lambda r: -r[1]))
    return SiteQuality(
        name=errors[0].name,
        is_control=errors[0].is_control,
        lon=float(middle[0]),
        lat=float(middle[1]),
        tried=sum(one.tried for one in errors),
        reach_m=errors[0].reach_m,
        accuracy=accuracy(error_m, image),
        images=tuple(
            ImageAtSite(one.source, one.incidence_deg, accuracy(one.error_m))
            for one in errors
            if one.source != POINTS
        ),
        reasons=", ".join(words),
    )


def _groups(error_m: Array, site: IntArray, is_control: np.ndarray) -> tuple[SiteGroup, ...]:
    """All sites, named by their kind where there is only one; else also each kind."""

    def group(name: str, of_group: np.ndarray) -> SiteGroup:
        rows = of_group[site]
        return SiteGroup(name, len(np.unique(site[rows])), accuracy(error_m[rows], site[rows]))

    everything = np.ones(len(is_control), dtype=np.bool_)
    if is_control.all() or not is_control.any():
        return (group(CONTROL if is_control.all() else CHECK_ONLY, everything),)
    kinds = group(CHECK_ONLY, ~is_control), group(CONTROL, is_control)
    return group("all sites", everything), *kinds


def _typical_ratio(error_m: Array, covariance_m2: Array) -> float:
    """Median length of errors (n, 2) in units of their covariances, over that of a normal law."""
    known = np.isfinite(covariance_m2).all(axis=(1, 2))
    if not known.any():
        return float("nan")
    weighted = np.linalg.solve(covariance_m2[known], error_m[known][:, :, None])[:, :, 0]
    square = np.maximum((weighted * error_m[known]).sum(axis=1), 0.0)
    return float(np.median(np.sqrt(square))) / _CHI_MEDIAN
