"""Small worlds of adjustments, their lack of fit and their quality, for the figures of everything."""

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np

from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.intersected_marks import ModelErrors, intersect_marks
from amers.services.adjustment.known_images import tie
from amers.services.adjustment.observation_noise import found_noise
from amers.services.adjustment.parameter_figures import held_parameters, parameter_figures
from amers.services.formats.block.document import rectangle
from amers.services.imagery.pixel_checks import Fault
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.marked_scene import adjust_marks
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.block_cells import block_cells
from amers.services.quality.block_heights import HeightModel, height_errors, height_quality
from amers.services.quality.block_requirements import BlockRequirements
from amers.services.quality.check_points import check_model
from amers.services.quality.control_series import MarkedGroundPoints, control_series
from amers.services.quality.line_of_sight import implied_sight
from amers.services.quality.marks import marks_beside_points
from amers.services.quality.missed_along import missed_along
from amers.services.quality.planimetry import planimetric_quality
from amers.services.quality.points_elsewhere import Elsewhere, agree_elsewhere
from amers.services.quality.qualification import QualificationOptions, qualify
from amers.services.quality.sight_errors import slope_of_growth
from amers.services.quality.site_errors import POINTS, SiteErrors, point_errors
from amers.services.quality.site_reach import site_reach
from amers.services.quality.vanished import vanished_points
from amers.services.registration.on_marks import register_on_marks
from amers.services.reports.block_quality import (
    BlockIdentification,
    BlockQualityReport,
    Measured,
    MeasuredErrors,
    block_quality_report,
)
from amers.services.types import Acquisition, Frame, SurfaceHeights
from benchmarks import toutin
from benchmarks._cape_verde import STEREO
from benchmarks._cape_verde import draw as draw_archipelago
from benchmarks.rigorous_block import Truth, drawn
from tests.services.adjustment import test_bent_blocks as bent
from tests.services.adjustment import test_frame_fit as framed
from tests.services.adjustment import test_intersected_marks as marked
from tests.services.adjustment import test_known_images as neighbours
from tests.services.adjustment import test_one_image as one_image
from tests.services.adjustment import test_rigorous_block as rigorous
from tests.services.conftest import GSD_M, SHAPE, FlatModel, register
from tests.services.misfit import test_adjust_scene as affine
from tests.services.misfit import test_broken_image as broken
from tests.services.misfit import test_displacement_components as moving
from tests.services.misfit import test_marked_scene as marks
from tests.services.quality import test_block_heights as heights
from tests.services.quality import test_checks as checks
from tests.services.quality import test_findings as findings
from tests.services.quality import test_held_area as held
from tests.services.quality import test_line_of_sight as sights
from tests.services.quality import test_planimetric_figures as placed
from tests.services.quality import test_sight_errors as hillsides
from tests.services.quality import test_site_images as sites
from tests.services.quality import test_vanished as vanished
from tests.services.registration import test_on_marks as on_marks
from tests.services.simulated import block, ring_of_geometries
from tests.services.ties import make_ties

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
UNEQUAL_M2 = np.array([[1.5, 0.4, 0.2], [0.4, 2.0, 0.3], [0.2, 0.3, 4.0]])
"""Covariance of errors of another size along each axis."""


def _block_beside_a_neighbour() -> Any:
    seam = neighbours.seam("star", 0)
    known = neighbours.first("star", 0).known
    assert known is not None
    return neighbours.second("star", 0, tied=True), tie(seam.images[1], known), known


def _block_of_ortho_images() -> Any:
    one = draw_archipelago(np.random.default_rng([41, 0]), 60)
    return adjust_block(one.images, one.observations, control=one.control([1]))


def _block_of_orbits() -> Any:
    rng, images = np.random.default_rng([4, 1]), rigorous.mixed()
    truth = Truth(images, drawn(images, rng), rigorous.ground(rng, 60))
    control = truth.control(rng, np.arange(4), (0.5, 0.8), Frame(UNEQUAL_M2))
    adjusted = adjust_block(images, truth.observed(rng, 0.2), control=control)
    figures = parameter_figures(images, adjusted)
    return adjusted, figures, held_parameters(figures), [image.credible_px for image in images]


