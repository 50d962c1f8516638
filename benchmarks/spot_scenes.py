"""Scenes of SPOT 2 with real orbit and attitude, rendered, registered with every model and judged.

Needs AMERS_REAL_DATA for the metadata of a scene over Turkey: ephemerides, attitude speeds, look angles.
The pixels are rendered of a simulated world there, through that model with errors of orbit, attitude and
focal length as SPOT 2 has them. A product under its delivered names (IMAGERY.TIF, METADATA.DIM) is then
registered by the command line, on points and on a reference ortho-image: with an RPC fitted to the
metadata, and with each set of free orbit and attitude. What its files say is compared with the truth at
places all over the area for which accuracy is stated. Run: python -m benchmarks.spot_scenes [--scenes 4]
"""

import argparse
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from amers.app.usecases.registered_scene import registered_scene
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.images.raster import map_grid_of, open_raster
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.geodesy import metres_per_degree_at
from amers.services.imagery.source import ArrayImage, Window
from amers.services.orthorectification.rectify import orthorectify
from amers.services.quality.correction_accuracy import in_rings
from benchmarks._continent_points import PointVerdict
from benchmarks._measuring import keep, open_folder, print_table
from benchmarks._spot import (
    GSD_M,
    METADATA,
    PART,
    SECOND,
    Truth,
    ce90_m,
    place_of,
    run,
    write_points,
    write_product,
    write_reference,
)
from benchmarks._spot_production import judged_block, produce
from benchmarks._spot_service import spot_service
from benchmarks._worlds import block_of

SQUARE = 96
"""Side of the squares of ortho-images that are compared, pixels."""
_ROOF_M = 2.0
"""Height above the terrain from which on a place is a roof, or beside one."""
WAYS = (
    ("points", "RPC"),
    ("points", "srp"),
    ("points", "toutin"),
    ("points", "spot-hrv"),
    ("reference", "RPC"),
    ("points", "RPC, uploaded"),
    ("reference", "RPC, uploaded"),
)
"""Control, and the model: an RPC, by command or by a service, or a set of free rigorous parameters."""
USED = ("points", "RPC")
"""The registration with which vectors are corrected and an ortho-image is made."""


@dataclass(frozen=True)
class Case:
    """A scene by its number, the control ("points", "reference"), and the model (see `WAYS`)."""

    scene: int
    control: str
    way: str


@dataclass(frozen=True)
class Row:
    """One scene, registered in one way.

    Attributes:
        case: what was registered, and how.
        verdict: of the report; "refused" without one.
        held_percent: share of the image with pixels that points support.
        before_m: CE90 of the delivered model.
        ce90_m: true CE90, over the area for which accuracy is stated.
        stated_m: CE90 stated over that area (median), relative to the control points.
        worst_m: CE90 stated for its worst place.
        vectors: true over stated CE90 of vertices drawn on the scene, median of those with an accuracy.
        ortho_m: CE90 of an ortho-image against one through the true model, by their pixels.
    """

    case: Case
    verdict: str
    held_percent: float
    before_m: float
    ce90_m: float
    stated_m: float
    worst_m: float
    vectors: float = float("nan")
    ortho_m: float = float("nan")

    @property
    def ratio(self) -> float:
        """True over stated."""
        return self.ce90_m / self.stated_m


