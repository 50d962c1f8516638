"""Content of the report on a plan: the accuracy of a block before it exists."""

from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from amers.services.production.block_plan import BlockPlan
from amers.services.production.planning import Accuracy90, Forecast

FORMAT = "amers-plan/1"
VERDICT = "predicted"


@dataclass(frozen=True)
class PlanReport:
    """The report on a plan.

    Attributes:
        name: of the plan.
        plan: the configuration.
        forecast: its accuracy.
        seconds: that the computation took.
        finished_at: UTC.
        software_version: of Amers.
    """

    name: str
    plan: BlockPlan
    forecast: Forecast
    seconds: float
    finished_at: datetime
    software_version: str

    @property
    def words(self) -> tuple[str, ...]:
        """The accuracy and the proposals as sentences."""
        found = self.forecast
        lines = [
            f"Relative to the control points: {accuracy_words(found.relative)}",
            f"On the Earth: {accuracy_words(found.on_the_earth)}",
        ]
        before = found.on_the_earth.ce90_m
        for one in found.proposed:
            lon, lat = one.site.lon_lat
            lines.append(
                f"Most help: {one.site.name} ({lon:.4f}, {lat:.4f}): mean CE90 on the Earth "
                f"{before:.2f} m to {one.on_the_earth.ce90_m:.2f} m, "
                f"LE90 {one.on_the_earth.le90_m:.2f} m"
            )
            before = one.on_the_earth.ce90_m
        return tuple(lines)


def accuracy_words(of: Accuracy90) -> str:
    """Both figures as text, mean and worst."""
    return (
        f"CE90 {of.ce90_m:.2f} m, LE90 {of.le90_m:.2f} m on average; "
        f"worst place {of.worst_ce90_m:.2f} m, {of.worst_le90_m:.2f} m"
    )


def plan_document(report: PlanReport) -> dict[str, Any]:
    """The report as JSON values, null where a figure is unknown."""
    found = report.forecast
    known = {
        "format": FORMAT,
        "block": {"id": report.name},
        "verdict": VERDICT,
        "plan": asdict(report.plan),
        "points": len(found.lon_lat),
        "groups": found.groups,
        "relative_to_control_points": asdict(found.relative),
        "on_the_earth": asdict(found.on_the_earth),
        "images": [asdict(image) for image in found.images],
        "proposed": [
            {
                "name": one.site.name,
                "lon_lat": list(one.site.lon_lat),
                "on_the_earth": asdict(one.on_the_earth),
                "gain_m": dict(
                    zip(
                        (site.name for site in report.plan.candidates),
                        one.gain_m.tolist(),
                        strict=True,
                    )
                ),
            }
            for one in found.proposed
        ],
        "seconds": report.seconds,
        "finished_at": report.finished_at.isoformat(),
        "software_version": report.software_version,
    }
    document: dict[str, Any] = _without_nan(known)
    return document


def points_csv(report: PlanReport) -> str:
    """The accuracy on the Earth of every point of the ground, as CSV."""
    found = report.forecast
    lines = ["lon,lat,ce90_m,le90_m"]
    rows = zip(found.lon_lat.tolist(), found.ce90_m.tolist(), found.le90_m.tolist(), strict=True)
    for (lon, lat), ce90_m, le90_m in rows:
        lines.append(f"{lon:.6f},{lat:.6f},{ce90_m:.3f},{le90_m:.3f}")
    return "\n".join(lines) + "\n"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return None if value != value else value