def _one_image() -> Any:
    """On one point, which leaves it to turn about the line of sight, and on three."""
    (view,), places = ring_of_geometries(1, shape=(600, 800)), np.array([[90.0, 500.0]])
    three = np.concatenate([places, [[400.0, 120.0], [310.0, 710.0]]])
    return [one_image.alone(view, at, own_m=0.1, frame_m=0.2, by_hand=True) for at in (places, three)]


def _marks_of_several_images() -> Any:
    """Models that are off, one exactly known, with wrong marks of points of three, and of two."""
    models, ties = marked.marked(3, 2, points=24, shift_px=4.0)
    pairs = marked.moved(ties, [4, 25, 60], np.array([9.0, -14.0]))
    pairs = pairs.take((pairs.point < 18) | (pairs.image != 1))
    errors = [marked.OFF, ModelErrors(np.diag([9.0, 25.0]), np.array([0.2, 0.4])), marked.EXACT_MODEL]
    return intersect_marks(models, errors, pairs, 26)


def _noise_of_observations() -> Any:
    views, rng = ring_of_geometries(3), np.random.default_rng(12)
    ties = make_ties(views, rng, 4300, 0.0, seen=0.8)
    ties.observations.sigma_px[:] = sigma_px = rng.choice([0.03, 0.2], len(ties.observations))
    noise_px = rng.normal(0.0, np.hypot(1.4 * sigma_px, 0.1)[:, None], (len(sigma_px), 2))
    noise = found_noise(ties.observations, [view.rpc for view in views], ties.lon_lat_h, noise_px)
    return noise, noise.applied(sigma_px)


def _errors_by_control() -> Any:
    """Of one image, two and both, without control and with some, on ties of unknown ground as well."""
    drawn_points = toutin.draw(3, 24)
    known = drawn_points.known.copy()
    known[-toutin.TIES :] = np.nan
    rows = np.arange(len(known))
    points = MarkedGroundPoints(
        names=tuple(f"P{row}" for row in rows),
        known=known,
        sigma_m=np.tile([0.5, 0.7, 1.1], (len(known), 1)),
        marks=toutin.marked(drawn_points, range(2), rows, 4.0),
        images=drawn_points.truth.images[:2],
        models=tuple(image.model for image in drawn_points.truth.images[:2]),
        gsd_m=np.array([10.0, 12.0]),
    )
    said: list[Any] = []
    rng = np.random.default_rng(5)
    rows_of_series = control_series(points, (0, 1, 4, 30), 2, rng, lambda *told: said.append(told))
    return rows_of_series, said


def _reach_of_sites() -> Any:
    one = draw_archipelago(np.random.default_rng(47), 60).without(STEREO)
    return site_reach(one.images, one.observations, one.sites[:2], one.heights)


