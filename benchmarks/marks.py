"""A real scene on a few marks, beside what other programs make of the same marks.

Needs AMERS_REAL_DATA: one view of the triplet of Calanques, whose model is 40 px off; two other views
give the ground of some 700 details. Marks are details with errors of pick and ground; the others check.
*Mean shift* is the offset that OTB and many others estimate, *affine* the unweighted least squares with
the RPC, *polynomial* and *spline* what GDAL and the georeferencer of QGIS make of ground control points,
without the model. A minute.
Run: python -m benchmarks.marks [--draws 200]
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np
from rasterio.control import GroundControlPoint
from rasterio.transform import GCPTransformer

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.registration.on_marks import register_on_marks
from amers.services.registration.scene_marks import SceneMarks
from amers.services.sensors.correction import ImageCorrection, fold_into_rpc, no_correction
from amers.services.sensors.rpc import RpcModel
from amers.services.types import UNKNOWN_FRAME, Acquisition, Array
from benchmarks._measuring import keep, print_table
from tests.journeys.ties import KnownGround

OFF_PX = np.array([24.0, -32.0])
BLUNDER_PX = np.array([36.0, 48.0])
MODEL_SIGMA_M = 10.0
DETAIL_PX = 0.2
"""Of the details themselves: standard deviation of a coordinate about the affine of all of them."""
FEWEST_AFFINE = 3
CASES = (
    ("survey", (0.1, 0.1), 0.3, False),
    ("survey", (0.1, 0.1), 0.3, True),
    ("map", (3.0, 3.0), 0.5, False),
    ("half each", (0.1, 3.0), 0.3, False),
)
"""Name, sigmas of the ground of odd and even marks in metres, of the picks in pixels, and whether one
mark is 60 px off."""
COUNTS = (1, 2, 3, 8)


@dataclass(frozen=True)
class Drawn:
    """Marks of one draw: ground (n, 3), its sigmas (n,) in metres, picks (n, 2) and their sigma."""

    ground: Array
    sigma_m: Array
    picked: Array
    sigma_px: float


@dataclass(frozen=True)
class Row:
    """One kind and number of marks; a way without a result has none.

    Attributes:
        marks: kind of the marks.
        count: number of marks.
        blunder: whether one is 60 px off.
        rms_px: median over the draws of the rms at check points, by way.
        held: share of the errors of Amers' model at check points within its CE90.
        named: share of the draws with exactly the blunder rejected; with two, in doubt.
    """

    marks: str
    count: int
    blunder: bool
    rms_px: dict[str, float]
    held: float
    named: float


def main() -> None:
    """Print the table of all kinds and numbers of marks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    known = KnownGround.of_triplet(Path(os.environ["AMERS_REAL_DATA"]))
    draws = parser.parse_args().draws
    rows = [
        _row(known, name, sigmas, count, blunder=blunder, draws=draws)
        for name, *sigmas, blunder in CASES
        for count in COUNTS
        if not (blunder and count == 1)
    ]
    keep("marks", [asdict(row) for row in rows])
    ways = tuple(rows[-1].rms_px)
    columns: dict[str, Callable[[Row], object]] = {
        "marks": lambda row: row.marks + (", one wrong" if row.blunder else ""),
        "n": lambda row: row.count,
        **{way: lambda row, way=way: _shown(row.rms_px.get(way)) for way in ways},
        "in CE90": lambda row: f"{100.0 * row.held:.0f} %",
        "named": lambda row: f"{100.0 * row.named:.0f} %" if row.blunder else "",
    }
    print_table("Rms at check points, px, median of the draws", rows, columns)


