"""Making a block of points: read images, call the science, write the block folder."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from app.errors import InputError
from services.formats.block import write_block
from services.formats.block_json import AccuracyFigure, BlockMetadata, BlockSpecification, Provenance
from services.formats.scenes import read_scene
from services.production import Production, ProductionOptions, produce_points
from services.scene import Scene
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
    if folder.exists():
        raise InputError(f"{folder}: exists already; a block is written once")
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
    relative, n_points = production.relative, len(production.points)
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


def _decimal_year(moment: datetime) -> float:
    start = datetime(moment.year, 1, 1, tzinfo=UTC)
    end = datetime(moment.year + 1, 1, 1, tzinfo=UTC)
    return round(moment.year + (moment - start) / (end - start), 3)