def _corrections() -> dict[str, SceneAdjustment]:
    """Of affine models that are off, of points of several blocks, and of lines and samples that move."""
    rng = np.random.default_rng(31)
    points = affine.with_blunders(affine.seen(affine.TRUTH["affine"], rng, 60), 9, rng)
    first, of_block = affine.blocks_apart(0.8, rng, 50)
    covariance_m2 = np.tile(0.02 * UNEQUAL_M2, (50, 1, 1))
    plain = replace(first, covariance_m2=covariance_m2).observed(chip_side_px=200.0)
    common_px2, deformation_px2 = np.array([[0.9, 0.2], [0.2, 0.5]]), np.array([[0.4, 0.1], [0.1, 0.2]])
    given = {
        "blocks": replace(plain, block=of_block),
        "blocks whose frames are stated": replace(
            plain, block=of_block, frame_covariance_m2=np.stack([UNEQUAL_M2, 0.1 * UNEQUAL_M2])
        ),
        "common errors": replace(plain, common_covariance_px2=common_px2),
        "a deformation": replace(plain, deformation_px2=deformation_px2),
        "marks beside points": replace(plain, stated=np.arange(50) % 5 == 0),
        "some held out": replace(plain, usable=np.arange(50) % 4 > 0),
    }
    out = {name: adjust_scene(FlatModel(), SHAPE, one) for name, one in given.items()}
    for order in (None, "shift", "drift", "affine"):
        out[f"order {order}"] = points.adjust(AdjustmentOptions(order=order))
    for name in ("jitter", "two seams", "yaw that oscillates", "bows over both"):
        observed, _ = moving.draw(moving.MOTIONS[name], np.random.default_rng(3), averaged=True)
        out[name] = adjust_scene(FlatModel(), moving.SHAPE, observed)
    repeated = replace(observed, usable=np.arange(100) % 3 > 0)
    out["repetition"] = adjust_scene(FlatModel(), moving.SHAPE, repeated, like=out[name])
    lost, rng = broken.broken(2, 40.0)
    out["lost lines"] = adjust_scene(FlatModel(), broken.SHAPE, lost.observed(rng))
    many, _ = moving.draw(moving.MOTIONS["jitter"], np.random.default_rng(4), count=420)
    out["more points than are searched"] = adjust_scene(FlatModel(), moving.SHAPE, many)
    half, _ = moving.draw(moving.still, np.random.default_rng(8), reach=(0.5, 0.7))
    out["half of an image"] = adjust_scene(FlatModel(), moving.SHAPE, half)
    return out


def _few_marks() -> Any:
    """One mark, two that disagree, five, and the same without the first."""
    rng = np.random.default_rng(6)
    five = marks.marks_of(rng, 5, marks.of_a_map_m, marks.truth(rng))
    line_sample = five.line_sample.copy()
    line_sample[0] += [700.0, -400.0]
    first = np.arange(5)
    given = {
        "one": replace(five, usable=first == 4),
        "two": replace(five, usable=first < 2, line_sample=line_sample),
        "five": five,
    }
    out = {
        name: adjust_marks(marks.MODEL, marks.SHAPE, one, marks.PRIORS) for name, one in given.items()
    }
    fewer = replace(five, usable=first > 0)
    out["repetition"] = adjust_marks(marks.MODEL, marks.SHAPE, fewer, marks.PRIORS, out["five"])
    return out


def _qualifications() -> Any:
    """Of a scene with breaks, faults of its pixels, points elsewhere, ties of others, and shears."""
    scene = register(n=150, points_px=0.4, shared_px=0.3).adjusted()
    lost = scene.measures.line_sample[:, 0] > 3000.0
    elsewhere = Elsewhere(np.flatnonzero(lost)[:12], np.array([5.0, -3.0]), 2.9, 1e-9)
    parts = [
        findings.fault(kind, 0.4 + number, 700 * number, 300)
        for number, kind in enumerate(
            (Fault.PART, Fault.LOST_SAMPLES, Fault.REPEATED_SAMPLES, Fault.BANDS)
        )
    ]
    parts = [replace(one, sample=2000, samples=900) for one in parts]
    shears = sights.shears_of(1, 150)
    given = {
        "as it is": scene,
        "breaks": replace(scene, breaks=np.array([1300, 3900])),
        "parts": replace(scene, pixel_findings=tuple(parts), control_gsd_m=2.0),
        "elsewhere": replace(scene, elsewhere=elsewhere, frame=Frame(UNEQUAL_M2)),
        "heights elsewhere": replace(scene, elsewhere=replace(elsewhere, slope_px=np.array([0.1, 0.3]))),
        "ties": replace(scene, tie_places=held.all_over(9) * [4.0, 2.5]),
        "shears": replace(scene, shears=shears),
    }
    options, rng = QualificationOptions(max_ce90_on_earth_m=3.0), np.random.default_rng(3)
    found = {name: qualify(one, options, rng) for name, one in given.items()}
    return {
        name: (one.verdict, one.findings, one.coverage, one.predicted, one.accuracy, one.stability)
        for name, one in found.items()
    }, found["breaks"]


