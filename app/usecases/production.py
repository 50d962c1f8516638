"""Making a block of points: read images or an ortho-image, call the science, write the block folder."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from app.errors import InputError
from app.usecases.orthorectification import TerrainFile
from app.usecases.registration.reference_source import HEIGHT_SIGMA_POSTINGS
from services.formats.block.document import AccuracyFigure, BlockMetadata, BlockSpecification, Provenance
from services.formats.block.writer import write_block
from services.formats.elevation.dem import read_dem
from services.formats.images.bands import parse_bands
from services.formats.images.scenes import read_scene
from services.imagery.scene import Scene
from services.production.from_images import Production, ProductionOptions, produce_points
from services.production.from_ortho import (
    GroundHeights,
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
)
from services.sensors.correction import fold_into_rpc
from services.sensors.rpc import RpcModel
from services.types import Progress, no_progress


@dataclass(frozen=True)
class BlockIdentity:
    """How a new block is called.

    Attributes:
        id: name of the block, a letter then letters, digits, dots, dashes, underscores.
        version: one block is one version.
        title: for people.
        license: of the points and chips, an SPDX identifier or "proprietary".
    """

    id: str
    version: str = "1"
    title: str = ""
    license: str = "proprietary"


@dataclass(frozen=True)
class OrthoFiles:
    """An ortho-image on the disk, and how high its ground lies.

    Attributes:
        image: GeoTIFF (or COG) or JPEG 2000 on a map.
        terrain: heights of its ground; None takes `flat_m` everywhere.
        flat_m: metres above the ellipsoid.
        height_sigma_m: of these heights, one standard deviation; has to be given with a flat one.
        sigma_m: accuracy of the image on the map; by default what is known of its sensor.
        bands: see `services.formats.images.bands.parse_bands`.
        mask: image of the same ground, not zero where no point shall be.
    """

    image: Path
    terrain: TerrainFile | None = None
    flat_m: float | None = None
    height_sigma_m: float | None = None
    sigma_m: float | None = None
    bands: str | None = None
    mask: Path | None = None


def run_production(
    images: Sequence[Path],
    folder: Path,
    identity: BlockIdentity,
    options: ProductionOptions = ProductionOptions(),
    sigma_m: float | None = None,
    progress: Progress = no_progress,
) -> Production:
    """Make a block of points out of images and write its folder.

    Args:
        images: two or more; what lies beside them is looked at for their models.
        folder: of the block; must not exist.
        identity: name, version and title of the block.
        options: of the production.
        sigma_m: accuracy of the images' models, metres; by default what producer or sensor says.
        progress: told where the work stands.

    Raises:
        InputError: an image cannot be used, or the folder exists.
        ComputationError: the images do not make a block.
    """
    _refuse_existing(folder)
    with ExitStack() as stack:
        scenes = [read_scene(path, sigma_m=sigma_m) for path in images]
        for scene in scenes:
            stack.callback(scene.image.close)  # type: ignore[attr-defined]
        production = produce_points(scenes, options, lambda f, m: progress(0.9 * f, m))
        write_block(
            folder,
            _metadata(identity, scenes, production, options),
            production.points,
            production.chips,
            _models(scenes, production),
            progress=lambda f, m: progress(0.9 + 0.1 * f, m),
        )
    return production


def run_ortho_production(
    files: OrthoFiles,
    folder: Path,
    identity: BlockIdentity,
    options: OrthoPointOptions = OrthoPointOptions(),
    progress: Progress = no_progress,
) -> OrthoPoints:
    """Make a block of points out of one ortho-image and write its folder.

    Args:
        files: the image and its heights.
        folder: of the block; must not exist.
        identity: name, version and title of the block.
        options: of the points.
        progress: told where the work stands.

    Raises:
        InputError: the image or its heights cannot be used, or the folder exists.
        ComputationError: too little of the image makes points.
    """
    _refuse_existing(folder)
    heights = _heights(files)
    bands = None if files.bands is None else parse_bands(files.bands)
    with ExitStack() as stack:
        scene = read_scene(files.image, sigma_m=files.sigma_m, bands=bands, mask=files.mask)
        stack.callback(scene.image.close)  # type: ignore[attr-defined]
        made = produce_ortho_points(scene, heights, options, lambda f, m: progress(0.7 * f, m))
        write_block(
            folder,
            _ortho_metadata(identity, scene, made, options),
            made.points,
            made.chips,
            {},
            progress=lambda f, m: progress(0.7 + 0.3 * f, m),
        )
    return made


def _heights(files: OrthoFiles) -> GroundHeights:
    if (files.terrain is None) == (files.flat_m is None):
        raise InputError("heights of the ground: expected either a terrain or one flat height")
    if files.terrain is not None:
        asked = files.terrain
        terrain = read_dem(asked.dem, asked.vertical, asked.geoid, asked.fill_px)
        sigma_m = files.height_sigma_m or HEIGHT_SIGMA_POSTINGS * terrain.posting_m
        return GroundHeights(terrain, 0.0, sigma_m)
    if files.flat_m is None or files.height_sigma_m is None:
        raise InputError("one flat height: expected its standard deviation beside it, in metres")
    return GroundHeights(None, files.flat_m, files.height_sigma_m)


def _refuse_existing(folder: Path) -> None:
    if folder.exists():
        raise InputError(f"{folder}: exists already; a block is written once")


def _models(scenes: Sequence[Scene], production: Production) -> dict[str, RpcModel]:
    """The adjusted model of every image, by the image's name."""
    models = {}
    for scene, corrected in zip(scenes, production.adjustment.models, strict=True):
        assert isinstance(corrected.base, RpcModel)
        models[scene.acquisition.image_id] = fold_into_rpc(corrected.base, corrected.correction)
    return models


