"""Content of the report on the adjustment of a block: its images, its control, its points."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from amers.services.production.block_residuals import FITS, ImageFit, PointFits
from amers.services.production.image_production import Production
from amers.services.quality.accuracy_statement import AccuracyStatement, accuracy_document
from amers.services.quality.block import produced_accuracy
from amers.services.types import Array

FORMAT = "amers-adjustment/1"
ALL_FITS, LOOK_AT = "all fits", "look at"


@dataclass(frozen=True)
class ControlFit:
    """How one control point fits: its misfit, known minus adjusted, metres; NaN where not known."""

    name: str
    used: bool
    misfit_m: tuple[float, float, float]


@dataclass(frozen=True)
class AdjustmentReport:
    """The report on the adjustment of a block.

    Attributes:
        block: its id.
        accuracy: as stated everywhere.
        delivered_px, adjusted_px: median residual of the tie points, with the delivered models and with
            the adjusted ones.
        points_px: the same of the points, measured on chips.
        slope_factor: drifts and skews found over those expected.
        images: all of them.
        control: all that was found.
        lon_lat_h: (n, 3) the points.
        sigma_m: (n, 3) their standard deviations, in the frame of the block.
        points: how they fit.
        without_surface: number of points without a height of the surface, by the reason.
        finished_at: UTC.
        software_version: of Amers.
    """

    block: str
    accuracy: AccuracyStatement
    delivered_px: float
    adjusted_px: float
    points_px: float
    slope_factor: float
    images: tuple[ImageFit, ...]
    control: tuple[ControlFit, ...]
    lon_lat_h: Array
    sigma_m: Array
    points: PointFits
    without_surface: Mapping[str, int]
    finished_at: datetime
    software_version: str

    @property
    def odd_images(self) -> list[ImageFit]:
        """The images that somebody should look at."""
        return [image for image in self.images if image.verdict != FITS]

    @property
    def left_out(self) -> list[ControlFit]:
        """The control that contradicts the rest."""
        return [one for one in self.control if not one.used]

    @property
    def without_surface_words(self) -> str:
        """How many points have no height of the surface and why, as one line; "" where all have one."""
        return without_surface_words(self.without_surface, len(self.lon_lat_h))

    @property
    def verdict(self) -> str:
        """One of two words."""
        return LOOK_AT if self.odd_images or self.left_out else ALL_FITS

    @property
    def verdict_words(self) -> str:
        """What to look at, as a sentence."""
        odd, left_out = len(self.odd_images), len(self.left_out)
        if self.verdict == ALL_FITS:
            return "Every image fits" + (", and so does all control." if self.control else ".")
        parts = [f"{odd} of {len(self.images)} images should be looked at"] if odd else []
        parts += [f"{left_out} of {len(self.control)} control points contradict the rest"] * (
            left_out > 0
        )
        return f"{' and '.join(parts)}."

    def document(self) -> dict[str, Any]:
        """Members of the JSON document, without the points."""
        return {
            "format": FORMAT,
            "block": {"id": self.block},
            "verdict": self.verdict,
            "verdict_words": self.verdict_words,
            **accuracy_document(self.accuracy),
            "residuals_px": {
                "delivered": self.delivered_px,
                "adjusted": self.adjusted_px,
                "points": self.points_px,
            },
            "slope_factor": self.slope_factor,
            "images": self.images,
            "control": self.control,
            "points_without_surface": dict(self.without_surface),
            "finished_at": self.finished_at,
            "software_version": self.software_version,
        }


def without_surface_words(missing: Mapping[str, int], points: int) -> str:
    """How many of some points have no height of the surface and why, as one line; "" for none."""
    if not missing:
        return ""
    reasons = "; ".join(f"{reason}: {count:,}" for reason, count in missing.items())
    return f"{sum(missing.values()):,} of {points:,} have no height of the surface ({reasons})"


def adjustment_report(
    block: str, production: Production, *, finished_at: datetime, software_version: str
) -> AdjustmentReport:
    """The report on a production.

    Args:
        block: its id.
        production: of the block.
        finished_at: UTC.
        software_version: of Amers.
    """
    adjustment, relative = production.adjustment, production.relative_accuracy
    control = zip(
        production.control.names,
        adjustment.control_active.tolist(),
        adjustment.control_misfit_m.tolist(),
        strict=True,
    )
    return AdjustmentReport(
        block=block,
        accuracy=produced_accuracy(production.points),
        delivered_px=relative.before_px,
        adjusted_px=relative.after_px,
        points_px=relative.refined_px,
        slope_factor=adjustment.slope_factor,
        images=production.image_fits,
        control=tuple(ControlFit(name, used, (e, n, u)) for name, used, (e, n, u) in control),
        lon_lat_h=production.points.lon_lat_h,
        sigma_m=np.sqrt(np.diagonal(production.points.covariance_m2, 0, 1, 2)),
        points=production.point_fits,
        without_surface=production.without_surface,
        finished_at=finished_at,
        software_version=software_version,
    )


def points_csv(report: AdjustmentReport) -> str:
    """The points of the block, a line each, in the order of their ids."""
    lines = ["id,lon,lat,h_m,sigma_east_m,sigma_north_m,sigma_up_m,images,used,rms_px,largest_px"]
    fits = report.points
    for row, (lon, lat, h) in enumerate(report.lon_lat_h.tolist()):
        sigmas = ",".join(f"{value:.3f}" for value in report.sigma_m[row].tolist())
        residual = f"{fits.rms_px[row]:.3f},{fits.largest_px[row]:.3f}"
        counts = f"{fits.images[row]},{fits.used[row]}"
        lines.append(f"{row},{lon:.8f},{lat:.8f},{h:.3f},{sigmas},{counts},{residual}")
    return "\n".join(lines) + "\n"
