"""What the reports on plans, adjustments and selections say of a block, from figures that are put in."""

from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.production.block_plan import BlockPlan, PlannedImage, PlannedSite
from amers.services.production.block_residuals import FITS, ImageFit, PointFits
from amers.services.production.planning import Accuracy90, Forecast, ImageForecast, ProposedSite
from amers.services.quality.accuracy_statement import median_accuracy
from amers.services.reports.block_adjustment import ALL_FITS, LOOK_AT, AdjustmentReport, ControlFit
from amers.services.reports.block_quality import degree_words
from amers.services.reports.plan import PlanReport
from amers.services.reports.selection import share_words
from amers.services.types import Frame

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
RELATIVE, EARTH = Accuracy90(1.1, 1.2, 1.3, 1.4), Accuracy90(5.1, 5.2, 5.3, 5.4)
NEAR, FAR = PlannedSite("near", (5.5, 43.25)), PlannedSite("far", (6.5, 43.75))


def plan_report() -> PlanReport:
    """A plan with one image and two sites that are proposed, the one after the other."""
    image = PlannedImage("one", (5.0, 43.0), (1000.0, 1000.0), 2.0, 15.0, 100.0, 6.0)
    proposed = (
        ProposedSite(FAR, Accuracy90(4.0, 4.1, 4.2, 4.3), np.array([0.5, 1.1])),
        ProposedSite(NEAR, Accuracy90(3.5, 3.6, 3.7, 3.8), np.array([0.5, np.nan])),
    )
    forecast = Forecast(
        lon_lat=np.array([[5.0, 43.0], [5.25, 43.5]]),
        ce90_m=np.array([2.0, 3.0]),
        le90_m=np.array([7.0, 8.0]),
        relative=RELATIVE,
        on_the_earth=EARTH,
        images=(ImageForecast("one", 7, RELATIVE, EARTH),),
        groups=1,
        proposed=proposed,
    )
    block = BlockPlan((image,), 500.0, candidates=(NEAR, FAR))
    return PlanReport("a plan", block, forecast, 1.5, WHEN, "0.1.0")


@pytest.fixture
def plan() -> PlanReport:
    return plan_report()


def test_a_plan_states_its_accuracy_relative_first_and_what_each_site_gains(plan: PlanReport) -> None:
    relative, earth, first, second, cost = plan.words
    assert relative.startswith("Relative to the control points: CE90 1.10 m, LE90 1.20 m on average")
    assert relative.endswith("worst place 1.30 m, 1.40 m")
    assert earth.startswith("On the Earth: CE90 5.10 m, LE90 5.20 m on average")
    assert "far (6.5000, 43.7500): mean CE90 on the Earth 5.10 m to 4.00 m, LE90 4.10 m" in first
    assert "near (5.5000, 43.2500): mean CE90 on the Earth 4.00 m to 3.50 m, LE90 3.60 m" in second
    assert "core-hours" in cost


def adjusted(odd: int = 0, contradicting: int = 0, control: int = 3) -> AdjustmentReport:
    """A block of four images, some of which are odd, and control, some of which contradicts."""
    images = tuple(
        ImageFit(f"image {k}", 10, 9, (0.1, 0.2), (1.0, 2.0), 3.0, "far off" if k < odd else FITS)
        for k in range(4)
    )
    fits = tuple(
        ControlFit(f"P{k}", k >= contradicting, (0.5, -0.5, float("nan"))) for k in range(control)
    )
    return AdjustmentReport(
        block="b",
        accuracy=median_accuracy(1.0, 2.0, Frame.from_sigmas(3.0, 4.0)),
        delivered_px=9.0,
        adjusted_px=0.3,
        points_px=0.2,
        slope_factor=1.5,
        images=images,
        control=fits,
        lon_lat_h=np.array([[5.0, 43.0, 100.0], [6.0, 44.0, 200.0]]),
        sigma_m=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        points=PointFits(np.array([3, 4]), np.array([2, 4]), np.array([0.1, 0.2]), np.array([0.3, 0.4])),
        without_surface={"no texture": 1},
        finished_at=WHEN,
        software_version="0.1.0",
    )


@pytest.mark.parametrize(
    ("odd", "contradicting", "control", "verdict", "words"),
    [
        (0, 0, 3, ALL_FITS, "Every image fits, and so does all control."),
        (0, 0, 0, ALL_FITS, "Every image fits."),
        (1, 0, 3, LOOK_AT, "1 of 4 images should be looked at."),
        (0, 2, 3, LOOK_AT, "2 of 3 control points contradict the rest."),
        (
            3,
            1,
            3,
            LOOK_AT,
            "3 of 4 images should be looked at and 1 of 3 control points contradict the rest.",
        ),
    ],
)
def test_a_block_is_looked_at_for_each_odd_image_and_each_contradiction(
    odd: int, contradicting: int, control: int, verdict: str, words: str
) -> None:
    report = adjusted(odd, contradicting, control)
    assert (report.verdict, report.verdict_words) == (verdict, words)
    assert [one.name for one in report.left_out] == [f"P{k}" for k in range(contradicting)]


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.0, "0.0 %"), (1e-6, "less than 0.1 %"), (0.0006, "0.1 %"), (0.5, "50.0 %"), (1.0, "100.0 %")],
)
def test_a_share_that_is_not_nothing_never_looks_like_it(share: float, words: str) -> None:
    assert share_words(share) == words


@pytest.mark.parametrize(
    ("west", "south", "words"),
    [(5.0, 43.0, "43° N 5° E"), (-6.0, -44.0, "44° S 6° W"), (0.0, 0.0, "0° N 0° E")],
)
def test_a_cell_of_one_degree_has_the_name_of_its_south_western_corner(
    west: float, south: float, words: str
) -> None:
    assert degree_words(west, south) == words
