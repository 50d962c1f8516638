"""SPOT 2 with real orbit and attitude: a world below it, its control, and products rendered of it."""

import shutil
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rigorous_model import read_rigorous_model
from amers.services.geodesy import move_metres
from amers.services.imagery.source import Window
from amers.services.quality.accuracy import accuracy
from amers.services.sensors.base import SensorModel
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.types import Array, Frame
from benchmarks._worlds import Block, Place, world_of

_OF_SPOT = Path("rigorous_metadata") / "spot1-5_dimap"
METADATA = _OF_SPOT / "SP2_METADATA.DIM"
SECOND = _OF_SPOT / "SPOT2.DIM"
"""Of another pass over the same ground: 5 degrees off the vertical; the first is 37 degrees off."""
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
POINT_SIGMA_M = (1.5, 2.0)
"""Of the points, horizontal and up."""


@dataclass(frozen=True)
class Truth:
    """Pixels (n, 2) of the delivered image and their ground (n, 3); the true model of its part."""

    line_sample: Array
    ground: Array
    model: PushbroomModel | None = None


def first_pixel(model: PushbroomModel, place: Place) -> tuple[float, float]:
    """Line and sample where the rendered part of an image begins."""
    lon, lat = place.centre_lon_lat
    line, sample = np.round(model.project(np.array([[lon, lat, 200.0]]))[0] + 0.5 - PART / 2.0).tolist()
    return line, sample


def place_of(model: PushbroomModel) -> Place:
    """A world under the middle of the scene."""
    middle = (np.array([model.image_shape], dtype=np.float64) - 1.0) / 2.0
    lon, lat, _ = model.locate(middle, np.array([200.0]))[0].tolist()
    gsds_m = (GSD_M, GSD_M)
    return Place("spot_2", 91, 30_000.0, 8.0, 500.0, 0.2, gsds_m, PART, 26, (lon, lat))


def write_points(folder: Path, block: Block) -> Path:
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


def write_reference(folder: Path, place: Place) -> list[object]:
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
    run("scene", "ortho", folder / "reference.tif", *dem, "-o", folder / "ortho.tif")
    return ["--reference", folder / "ortho.tif", *dem, "--reference-sigma-m", "1.0"]


def write_product(folder: Path, metadata: Path, place: Place, number: int) -> tuple[Path, Truth]:
    """A product of which the part over a place is rendered, and what its pixels show."""
    folder.mkdir()
    delivered = read_rigorous_model(metadata)
    rng = np.random.default_rng([7, number])
    terms = np.array([ERRORS.get(name, 0.0) for name in TERMS]) * rng.standard_normal(len(TERMS))
    first, shape = first_pixel(delivered, place), (PART, PART)
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
    return image, Truth(places + first, surface_seen(world, true_model, places), true_model)


def ce90_m(model: SensorModel, truth: Truth) -> float:
    """True CE90 of a model, metres on the ground."""
    error_px = model.project(truth.ground) - truth.line_sample
    derivative = model.project_derivative(truth.ground)[:, :, :2]
    return accuracy(np.linalg.solve(derivative, error_px[:, :, None])[:, :, 0]).ce90_m.value


def run(*words: object, refused: bool = False) -> None:
    """Run a command; its failure is told, or ends the benchmark."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exit_code and not refused:
        raise SystemExit(f"{words}: {result.output}{result.exception}")
    if result.exit_code:
        print(f"{words[:2]}: {result.exception or result.output}", flush=True)
