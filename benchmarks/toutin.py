"""Toutin and Carbonneau (1992), multi-stereoscopy with SPOT-HRV: by simulation, beside their figures.

Three images of Ottawa and Hull of 10 m, taken under 2.3, 28.6 and -20 degrees, two sheets with points of
1.5 m; their attitude, orbit and focal length are off as those of SPOT 1 to 3 are. Control points, six
tie points and check points are marked within about three metres, as in the paper: a distance of 3 m,
which is 2.1 m a coordinate, and, for comparison, 3 m a coordinate.

Run: python -m benchmarks.toutin [--trials 12], which draws `toutin.png` beside its figures.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.intersection import intersect
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.geodesy import metres_per_degree_at, move_metres
from amers.services.sensors.parameter_sets import TOUTIN
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array, IntArray, Observations
from benchmarks._measuring import RESULTS, keep
from benchmarks._toutin_figure import draw_figure
from benchmarks.rigorous_block import EXACT, Truth
from benchmarks.rigorous_block import drawn as drawn_models

PLACE = np.array([-75.75, 45.5, 100.0])
HALF_EXTENT_M = (19_500.0, 27_800.0)
"""Of two sheets 1:50,000, east and north; the northern one has relief of 300 m, the other of 100 m."""
SHAPE, GSD_M, HEIGHTS_M = (6000, 6000), 10.0, (0.0, 500.0)
LOOK_DEG = (2.30, 28.59, -19.96)
EARTH_M, ALTITUDE_M = 6_371e3, 830e3
EAST_DEG, WEST_DEG = 101.6, 281.6
"""Azimuths across the track of a descending orbit."""
SIGMA_M = 350.0
"""Of SPOT 1 to 3 on the ground, without control."""
POINT_M = 1.5
SHOWN_BY = (0.13, 0.33, 0.54)
"""Shares of the points that one, two and three images show."""
TIES = 6
SINGLES, PAIRS, ALL = ((1,), (2,), (0,)), ((0, 2), (0, 1), (1, 2)), (0, 1, 2)
PAIR = (1, 2)
"""The pair with the largest base."""
BASE_TO_HEIGHT = {(0, 2): 0.4, (0, 1): 0.6, (1, 2): 1.1}
NOT_HELD = 10.0
"""Sigmas of the parameters are so many times as large where the orbit does not hold the block."""
POOR_M = 50.0 / np.sqrt(2.0)
"""Of a coordinate: 50 m is a distance, as 100 m is the largest."""
POINTING_M = (3.0 / np.sqrt(2.0), 3.0)
"""Of a coordinate: a distance of 3 m, and 3 m."""
COUNTS = tuple(range(3, 11))
console = Console(width=150)


@dataclass(frozen=True)
class Errors:
    """Errors of check points, known minus found.

    Attributes:
        square_m2: (3,) mean squares of X, Y, Z; of Z zero with one image.
        normalised: (3,) the same relative to the declared variances; of Z zero with one image.
        parallax_m: (2,) X and Y, residual parallaxes of the control points; 0 with one image.
    """

    square_m2: Array
    normalised: Array
    parallax_m: Array


@cache
def images() -> tuple[AdjustableImage, ...]:
    """The three images as delivered."""
    out = []
    for look_deg in LOOK_DEG:
        incidence = np.degrees(
            np.arcsin((1.0 + ALTITUDE_M / EARTH_M) * np.sin(np.radians(abs(look_deg))))
        )
        view = (float(incidence), EAST_DEG if look_deg > 0.0 else WEST_DEG)
        model = pushbroom_over(PLACE, SHAPE, GSD_M, view, HEIGHTS_M)
        out.append(rigorous_parameters(f"{look_deg:+.1f} degrees", model, TOUTIN, sigma_m=SIGMA_M))
    return tuple(out)


@dataclass(frozen=True)
class Draw:
    """One draw: points, images as they are, and who sees what.

    Attributes:
        truth: images and points; the last `TIES` points are tie points without known ground.
        known: (p, 3) points as surveyed.
        shown: (p, 3) whether an image shows a point well.
        rng: source of the marks.
    """

    truth: Truth
    known: Array
    shown: Array
    rng: np.random.Generator


def draw(seed: int, count: int = 98) -> Draw:
    """Points all over both sheets, and images off as expected."""
    rng = np.random.default_rng([12, seed])
    east_north = rng.uniform(-1.0, 1.0, (count + TIES, 2)) * HALF_EXTENT_M
    relief_m = np.where(east_north[:, 1] > 0.0, 300.0, 100.0)
    up = np.column_stack([east_north, rng.uniform(0.0, 1.0, len(east_north)) * relief_m])
    points = move_metres(np.tile([*PLACE[:2], 50.0], (len(up), 1)), up)
    shown = np.zeros((len(points), 3), dtype=np.bool_)
    for row, views in enumerate(rng.choice(3, len(points), p=SHOWN_BY) + 1):
        shown[row, rng.permutation(3)[:views]] = True
    shown[count:] = True
    known = move_metres(points, rng.normal(0.0, POINT_M, (len(points), 3)))
    return Draw(Truth(images(), drawn_models(images(), rng), points), known, shown, rng)


def spread(drawn: Draw, count: int, within: float = 1.0) -> IntArray:
    """Points (count,) that all images show, as far from each other as possible.

    Args:
        drawn: with at least as many such points.
        count: of points.
        within: share of the sides of the area, in its middle.
    """
    place = (drawn.known[:-TIES, :2] - PLACE[:2]) * metres_per_degree_at(PLACE[None]) / HALF_EXTENT_M
    usable = np.flatnonzero(drawn.shown[:-TIES].all(axis=1) & (np.abs(place) < within).all(axis=1))
    chosen = [usable[np.argmax(place[usable].sum(axis=1))]]
    while len(chosen) < count:
        apart = np.linalg.norm(place[usable, None] - place[chosen], axis=2).min(axis=1)
        chosen.append(usable[np.argmax(apart)])
    return np.array(chosen)


def marked(drawn: Draw, members: Sequence[int], of: IntArray, pointing_m: float) -> Observations:
    """Points (n,) as people mark them in some images, in the numbers of these."""
    sigma_px = pointing_m / GSD_M
    rows = []
    for number, i in enumerate(members):
        seen = np.sort(of[drawn.shown[of, i]])
        position = drawn.truth.models[i].project(drawn.truth.lon_lat_h[seen])
        position += drawn.rng.normal(0.0, sigma_px, position.shape)
        rows.append(np.column_stack([seen, np.full(len(seen), number), position]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    point, image = table[:, :2].astype(np.int64).T
    return Observations(point.copy(), image.copy(), table[:, 2:].copy(), np.full(len(table), sigma_px))


def ground_of(known: Array, of: IntArray, sigma_m: Array) -> ControlGround:
    """Control of surveyed points, marked by people."""
    return ControlGround(
        point=of,
        lon_lat_h=known[of],
        covariance_m2=np.tile(np.diag(sigma_m**2), (len(of), 1, 1)),
        source=np.zeros(len(of), dtype=np.int64),
        frames=(EXACT,),
        names=tuple(f"P{row + 1}" for row in of.tolist()),
        by_hand=np.ones(len(of), dtype=np.bool_),
    )


def restituted(
    drawn: Draw,
    members: Sequence[int],
    control: ControlGround,
    pointing_m: float,
    *,
    checked: IntArray | None = None,
    held: float = 1.0,
) -> Errors:
    """The errors of check points after an adjustment of some images on control and six tie points.

    Args:
        drawn: what is true.
        members: images.
        control: known ground.
        pointing_m: standard deviation of a coordinate of marks.
        checked: points that check; by default all but control and tie points.
        held: sigmas of the parameters are so many times those that are true.
    """
    count = len(drawn.known) - TIES
    own = [drawn.truth.images[i] for i in members]
    own = [replace(image, sigma=image.sigma * held) for image in own]
    used = np.sort(np.concatenate([control.point, np.arange(count, count + TIES)]))
    ties = used if len(members) > 1 else np.sort(control.point)
    observations = marked(drawn, members, ties, pointing_m)
    number = np.searchsorted(ties, observations.point)
    block = adjust_block(
        own,
        replace(observations, point=number),
        control=replace(control, point=np.searchsorted(ties, control.point)),
        options=BlockOptions(min_points=0),
    )
    checked = np.setdiff1d(np.arange(count), control.point) if checked is None else checked
    of_check = marked(drawn, members, checked, pointing_m)
    rays = np.bincount(of_check.point, minlength=count)
    of_check = of_check.take(rays[of_check.point] >= min(len(members), 2))
    errors = errors_of(drawn, block, own, of_check)
    return replace(errors, parallax_m=parallaxes_m(block, number, len(own)))


def parallaxes_m(block: BlockAdjustment, point: IntArray, images: int) -> Array:
    """Residual parallaxes (2,) in X and Y: what the residuals of a point differ by between images."""
    whole = np.bincount(point)[point] == images
    if images == 1 or not whole.any():
        return np.zeros(2)
    residual_m = GSD_M * block.residual_px[whole].reshape(-1, images, 2)
    return np.sqrt(2.0 * residual_m.var(axis=1, ddof=1).mean(axis=0))[::-1]


def errors_of(
    drawn: Draw, block: BlockAdjustment, own: Sequence[AdjustableImage], of_check: Observations
) -> Errors:
    """Errors of check points from their marks, by the adjusted models, and what is declared of them."""
    points, rows = np.unique(of_check.point, return_inverse=True)
    of_check = replace(of_check, point=rows.astype(np.int64))
    if len(own) == 1:
        found = block.models[0].locate(of_check.line_sample, drawn.known[points, 2])
    else:
        met = intersect(block.models, of_check, len(points))
        found = met.lon_lat_h
    error_m = drawn.known[points] - found
    error_m[:, :2] *= metres_per_degree_at(found)
    variance = np.diagonal(declared(block, own, of_check, found), 0, 1, 2) + POINT_M**2
    normalised = (error_m**2 / variance).mean(axis=0)
    if len(own) == 1:
        normalised[2] = 0.0
    return Errors((error_m**2).mean(axis=0), normalised, np.zeros(2))


def declared(
    block: BlockAdjustment, own: Sequence[AdjustableImage], of_check: Observations, found: Array
) -> Array:
    """Covariances (p, 3, 3) of points from their marks, by those of the marks and of the parameters.

    With one image the height is known as a survey knows it.
    """
    k = max(len(image.sigma) for image in own)
    pairs, blocks = block.accuracy.pairs, block.accuracy.covariance()
    joint = np.zeros((len(own), len(own), k, k))
    for a in range(len(own)):
        for row in range(pairs.start[a], pairs.start[a + 1]):
            b = int(pairs.other[row])
            if b < len(own):
                joint[a, b], joint[b, a] = blocks[row], blocks[row].T
    joint = joint.transpose(0, 2, 1, 3).reshape(len(own) * k, -1)
    computed = [one.computed(block.values[n], found) for n, one in enumerate(own)]
    out = np.empty((len(found), 3, 3))
    for i in range(len(found)):
        at = np.flatnonzero(of_check.point == i)
        by_parameters = np.zeros((2 * len(at), len(own) * k))
        for n, image in enumerate(of_check.image[at].tolist()):
            rows = np.s_[2 * n : 2 * n + 2]
            by_parameters[rows, image * k : image * k + k] = computed[image].by_parameters[i]
        design = np.concatenate([computed[image].by_ground[i] for image in of_check.image[at].tolist()])
        weight = 1.0 / of_check.sigma_px[at[0]] ** 2
        normal = weight * design.T @ design
        if len(own) == 1:
            normal[2, 2] += POINT_M**-2.0
        inverse = np.linalg.inv(normal)
        carried = weight * inverse @ design.T @ by_parameters
        out[i] = inverse + carried @ joint @ carried.T
    return out


@dataclass(frozen=True)
class Figure:
    """What came out of a configuration over all draws, metres.

    Attributes:
        rms_m: X, Y, Z; Z is 0 with one image, whose heights are known.
        normalised: root mean squares of errors over their declared standard deviations.
        parallax_m: residual parallaxes in X and Y.
    """

    rms_m: tuple[float, float, float]
    normalised: tuple[float, float, float]
    parallax_m: tuple[float, float]


def figure(outcome: Sequence[Errors]) -> Figure:
    """Root mean squares over draws."""
    rms = np.sqrt(np.mean([one.square_m2 for one in outcome], axis=0)).tolist()
    normalised = np.sqrt(np.mean([one.normalised for one in outcome], axis=0)).tolist()
    parallax_m = np.sqrt(np.mean([one.parallax_m**2 for one in outcome], axis=0)).tolist()
    return Figure(tuple(rms), tuple(normalised), tuple(parallax_m))


def with_points(
    count: int, members: Sequence[int], pointing_m: float, trials: int, *, same: bool = False
) -> Figure:
    """Restitution with some control points, well spread; on the same check points for any images."""
    outcome = []
    for trial in range(trials):
        own = draw(trial)
        rows = spread(own, count)
        control = ground_of(own.known, rows, np.full(3, POINT_M))
        checked = np.setdiff1d(np.flatnonzero(own.shown[:-TIES, list(PAIR)].all(axis=1)), rows)
        outcome.append(restituted(own, members, control, pointing_m, checked=checked if same else None))
    return figure(outcome)


def with_all_points(members: Sequence[int], pointing_m: float, trials: int) -> Figure:
    """Residuals of 125 control points (table 3)."""
    outcome = []
    for trial in range(trials):
        own = draw(trial, 125)
        control = ground_of(own.known, np.arange(125), np.full(3, POINT_M))
        outcome.append(restituted(own, members, control, pointing_m, checked=np.arange(125)))
    return figure(outcome)


def extrapolated(within: float, pointing_m: float, trials: int) -> tuple[Figure, Figure]:
    """Three images on six points all over the area, and on six in its middle."""
    whole, middle = [], []
    for trial in range(trials):
        own = draw(trial)
        sets = [spread(own, 6), spread(own, 6, within)]
        # The same points check both.
        checked = np.setdiff1d(np.arange(98), np.concatenate(sets))
        for rows, outcome in zip(sets, (whole, middle), strict=True):
            control = ground_of(own.known, rows, np.full(3, POINT_M))
            outcome.append(restituted(own, ALL, control, pointing_m, checked=checked))
    return figure(whole), figure(middle)


def with_poor_points(held: float, pointing_m: float, trials: int) -> Figure:
    """The pair on 50 points that are off by 50 m in the plane, 100 m at most, and 5 m in height."""
    return figure(poor_draws(held, pointing_m, trials))


def poor_draws(held: float, pointing_m: float, trials: int) -> list[Errors]:
    """The draws of `with_poor_points`: the paper is one."""
    outcome = []
    sigma = np.array([POOR_M, POOR_M, 5.0])
    for trial in range(trials):
        own = draw(trial, 125)
        rows = spread(own, 50)
        error_m = own.rng.normal(0.0, sigma, (len(own.known), 3))
        distance_m = np.linalg.norm(error_m[:, :2], axis=1, keepdims=True)
        error_m[:, :2] *= np.minimum(1.0, 100.0 / distance_m)
        poor = move_metres(own.known, error_m)
        control = ground_of(poor, rows, sigma)
        outcome.append(restituted(own, PAIR, control, pointing_m, held=held))
    return outcome


PUBLISHED_3 = {
    ALL: (3.35, 3.75, 4.67, 2.0, 2.9),
    PAIR: (3.66, 3.88, 4.90, 1.8, 2.3),
    (1,): (4.35, 4.38, 0.0, 0.0, 0.0),
}
PUBLISHED_4 = {ALL: (3.9, 3.7, 3.2), PAIR: (4.1, 4.4, 3.5), (1,): (4.7, 4.6, 0.0)}
PUBLISHED_5 = {ALL: (3.16, 2.80, 2.92), PAIR: (3.50, 3.05, 2.77), (1,): (4.01, 3.81, 0.0)}
PUBLISHED_6 = (7.6, 5.6, 5.4)
PUBLISHED_UP = {(0, 2): 12.0, (0, 1): 8.0, (1, 2): 4.0}


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=12, help="draws (%(default)s)")
    trials = parser.parse_args().trials
    outcome: dict[str, Any] = {}
    for name, show in (
        ("table_3", residuals_on_control),
        ("tables_4_and_5", numbers_of_images),
        ("graphs", graphs),
        ("extrapolation", outside),
        ("table_6", poor_control),
    ):
        outcome[name] = show(trials)
    keep("toutin", outcome)
    draw_figure(outcome, RESULTS / "toutin.png")


def metres(values: Sequence[float]) -> str:
    """X, Y, Z, as far as known."""
    return ", ".join(f"{value:.2f}" for value in values if value > 0.0)


def residuals_on_control(trials: int) -> list[Any]:
    """Table 3: 125 control points and six tie points."""
    table = Table(
        "images", "published", "marks of 2.1 m", "marks of 3 m", "error / sigma",
        title="table 3: residuals on 125 control points, X, Y, Z, parallaxes in X and Y, m",
    )  # fmt: skip
    rows = []
    for members, published in PUBLISHED_3.items():
        own = [with_all_points(members, pointing_m, max(trials // 4, 2)) for pointing_m in POINTING_M]
        figures = [metres((*one.rms_m, *one.parallax_m)) for one in own]
        table.add_row(str(len(members)), metres(published), *figures, metres(own[0].normalised))
        rows.append({"images": len(members), "published": published, "ours": [vars(one) for one in own]})
    console.print(table)
    return rows


def numbers_of_images(trials: int) -> list[Any]:
    """Tables 4 and 5, graph 4: six control points and one, two, three images; the same check points."""
    table = Table(
        "images", "published", "best points", "marks of 2.1 m", "marks of 3 m", "error / sigma",
        title="tables 4 and 5: six control points, check points X, Y, Z, m",
    )  # fmt: skip
    rows = []
    for members, published in PUBLISHED_4.items():
        own = [with_points(6, members, pointing_m, trials, same=True) for pointing_m in POINTING_M]
        best = PUBLISHED_5[members]
        figures = [metres(one.rms_m) for one in own]
        normalised = metres(own[0].normalised)
        table.add_row(str(len(members)), metres(published), metres(best), *figures, normalised)
        ours = [vars(one) for one in own]
        rows.append({"images": len(members), "published": published, "best": best, "ours": ours})
    console.print(table)
    return rows


def graphs(trials: int) -> list[Any]:
    """Graphs 1 to 3: three to ten control points, every image, pair and all."""
    table = Table(
        "images", "B/H", "published Z", *(f"{count} points" for count in COUNTS),
        title="graphs 1 to 3: marks of 2.1 m, check points X, Y, Z, m",
    )  # fmt: skip
    rows = []
    for members in (*SINGLES, *PAIRS, ALL):
        names = ", ".join(f"{LOOK_DEG[i]:+.1f}" for i in members)
        own = [with_points(count, members, POINTING_M[0], max(trials // 2, 2)) for count in COUNTS]
        ratio, published = BASE_TO_HEIGHT.get(members, 0.0), PUBLISHED_UP.get(members, 0.0)
        table.add_row(names, metres([ratio]), metres([published]), *(metres(one.rms_m) for one in own))
        row = {"images": names, "ratio": ratio, "published": published, "points": COUNTS}
        rows.append({**row, "ours": [vars(one) for one in own]})
    console.print(table)
    return rows


def outside(trials: int) -> dict[str, Any]:
    """Six control points in the middle of the area, and all over it."""
    table = Table(
        "", "ours", "worse", title="six control points, marks of 2.1 m, check points X, Y, Z, m"
    )
    out = {}
    whole, middle = extrapolated(0.5, POINTING_M[0], trials)
    worse = np.array(middle.rms_m) / whole.rms_m - 1.0
    table.add_row("all over the area", metres(whole.rms_m), "")
    percent = ", ".join(f"{100.0 * part:.0f} %" for part in worse)
    table.add_row("in the middle quarter", metres(middle.rms_m), f"{percent} (published 10 to 30 %)")
    out["whole"], out["middle"] = vars(whole), vars(middle)
    console.print(table)
    return out


def poor_control(trials: int) -> dict[str, Any]:
    """Table 6: 50 control points that are off by 50 m, and what the orbit does for them."""
    table = Table(
        "", "published", "ours", "error / sigma",
        title="table 6: 50 points of 50 m, 5 m in height, two images, marks of 2.1 m, X, Y, Z, m",
    )  # fmt: skip
    draws = poor_draws(1.0, POINTING_M[0], 4 * trials)
    held, free = figure(draws), with_poor_points(NOT_HELD, POINTING_M[0], trials)
    plane_m = np.sqrt([one.square_m2[:2].sum() for one in draws])
    better = float((plane_m < np.hypot(*PUBLISHED_6[:2])).mean())
    table.add_row("held by the orbit", metres(PUBLISHED_6), metres(held.rms_m), metres(held.normalised))
    table.add_row("known ten times less", "", metres(free.rms_m), metres(free.normalised))
    console.print(table)
    low, high = np.percentile(plane_m, [10, 90]).tolist()
    console.print(
        f"planimetry of single draws: {low:.1f} to {high:.1f} m (10 and 90 %); {better:.0%} are better "
        f"than the published {np.hypot(*PUBLISHED_6[:2]):.1f} m"
    )
    return {
        "published": PUBLISHED_6,
        "held": vars(held),
        "free": vars(free),
        "better_than_published": better,
        "planimetry_m": plane_m.tolist(),
    }


if __name__ == "__main__":
    main()
