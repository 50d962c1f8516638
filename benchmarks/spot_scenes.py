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
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.transform import from_origin
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.app.usecases.registered_scene import registered_scene
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import map_grid_of, open_raster, write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.geodesy import metres_per_degree_at, move_metres
from amers.services.imagery.source import ArrayImage, Window
from amers.services.orthorectification.rectify import orthorectify
from amers.services.quality.accuracy import accuracy
from amers.services.quality.correction_accuracy import in_rings
from amers.services.sensors.base import SensorModel
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.types import Array, Frame
from benchmarks._measuring import keep, open_folder, print_table
from benchmarks._worlds import Block, Place, block_of, world_of

METADATA = Path("rigorous_metadata") / "spot1-5_dimap" / "SP2_METADATA.DIM"
GSD_M, PART = 10.0, 2400
"""Of the scene, and lines and samples of its middle, which is rendered; the rest has no data."""
ERRORS = {
    "roll": 120e-6,
    "pitch": 120e-6,
    "yaw": 200e-6,
    "roll drift": 5e-6,
    "pitch drift": 5e-6,
    "yaw drift": 20e-6,
    "along track": 100.0,
    "across track": 100.0,
    "radial": 50.0,
    "focal length": 50e-6,
    "anisotropy": 30e-6,
}
"""Standard deviations of the errors of the metadata, radians, metres and shares: about half of what the
published sets of parameters allow, 150 m on the ground; drifts also where a set has none."""
SQUARE = 96
"""Side of the squares of ortho-images that are compared, pixels."""
POINT_SIGMA_M = (1.5, 2.0)
"""Of the points, horizontal and up."""
_ROOF_M = 2.0
"""Height above the terrain from which on a place is a roof, or beside one."""
WAYS = (
    ("points", "RPC"),
    ("points", "srp"),
    ("points", "toutin"),
    ("points", "spot-hrv"),
    ("reference", "RPC"),
)
"""Control, and the model: an RPC, or a rigorous one with the set of its free parameters."""
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
        held_percent: share of the image with pixels that points hold.
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


@dataclass(frozen=True)
class _Truth:
    """Pixels (n, 2) of the delivered image and their ground (n, 3); the true model of its part."""

    line_sample: Array
    ground: Array
    model: PushbroomModel | None = None