def _metadata(
    identity: BlockIdentity, scenes: Sequence[Scene], production: Production, options: ProductionOptions
) -> BlockMetadata:
    relative, n_points = production.relative_accuracy, len(production.points)
    days = [s.acquisition.acquired_at for s in scenes if s.acquisition.acquired_at is not None]
    spacing_km = None if options.spacing_m is None else options.spacing_m / 1000.0
    return BlockMetadata(
        id=identity.id,
        version=identity.version,
        title=identity.title or identity.id,
        description=f"{n_points} ground control points with chips, from {len(scenes)} images",
        license=identity.license,
        extent=production.outline,
        created=datetime.now(UTC),
        specification=BlockSpecification(
            gsds_m=(options.fine_gsd_m, options.coarse_gsd_m),
            min_views=options.min_views,
            points_per_km2=None if spacing_km is None else spacing_km**-2.0,
        ),
        provenance=Provenance(
            software="amers",
            version=version("amers"),
            sources=tuple(s.acquisition.image_id for s in scenes),
            options=asdict(options),
        ),
        epoch=None if not days else _decimal_year(max(days)),
        accuracy=(
            AccuracyFigure(
                "relative",
                "ray_residual_median_px",
                relative.refined_px,
                n_points,
                "the rays of the block's own images",
            ),
            AccuracyFigure(
                "absolute",
                "frame_sigma_m",
                relative.frame_sigma_m,
                len(scenes),
                "the stated accuracy of the images' models, not measured",
            ),
        ),
    )


def _ortho_metadata(
    identity: BlockIdentity, scene: Scene, made: OrthoPoints, options: OrthoPointOptions
) -> BlockMetadata:
    taken, n_points = scene.acquisition, len(made.points)
    spacing_km = None if options.spacing_m is None else options.spacing_m / 1000.0
    return BlockMetadata(
        id=identity.id,
        version=identity.version,
        title=identity.title or identity.id,
        description=f"{n_points} ground control points with chips, from one ortho-image",
        license=identity.license,
        extent=made.outline,
        created=datetime.now(UTC),
        specification=BlockSpecification(
            gsds_m=made.gsds_m,
            min_views=1,
            points_per_km2=None if spacing_km is None else spacing_km**-2.0,
        ),
        provenance=Provenance(
            software="amers",
            version=version("amers"),
            sources=(taken.image_id,),
            options=asdict(options),
        ),
        epoch=None if taken.acquired_at is None else _decimal_year(taken.acquired_at),
        accuracy=(
            AccuracyFigure(
                "absolute",
                "frame_sigma_m",
                scene.sigma_m,
                1,
                "the stated accuracy of the ortho-image, not measured",
            ),
        ),
    )


def _decimal_year(moment: datetime) -> float:
    start = datetime(moment.year, 1, 1, tzinfo=UTC)
    end = datetime(moment.year + 1, 1, 1, tzinfo=UTC)
    return round(moment.year + (moment - start) / (end - start), 3)
