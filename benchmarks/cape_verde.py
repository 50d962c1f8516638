"""One known site carries an archipelago: ortho-images alone and with stereo pairs, by simulation.

The published test (Chandelier and others, SRP, 2020, table 8) has three Sentinel-2 ortho-images, five
pairs of SPOT 5 HRS that do not touch, seven images of SPOT 6/7 in which four airports are measured, and
gives the horizontal residual at three airports when the fourth alone is known. The same is drawn here
(`benchmarks._cape_verde`) several times, with the errors and sigmas that are written there: the
publication states neither those nor the footprints. Beside the published figure: the first draw, the
root mean square of all draws, what the adjustment declares, and the normalised error. Then how far the
corners of the ortho-images move between one known site and four.
Run: python -m benchmarks.cape_verde [--draws 12]
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

import numpy as np

from amers.services.quality.site_reach import SiteCheck, SiteReach, site_reach
from amers.services.types import Array
from benchmarks._campaign import run_campaign
from benchmarks._cape_verde import SITES, STEREO, draw
from benchmarks._measuring import keep, print_table

PUBLISHED = {
    ("GVAC", "GVBA"): (67, 0.83, 1.08),
    ("GVAC", "GVNP"): (207, 1.97, 1.96),
    ("GVAC", "GVSV"): (225, 1.85, 0.78),
    ("GVBA", "GVAC"): (67, 0.80, 1.11),
    ("GVBA", "GVNP"): (147, 2.57, 2.88),
    ("GVBA", "GVSV"): (245, 2.57, 1.40),
    ("GVNP", "GVAC"): (207, 1.58, 1.74),
    ("GVNP", "GVBA"): (147, 2.20, 2.66),
    ("GVNP", "GVSV"): (269, 2.11, 1.35),
    ("GVSV", "GVNP"): (269, 1.84, 0.67),
    ("GVSV", "GVAC"): (225, 2.68, 1.27),
    ("GVSV", "GVBA"): (245, 2.11, 1.57),
}
"""Known site, check: distance in km, residual in m with ortho-images alone and with pairs."""
LARGEST_M = 2.9
FOUNDATIONS = ("ortho-images alone", "with stereo pairs")


@dataclass(frozen=True)
class Carried:
    """What one site gives at another, over all draws.

    Attributes:
        active, check, distance_km: the two sites.
        published_m: residual.
        first_m: residual of the first draw.
        rms_m: root mean square of the residuals.
        largest_m: of all draws.
        declared_m: root mean square that the adjustment declares.
        normalised: mean square of the horizontal errors over what is declared; 1 is true.
        normalised_up: the same for heights.
    """

    active: str
    check: str
    distance_km: float
    published_m: float
    first_m: float
    rms_m: float
    largest_m: float
    declared_m: float
    normalised: float
    normalised_up: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    outcome = measure(arguments.draws, arguments.seed)
    keep("cape_verde", {"date": datetime.now(UTC).isoformat(), "draws": arguments.draws, **outcome})


def measure(draws: int, seed: int) -> dict[str, object]:
    """All draws of both foundations, as tables and as figures."""
    reaches: dict[str, list[SiteReach]] = {name: [] for name in FOUNDATIONS}
    for one in run_campaign({str(n): n for n in range(draws)}, partial(drawn, seed)).values():
        for name, reach in zip(FOUNDATIONS, one, strict=True):
            reaches[name].append(reach)
    outcome: dict[str, object] = {}
    for column, name in enumerate(FOUNDATIONS):
        rows = [carried(reaches[name], pair, column) for pair in PUBLISHED]
        largest = np.array([[check.residual_m for check in reach.checks] for reach in reaches[name]])
        show(name, rows, largest)
        corners = {active: corner_moves(reaches[name], active) for active in SITES}
        columns = {
            "active": lambda row: row[0],
            "median m": lambda row: f"{row[1][0]:.2f}",
            "largest m": lambda row: f"{row[1][1]:.2f}",
        }
        print_table(f"{name}: corners of the ortho-images, 1 site or 4", corners.items(), columns)
        outcome[name] = {
            "rows": [vars(row) for row in rows],
            "largest_m_of_draws": largest.max(axis=1).round(3).tolist(),
            "corners_m": {active: moved.round(3).tolist() for active, moved in corners.items()},
        }
    return outcome


def drawn(seed: int, number: int) -> tuple[SiteReach, ...]:
    """What one site reaches in a draw, on each foundation."""
    one = draw(np.random.default_rng([seed, number]))
    return tuple(
        site_reach(foundation.images, foundation.observations, one.sites, one.heights)
        for foundation in (one.without(STEREO), one)
    )


def carried(reaches: list[SiteReach], pair: tuple[str, str], column: int) -> Carried:
    """What one site gives at another, over all draws."""
    checks: list[SiteCheck] = [
        check for reach in reaches for check in reach.checks if (check.active, check.check) == pair
    ]
    residual = np.array([check.residual_m for check in checks])
    squares = [
        check.error_m[:2] @ np.linalg.solve(check.covariance_m2[:2, :2], check.error_m[:2]) / 2.0
        for check in checks
    ]
    return Carried(
        *pair,
        distance_km=round(checks[0].distance_km, 1),
        published_m=PUBLISHED[pair][1 + column],
        first_m=float(residual[0]),
        rms_m=float(np.sqrt(np.mean(residual**2))),
        largest_m=float(residual.max()),
        declared_m=float(np.sqrt(np.mean([np.trace(check.covariance_m2[:2, :2]) for check in checks]))),
        normalised=float(np.mean(squares)),
        normalised_up=float(
            np.mean([check.error_m[2] ** 2 / check.covariance_m2[2, 2] for check in checks])
        ),
    )


def corner_moves(reaches: list[SiteReach], active: str) -> Array:
    """Median and largest move of the corners of the ortho-images, metres."""
    lengths = [
        np.hypot(*corner.moved_m.T)
        for reach in reaches
        for corner in reach.corners
        if corner.active == active and corner.image.startswith("ortho")
    ]
    return np.array([np.median(lengths), np.max(lengths)])


def show(name: str, rows: list[Carried], largest_m: Array) -> None:
    """Print the published table with ours beside it."""
    normalised = np.mean([row.normalised for row in rows])
    published_m, rms_m = (
        np.sqrt(np.mean([getattr(row, member) ** 2 for row in rows]))
        for member in ("published_m", "rms_m")
    )
    largest = largest_m.max(axis=1)
    caption = (
        f"rms of all {published_m:.2f} m published, {rms_m:.2f} m here; normalised {normalised:.2f}; "
        f"largest residual of a draw: {np.median(largest):.2f} m in the middle, "
        f"at most {LARGEST_M} m in {np.mean(largest <= LARGEST_M):.0%} of the draws; of all residuals "
        f"{np.mean(largest_m <= LARGEST_M):.0%} are"
    )
    print_table(
        f"{name}: residual at the check site, m, {len(largest_m)} draws", rows, COLUMNS, caption=caption
    )


COLUMNS: dict[str, Callable[[Carried], object]] = {
    "active": lambda row: row.active,
    "check": lambda row: row.check,
    "km": lambda row: f"{row.distance_km:.0f}",
    "publ.": lambda row: f"{row.published_m:.2f}",
    "draw 1": lambda row: f"{row.first_m:.2f}",
    "rms": lambda row: f"{row.rms_m:.2f}",
    "max": lambda row: f"{row.largest_m:.2f}",
    "decl.": lambda row: f"{row.declared_m:.2f}",
    "norm.": lambda row: f"{row.normalised:.2f}",
    "norm. up": lambda row: f"{row.normalised_up:.2f}",
}


if __name__ == "__main__":
    main()