def main() -> None:
    """Register all scenes in all ways, print the table, keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--kept", type=Path, help="folder of the block, used again; by default none")
    arguments = parser.parse_args()
    metadata = Path(os.environ["AMERS_REAL_DATA"]) / METADATA
    delivered = read_rigorous_model(metadata)
    place = _place(delivered)
    block = block_of(place, arguments.kept)
    rows: list[Row] = []
    with open_folder() as folder:
        control = {
            "points": ["--block", _write_points(folder / "block", block)],
            "reference": _write_reference(folder, place),
        }
        control["dem"] = control["reference"][2:6]
        for number in range(arguments.scenes):
            image, truth = _write_product(folder / f"scene_{number}", metadata, delivered, place, number)
            for name, way in WAYS:
                told = _register(image, control[name], way, folder / "out")
                row = _judged(image, truth, Case(number, name, way), told)
                if (name, way) == USED:
                    made = image, truth, told, control["dem"]
                    row = replace(row, vectors=_vectors(*made), ortho_m=_ortho_m(*made))
                rows.append(row)
                print(rows[-1], f"{rows[-1].ratio:.2f}", flush=True)
    keep("spot_scenes", [asdict(row) | {"ratio": row.ratio} for row in rows])
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


def _first(model: PushbroomModel) -> tuple[float, float]:
    """Line and sample where the rendered part of an image begins."""
    lines, samples = model.image_shape
    return float((lines - PART) // 2), float((samples - PART) // 2)


def _place(model: PushbroomModel) -> Place:
    """A world under the middle of the scene."""
    middle = (np.array([model.image_shape], dtype=np.float64) - 1.0) / 2.0
    lon, lat, _ = model.locate(middle, np.array([200.0]))[0].tolist()
    gsds_m = (GSD_M, GSD_M)
    return Place("spot_2", 91, 30_000.0, 8.0, 500.0, 0.2, gsds_m, PART, 26, (lon, lat))


def _write_points(folder: Path, block: Block) -> Path:
    """A block whose points have errors as they state."""
    rng = np.random.default_rng(5)
    points, chips = block.points, block.chips
    sigma_m = np.array([POINT_SIGMA_M[0], POINT_SIGMA_M[0], POINT_SIGMA_M[1]])
    moved = move_metres(points.lon_lat_h, sigma_m * rng.standard_normal((len(points), 3)))
    covariance = np.broadcast_to(np.diag(sigma_m**2), (len(points), 3, 3)).copy()
    stated = replace(
        points, lon_lat_h=moved, covariance_m2=covariance, frames=(Frame.from_sigmas(0.5, 0.5),)
    )
    views = np.diff(points.views.start)
    low, high = moved[:, :2].min(axis=0), moved[:, :2].max(axis=0)
    metadata = BlockMetadata(
        id="spot-2",
        version="1",
        title="Points of a simulated world",
        description="",
        license="",
        extent=np.array([low, [high[0], low[1]], high, [low[0], high[1]]]),
        created=datetime(2024, 7, 1, tzinfo=UTC),
        specification=BlockSpecification((2.0, 20.0), 4),
        provenance=Provenance("benchmarks", "1", tuple(i.image_id for i in points.views.images), {}),
        frame=stated.frames[0],
    )
    write_block(
        folder,
        metadata,
        stated,
        lambda row: chips[points.chip_row[row] : points.chip_row[row] + views[row]],
        {},
    )
    return folder


def _write_reference(folder: Path, place: Place) -> list[object]:
    """Options of a reference: a true ortho-image of the world of another day, and its terrain."""
    world = world_of(place)
    plan = ViewPlan(
        "reference",
        place.centre_lon_lat,
        (2900, 2900),
        GSD_M,
        8.0,
        100.0,
        datetime(1998, 6, 2, 9, 0, tzinfo=UTC),
    )
    geometry = plan_geometry(world, plan, np.random.default_rng(3))
    pixels = TiledView(world, geometry, 17).read(Window(0, 0, *plan.shape))
    write_raster(folder / "reference.tif", pixels.astype(np.uint16), geometry.rpc)
    half, nodes = 0.26, 1821
    lon, lat = place.centre_lon_lat
    axes = np.linspace(-half, half, nodes)
    lon_lat = np.stack(np.meshgrid(lon + axes, lat - axes), axis=-1).reshape(-1, 2)
    heights = world.height_m(lon_lat).reshape(nodes, nodes).astype(np.float32)
    step = axes[1] - axes[0]
    size = {"height": nodes, "width": nodes, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    corner = from_origin(lon - half - step / 2.0, lat + half + step / 2.0, step, step)
    with rasterio.open(folder / "dem.tif", "w", driver="GTiff", transform=corner, **size) as file:
        file.write(heights, 1)
    dem = ["--dem", folder / "dem.tif", "--vertical", "ellipsoid"]
    _run("scene", "ortho", folder / "reference.tif", *dem, "-o", folder / "ortho.tif")
    return ["--reference", folder / "ortho.tif", *dem, "--reference-sigma-m", "1.0"]


def _write_product(
    folder: Path, metadata: Path, delivered: PushbroomModel, place: Place, number: int
) -> tuple[Path, _Truth]:
    """A product of which the middle is rendered, and what its pixels show."""
    folder.mkdir()
    rng = np.random.default_rng([7, number])
    terms = np.array([ERRORS.get(name, 0.0) for name in TERMS]) * rng.standard_normal(len(TERMS))
    first, shape = _first(delivered), (PART, PART)
    true_model = PushbroomErrors(delivered).corrected(terms).cropped(first, shape)
    lon, lat = place.centre_lon_lat
    plan = ViewPlan(
        "spot_2", (lon, lat), shape, GSD_M, acquired_at=datetime(1998, 8, 20, 9, 0, tzinfo=UTC)
    )
    world = world_of(place)
    planned = plan_geometry(world, plan, np.random.default_rng(number))
    rpc = fit_rpc(true_model, shape, world.height_range_m).model
    geometry = replace(planned, true_model=true_model, rpc=rpc, delivered=rpc)
    pixels = np.zeros(delivered.image_shape, dtype=np.uint8)
    begin, end = np.array(first, dtype=int), np.array(first, dtype=int) + PART
    seen = TiledView(world, geometry, 1000 + number).read(Window(0, 0, PART, PART))
    scaled = 1.0 + 250.0 * (seen - np.nanmin(seen)) / np.quantile(seen - np.nanmin(seen), 0.999)
    pixels[begin[0] : end[0], begin[1] : end[1]] = np.clip(np.rint(scaled), 1, 254).astype(np.uint8)
    image = folder / "IMAGERY.TIF"
    write_raster(image, pixels)
    with rasterio.open(image, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
        file.nodata = 0
    shutil.copyfile(metadata, folder / "METADATA.DIM")
    axes = np.linspace(0.0, PART - 1.0, 40)
    places = np.stack(np.meshgrid(axes, axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return image, _Truth(places + first, surface_seen(world, true_model, places), true_model)


def _register(image: Path, control: list[object], way: str, folder: Path) -> Path:
    """The folder of a registration by the command line."""
    shutil.rmtree(folder, ignore_errors=True)
    if way == "RPC":
        _run("scene", "register", image, *control, "-o", folder, refused=True)
        return folder
    _run("scene", "register-many", image, *control, "--rigorous", way, "-o", folder, refused=True)
    return next(folder.glob("*/correction.json"), folder / "correction.json").parent


def _judged(image: Path, truth: _Truth, case: Case, folder: Path) -> Row:
    """One registration, judged by its files."""
    before_m = _ce90_m(read_rigorous_model(image.with_name("METADATA.DIM")), truth)
    if not (folder / "correction.json").exists():
        return Row(case, "refused", 0.0, before_m, *[np.nan] * 3)
    report = json.loads((folder / "report.json").read_text())
    scene, _ = registered_scene(ImageFiles(image), folder)
    held = in_rings([np.array(ring) for ring in report["coverage"]["outline"]], truth.line_sample)
    there = _Truth(truth.line_sample[held], truth.ground[held])
    return Row(
        case,
        report["verdict"],
        float(report["coverage"]["percent"]),
        before_m,
        _ce90_m(scene.model, there),
        float(report["predicted"]["overall_m"]),
        float(report["relative_to_control_points"]["ce90_m"]),
    )


def _vectors(image: Path, truth: _Truth, registered: Path, dem: list[object]) -> float:
    """True over stated CE90 of points drawn on the scene, of those on the terrain that points hold."""
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
    _run("vectors", "correct", drawn, *of_scene, *dem, "--to", "EPSG:4326", "-o", output)
    found = json.loads(output.read_text())["features"]
    stated_m = np.array([one["properties"]["ce90_m"] or np.nan for one in found], dtype=np.float64)
    ground = np.array([one["geometry"]["coordinates"] for one in found])
    off_m = np.hypot(*((ground - truth.ground)[:, :2] * metres_per_degree_at(truth.ground)).T)
    # Roofs are not in the terrain.
    known = np.isfinite(stated_m) & (np.abs(ground[:, 2] - truth.ground[:, 2]) < _ROOF_M)
    return float(np.quantile(off_m[known], 0.9) / np.median(stated_m[known]))


def _ortho_m(image: Path, truth: _Truth, registered: Path, dem: list[object]) -> float:
    """CE90 of an ortho-image by the displacements of its squares against one through the true model."""
    output = registered / "ortho.tif"
    _run("scene", "ortho", image, "--registered", registered, *dem, "--gsd-m", GSD_M, "-o", output)
    made = open_raster(output)
    grid = map_grid_of(made)
    pixels = made.read(Window(0, 0, *made.shape))
    assert grid is not None
    assert truth.model is not None
    scene = read_scene(image, sigma_m=1.0)
    first = truth.line_sample.min(axis=0).astype(int)
    part = ArrayImage(scene.image.read(Window(int(first[0]), int(first[1]), PART, PART)))
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


def _ce90_m(model: SensorModel, truth: _Truth) -> float:
    """True CE90 of a model, metres on the ground."""
    error_px = model.project(truth.ground) - truth.line_sample
    derivative = model.project_derivative(truth.ground)[:, :, :2]
    return accuracy(np.linalg.solve(derivative, error_px[:, :, None])[:, :, 0]).ce90_m.value


def _run(*words: object, refused: bool = False) -> None:
    """Run a command; its failure is told, or ends the benchmark."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exit_code and not refused:
        raise SystemExit(f"{words}: {result.output}{result.exception}")
    if result.exit_code:
        print(f"{words[:2]}: {result.exception or result.output}", flush=True)


if __name__ == "__main__":
    main()