def _row(known: KnownGround, name: str, sigmas: list, count: int, *, blunder: bool, draws: int) -> Row:
    (odd_m, even_m), sigma_px = sigmas
    rng = np.random.default_rng(count)
    model, truth = _models(known)
    errors: dict[str, list[float]] = {}
    held, named = [], []
    for _ in range(draws):
        rows = rng.permutation(len(known.ground))
        marks, rest = rows[:count], rows[count:]
        sigma_m = np.where(np.arange(count) % 2 == 0, odd_m, even_m)
        ground = move_metres(known.ground[marks], sigma_m[:, None] * rng.normal(size=(count, 3)))
        picked = known.shown[marks] + rng.normal(0.0, sigma_px, (count, 2))
        if blunder:
            picked[0] += BLUNDER_PX * np.sign(np.array(known.shape) / 2.0 - picked[0])
        drawn = Drawn(ground, sigma_m, picked, float(np.hypot(sigma_px, DETAIL_PX)))
        for way, shown in _others(model, drawn, known.ground[rest]).items():
            errors.setdefault(way, []).append(_rms(shown - truth[rest]))
        off_px, inside, rejected = _amers(known, model, drawn, truth, rest)
        errors.setdefault("Amers", []).append(off_px)
        held.append(inside)
        named.append(rejected)
    rms_px = {way: median(of_way) for way, of_way in errors.items()}
    return Row(name, count, blunder, rms_px, float(np.mean(held)), float(np.mean(named)))


def _models(known: KnownGround) -> tuple[RpcModel, Array]:
    """The model that is 40 px off, and where the details are by the affine correction of all of them."""
    frame = no_correction(known.shape)
    off = np.column_stack([OFF_PX, np.zeros((2, 2))])
    model = fold_into_rpc(known.model, ImageCorrection(off, frame.centre, frame.half_size))
    computed = model.project(known.ground)
    return model, computed + _affine(computed, known.shown - computed, computed)


def _affine(computed: Array, misfit: Array, at: Array) -> Array:
    """An affine displacement fitted to misfits (n, 2), at places (m, 2)."""
    middle = computed.mean(axis=0)
    design = np.column_stack([np.ones(len(computed)), computed - middle])
    parameters, *_ = np.linalg.lstsq(design, misfit, rcond=None)
    return np.asarray(np.column_stack([np.ones(len(at)), at - middle]) @ parameters)


def _others(model: RpcModel, drawn: Drawn, ground: Array) -> dict[str, Array]:
    """Image positions (m, 2) of ground (m, 3) by the ways of others."""
    computed, at = model.project(drawn.ground), model.project(ground)
    misfit = drawn.picked - computed
    out = {"as delivered": at, "mean shift": at + misfit.mean(axis=0)}
    if len(misfit) >= FEWEST_AFFINE:
        out["affine"] = at + _affine(computed, misfit, at)
        for name, is_spline in (("polynomial", False), ("spline", True)):
            out[name] = _without_model(drawn, ground, is_spline)
    return out


def _without_model(drawn: Drawn, ground: Array, is_spline: bool) -> Array:
    """Image positions (m, 2) by GDAL's transformations of ground control points."""
    points = [
        GroundControlPoint(line + 0.5, sample + 0.5, lon, lat)
        for (line, sample), (lon, lat, _) in zip(
            drawn.picked.tolist(), drawn.ground.tolist(), strict=True
        )
    ]
    with GCPTransformer(points, tps=is_spline) as transformer:
        rows, columns = transformer.rowcol(ground[:, 0], ground[:, 1], op=lambda value: value)
    return np.column_stack([rows, columns]).astype(float) - 0.5


def _amers(
    known: KnownGround, model: RpcModel, drawn: Drawn, truth: Array, rest: Array
) -> tuple[float, float, bool]:
    """Rms at the check points, share of them within the CE90, and whether the blunder is named."""
    count = len(drawn.picked)
    image = ArrayImage(np.ones(known.shape, np.float32))
    scene = Scene(image, model, Acquisition("img_02"), MODEL_SIGMA_M)
    marks = SceneMarks(
        names=tuple(f"GCP{k}" for k in range(count)),
        lon_lat_h=drawn.ground,
        line_sample=drawn.picked,
        sigma_m=np.tile(drawn.sigma_m[:, None], (1, 3)),
        sigma_px=np.full(count, drawn.sigma_px),
        frame=UNKNOWN_FRAME,
    )
    registration = register_on_marks(scene, marks)
    assert registration.marks is not None
    error = registration.model.project(known.ground[rest]) - truth[rest]
    ce90_px = registration.qualification.predicted.overall_px
    status = [mark.status for mark in registration.marks.marks]
    wanted = ["in doubt"] * 2 if count == 2 else ["rejected"] + ["used"] * (count - 1)
    return _rms(error), float((np.hypot(*error.T) <= ce90_px).mean()), status == wanted


def _rms(error: Array) -> float:
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def _shown(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


if __name__ == "__main__":
    main()