def _marks_in_an_image() -> Any:
    """Marks alone, one of them wrong or two that disagree, and marks beside points."""
    places = on_marks.eight()
    wrong = on_marks.moved(on_marks.marks_at(places), 2, np.array([9.0, -20.0]))
    wrong = replace(wrong, sigma_m=wrong.sigma_m * [1.0, 2.0, 3.0], sigma_px=0.1 * np.arange(3.0, 11.0))
    two = on_marks.moved(on_marks.marks_at(places[:2]), 1, np.array([300.0, 200.0]))
    alone = [
        register_on_marks(on_marks.SCENE, one) for one in (wrong, two, on_marks.marks_at(places[:1]))
    ]
    scene = register(n=60).adjusted()
    beside = [
        marks_beside_points(scene, tuple(f"P{k}" for k in range(n)), np.tile([0.2, 0.3, 0.6], (n, 1)))
        for n in (5, 51)
    ]
    return [one.marks for one in alone], beside[0], beside[1].marks[-8:], beside[1].words


@cache
def quality_of_a_block() -> BlockQualityReport:
    """Of one with surfaces, against heights and at sites, a part of its ground excluded."""
    rng, terrain = np.random.default_rng(21), heights.sloping_terrain(0.2)
    points = heights.with_errors(heights.true_points(terrain, 400, Frame(UNEQUAL_M2)), rng)
    ages = [None if year == 3 else WHEN.replace(year=2020 + year) for year in range(6)]
    images = tuple(
        replace(one, acquired_at=ages[k % 6]) for k, one in enumerate(points.views.images)
    ) or (Acquisition("none"),)
    surface_m = points.lon_lat_h[:, 2] + rng.normal(0.3, 0.8, 400)
    surface_m[::9] = np.nan
    points = replace(
        points,
        views=replace(points.views, images=images),
        surface=SurfaceHeights(surface_m, rng.uniform(0.4, 1.2, 400)),
    )
    model = HeightModel(
        replace(terrain, sigmas=0.5), 1.3, lambda lon_lat: lon_lat[:, 0] + lon_lat[:, 1] > 50.3
    )
    errors = height_errors(points, model)
    cover = np.where(errors.lon_lat[:, 1] > 43.6, "forest", "fields").tolist()
    measured = [_at_site(rng, name, source) for name in ("west", "east") for source in (POINTS, "img")]
    of_points, of_images = (tuple(measured[first::2]) for first in (0, 1))
    planimetry = tuple(
        planimetric_quality(one, source, Frame(UNEQUAL_M2))
        for one, source in ((of_points, "points"), (of_images, "images"))
    )
    outline = rectangle(*heights.BOX)
    return block_quality_report(
        BlockIdentification("b", "2", "a block", WHEN),
        points,
        block_cells(points, outline, 3, WHEN, model.excluded),
        BlockRequirements(0.02, 0.6, 3, 4.0, 2.5),
        Measured(
            height_quality(errors, points, model, "a slope", cover),
            planimetry,
            MeasuredErrors(outline, errors, tuple(measured)),
        ),
        assessed_at=WHEN,
        seconds=1.5,
        software_version="0.1.0",
    )


def _quality_of_a_block() -> Any:
    """The report, with its cells as columns."""
    report = quality_of_a_block()
    cells = [vars(cell) for cell in report.density.cells]
    columns = {name: np.array([cell[name] for cell in cells]) for name in cells[0]}
    return replace(report, density=replace(report.density, cells=())), columns


def _at_site(rng: np.random.Generator, name: str, source: str) -> SiteErrors:
    n, place = 40, np.array([5.5 if name == "west" else 6.5, 43.4])
    error_m = rng.normal([0.4, -0.9], [0.8, 1.6], (n, 2))
    stated_m2 = np.tile(UNEQUAL_M2[:2, :2] * (1.0 if source == POINTS else np.nan), (n, 1, 1))
    return replace(
        placed.at_site(name, error_m, control=name == "west"),
        source=source,
        incidence_deg=12.0,
        tried=n + 7,
        reach_m=9.0 + n,
        lon_lat=place + rng.uniform(-0.1, 0.1, (n, 2)),
        covariance_m2=stated_m2,
        frame_m2=np.diag([0.3, 0.5]),
        reasons=(("flat", 3), ("cloud", 4)),
    )


