"""Content of the report on a plan: the accuracy of a block before it exists."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from amers.services.production.block_plan import BlockPlan
from amers.services.production.cost import ProductionCost, production_cost
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
    def cost(self) -> ProductionCost:
        """Of a block with a point in each square of the plan's spacing."""
        spacing_m = self.plan.spacing_m
        area_km2 = len(self.forecast.lon_lat) * spacing_m**2 / 1e6
        return production_cost(self.plan.images, area_km2, spacing_m)

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
        return (*lines, self.cost.words)

    def document(self) -> dict[str, Any]:
        """Members of the JSON document."""
        found, names = self.forecast, [site.name for site in self.plan.candidates]
        return {
            "format": FORMAT,
            "block": {"id": self.name},
            "verdict": VERDICT,
            "plan": self.plan,
            "cost": self.cost,
            "points": len(found.lon_lat),
            "groups": found.groups,
            "relative_to_control_points": found.relative,
            "on_the_earth": found.on_the_earth,
            "images": found.images,
            "proposed": [
                {
                    "name": one.site.name,
                    "lon_lat": one.site.lon_lat,
                    "on_the_earth": one.on_the_earth,
                    "gain_m": dict(zip(names, one.gain_m.tolist(), strict=True)),
                }
                for one in found.proposed
            ],
            "seconds": self.seconds,
            "finished_at": self.finished_at,
            "software_version": self.software_version,
        }


def accuracy_words(of: Accuracy90) -> str:
    """Both figures as text, mean and worst."""
    return (
        f"CE90 {of.ce90_m:.2f} m, LE90 {of.le90_m:.2f} m on average; "
        f"worst place {of.worst_ce90_m:.2f} m, {of.worst_le90_m:.2f} m"
    )


def points_csv(report: PlanReport) -> str:
    """The accuracy on the Earth of every point of the ground, as CSV."""
    found = report.forecast
    lines = ["lon,lat,ce90_m,le90_m"]
    rows = zip(found.lon_lat.tolist(), found.ce90_m.tolist(), found.le90_m.tolist(), strict=True)
    for (lon, lat), ce90_m, le90_m in rows:
        lines.append(f"{lon:.6f},{lat:.6f},{ce90_m:.3f},{le90_m:.3f}")
    return "\n".join(lines) + "\n"