def main() -> None:
    """Register all scenes in all ways, produce a block of two, print the tables, keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--kept", type=Path, help="folder of the block, used again; by default none")
    arguments = parser.parse_args()
    metadata = Path(os.environ["AMERS_REAL_DATA"]) / METADATA
    place = place_of(read_rigorous_model(metadata))
    block = block_of(place, arguments.kept)
    with open_folder() as folder:
        control = {
            "points": ["--block", write_points(folder / "block", block)],
            "reference": write_reference(folder, place),
        }
        products = [
            write_product(folder / f"scene_{number}", metadata, place, number)
            for number in range(arguments.scenes)
        ]
        rows = _registered(folder, products, control)
        second = write_product(folder / "second", metadata.with_name(SECOND.name), place, 100)
        produced = _produced(folder, [products[0], second])
    scenes = [asdict(row) | {"ratio": row.ratio} for row in rows]
    keep("spot_scenes", {"scenes": scenes, "production": {k: asdict(v) for k, v in produced.items()}})
    of_points: dict[str, Callable[[str], object]] = {
        "control": lambda name: name,
        "points": lambda name: produced[name].points,
        "judged": lambda name: produced[name].judged,
        "CE90, LE90": lambda name: f"{produced[name].ce90_m:.2f}, {produced[name].le90_m:.2f}",
        "stated": lambda name: (
            f"{produced[name].declared_ce90_m:.2f}, {produced[name].declared_le90_m:.2f}"
        ),
        "relative": lambda name: (
            f"{produced[name].relative_ce90_m:.2f}, {produced[name].relative_le90_m:.2f}"
        ),
        "relative, stated": lambda name: (
            f"{produced[name].declared_relative_ce90_m:.2f}, "
            f"{produced[name].declared_relative_le90_m:.2f}"
        ),
    }
    print_table("Points of two images of SPOT 2, metres", produced, of_points)
    columns: dict[str, Callable[[Row], object]] = {
        "scene": lambda row: row.case.scene,
        "control": lambda row: row.case.control,
        "model": lambda row: row.case.way,
        "verdict": lambda row: row.verdict,
        "held, %": lambda row: f"{row.held_percent:.0f}",
        "before": lambda row: f"{row.before_m:.0f}",
        "true": lambda row: f"{row.ce90_m:.2f}",
        "stated": lambda row: f"{row.stated_m:.2f}",
        "worst place": lambda row: f"{row.worst_m:.2f}",
        "true / stated": lambda row: f"{row.ratio:.2f}",
        "vectors": lambda row: f"{row.vectors:.2f}",
        "ortho": lambda row: f"{row.ortho_m:.2f}",
    }
    print_table("SPOT 2, CE90 in metres", rows, columns)


def _registered(
    folder: Path, products: Sequence[tuple[Path, Truth]], control: dict[str, list[object]]
) -> list[Row]:
    """Every product registered in every way."""
    rows = []
    with spot_service(folder, folder / "block", control["reference"]) as service:
        for number, (image, truth) in enumerate(products):
            for name, way in WAYS:
                if way.endswith("uploaded"):
                    told = service.register(image, name, folder / "out")
                else:
                    told = _register(image, control[name], way, folder / "out")
                row = _judged(image, truth, Case(number, name, way), told)
                if (name, way) == USED:
                    made = image, truth, told, control["reference"][2:6]
                    row = replace(row, vectors=_vectors(*made), ortho_m=_ortho_m(*made))
                rows.append(row)
                print(row, f"{row.ratio:.2f}", flush=True)
    return rows


def _produced(folder: Path, products: Sequence[tuple[Path, Truth]]) -> dict[str, PointVerdict]:
    """Blocks of products by their delivered names, without control and on points."""
    images = [image for image, _ in products]
    made_of = {scene_name(image): (_part(image, truth), truth.model) for image, truth in products}
    ways = {"none": [], "points": ["--control", folder / "block"]}
    verdicts = {}
    for name, words in ways.items():
        verdicts[name] = judged_block(produce(images, words, folder / f"of_two_{name}"), made_of)
        print(name, verdicts[name], flush=True)
    return verdicts


def _part(image: Path, truth: Truth) -> ArrayImage:
    """The rendered part of a product."""
    line, sample = truth.line_sample.min(axis=0).astype(int).tolist()
    return ArrayImage(read_scene(image, sigma_m=1.0).image.read(Window(line, sample, PART, PART)))


def _register(image: Path, control: list[object], way: str, folder: Path) -> Path:
    """The folder of a registration by the command line."""
    shutil.rmtree(folder, ignore_errors=True)
    if way == "RPC":
        run("scene", "register", image, *control, "-o", folder, refused=True)
        return folder
    run("scene", "register-many", image, *control, "--rigorous", way, "-o", folder, refused=True)
    return next(folder.glob("*/correction.json"), folder / "correction.json").parent


def _judged(image: Path, truth: Truth, case: Case, folder: Path) -> Row:
    """One registration, judged by its files."""
    before_m = ce90_m(read_rigorous_model(image.with_name("METADATA.DIM")), truth)
    if not (folder / "correction.json").exists():
        return Row(case, "refused", 0.0, before_m, *[np.nan] * 3)
    report = json.loads((folder / "report.json").read_text())
    scene, _ = registered_scene(ImageFiles(image), folder)
    held = in_rings([np.array(ring) for ring in report["coverage"]["outline"]], truth.line_sample)
    there = Truth(truth.line_sample[held], truth.ground[held])
    return Row(
        case,
        report["verdict"],
        float(report["coverage"]["percent"]),
        before_m,
        ce90_m(scene.model, there),
        float(report["predicted"]["overall_m"]),
        float(report["relative_to_control_points"]["ce90_m"]),
    )


def _vectors(image: Path, truth: Truth, registered: Path, dem: list[object]) -> float:
    """True over stated CE90 of points drawn on the scene, on the terrain that points support."""
    places = [{"type": "Point", "coordinates": place[::-1]} for place in truth.line_sample.tolist()]
    features = [{"type": "Feature", "properties": {}, "geometry": place} for place in places]
    drawn, output = registered / "drawn.geojson", registered / "map.geojson"
    drawn.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    of_scene = [
        "--scene",
        image,
        "--registration",
        registered,
        "--pixels",
        "centre",
        "--sigma-px",
        "0.01",
    ]
    run("vectors", "correct", drawn, *of_scene, *dem, "--to", "EPSG:4326", "-o", output)
    found = json.loads(output.read_text())["features"]
    stated_m = np.array([one["properties"]["ce90_m"] or np.nan for one in found], dtype=np.float64)
    ground = np.array([one["geometry"]["coordinates"] for one in found])
    off_m = np.hypot(*((ground - truth.ground)[:, :2] * metres_per_degree_at(truth.ground)).T)
    # Roofs are not in the terrain.
    known = np.isfinite(stated_m) & (np.abs(ground[:, 2] - truth.ground[:, 2]) < _ROOF_M)
    return float(np.quantile(off_m[known], 0.9) / np.median(stated_m[known]))


def _ortho_m(image: Path, truth: Truth, registered: Path, dem: list[object]) -> float:
    """CE90 of an ortho-image by the displacements of its squares against one through the true model."""
    output = registered / "ortho.tif"
    run("scene", "ortho", image, "--registered", registered, *dem, "--gsd-m", GSD_M, "-o", output)
    made = open_raster(output)
    grid = map_grid_of(made)
    pixels = made.read(Window(0, 0, *made.shape))
    assert grid is not None
    assert truth.model is not None
    part = _part(image, truth)
    ground = read_terrain(TerrainFile(Path(str(dem[1])), "ellipsoid"))
    true = np.full(made.shape, np.nan, dtype=np.float32)
    for one in orthorectify([part], truth.model, ground, grid):
        w = one.window
        true[w.line : w.line + w.lines, w.sample : w.sample + w.samples] = one.pixels[0]
    off = []
    for line in range(0, made.shape[0] - SQUARE, SQUARE):
        for sample in range(0, made.shape[1] - SQUARE, SQUARE):
            squares = [full[line : line + SQUARE, sample : sample + SQUARE] for full in (pixels, true)]
            if all(np.isfinite(square).all() for square in squares):
                window = cv2.createHanningWindow((SQUARE, SQUARE), cv2.CV_32F)
                shift, _ = cv2.phaseCorrelate(*squares, window)
                off.append(np.hypot(*shift) * GSD_M)
    return float(np.quantile(off, 0.9))


if __name__ == "__main__":
    main()