def _errors_at_a_site() -> Any:
    shifted = sites.view(1, sites.SHIFT_PX)
    return (
        sites.image_errors(shifted, sites.site(), sites.terrain(), 8.0),
        point_errors(*block(), sites.site()),
    )


def _places_that_are_held() -> Any:
    """With a hole, a part of few points, and ground that agrees elsewhere."""
    rng, points = np.random.default_rng(7), held.all_over(300)
    hole = np.hypot(*(points - [500.0, 1000.0]).T) < 300.0
    parts = np.array([[0.0, 899.0, 0.0, 1999.0], [900.0, 999.0, 0.0, 1999.0]])
    area = held.held(
        points[~hole], parts, missed=points[hole], elsewhere=held.all_over(20, 5) * [0.4, 1.0]
    )
    missed = missed_along(points[:, 0], ~((points[:, 0] > 700.0) & (rng.random(300) < 0.97)), ~hole)
    misfit_px = np.where(hole[:, None], [4.0, -7.0], 0.0) + rng.normal(0.0, 0.5, (300, 2))
    many = missed_along(rng.random(3000), rng.random(3000) < 0.5, np.ones(3000, dtype=bool))
    beside = agree_elsewhere(points, misfit_px, hole, 2.0)
    return area, area.percent, area.polygons, missed, many, beside


def _lines_of_sight() -> Any:
    shears, at = sights.shears_of(4), hillsides.places(np.random.default_rng(1))
    height_m = hillsides.hillside(at, 10.0)
    displaced_px = hillsides.seen_otherwise(height_m, 6.0)
    return (
        implied_sight(shears, sights.by_model(sights.turned(12.0, 110.0), shears)),
        slope_of_growth(displaced_px, at, height_m, GSD_M),
    )


def _vanished_points() -> Any:
    rng = np.random.default_rng(4)
    found = rng.random((14, 80)) < rng.uniform(0.4, 0.9, 80)
    found[6:, :9], found[:, 9] = False, False
    return vanished_points(vanished.ground(rng, 80), vanished.searched(found, vanished.monthly(14)))


def _check_points() -> Any:
    scene = register(points_px=0.5)
    known = checks.check_points(scene, 30, 0.3, (0.4, -0.7))
    known = replace(known, sigma_m=np.tile([0.2, 0.3, np.nan], (30, 1)))
    known.sigma_px[::4] = np.nan
    return check_model(FlatModel(), scene.adjustment, known, Frame(UNEQUAL_M2))


WORLDS: dict[str, Callable[[], Any]] = {
    "block beside a neighbour": _block_beside_a_neighbour,
    "block of ortho-images": _block_of_ortho_images,
    "block of orbits": _block_of_orbits,
    "one image": _one_image,
    "block that bends": lambda: bent.bent_block(3)[0],
    "marks of several images": _marks_of_several_images,
    "noise of observations": _noise_of_observations,
    "frame on known ground": lambda: framed.drawn(np.random.default_rng(1), wrong=3),
    "frame on known positions": lambda: framed.drawn(
        np.random.default_rng(2), 7, 1, (True, True, False)
    ),
    "errors by control": _errors_by_control,
    "reach of sites": _reach_of_sites,
    "corrections": _corrections,
    "few marks": _few_marks,
    "qualifications": _qualifications,
    "marks in an image": _marks_in_an_image,
    "quality of a block": _quality_of_a_block,
    "errors at a site": _errors_at_a_site,
    "places that are held": _places_that_are_held,
    "lines of sight": _lines_of_sight,
    "vanished points": _vanished_points,
    "check points": _check_points,
}
"""What is computed, by its name."""
