"""Make a block of points from overlapping images: given as files, or chosen from a catalogue."""

import hashlib
import pickle
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

from amers.app.usecases.control_files import IMAGES_NPZ, ControlFiles, control_inputs, read_control
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.usecases.ground_classes import GroundFiles, read_ground
from amers.app.usecases.image_selection import ITEMS
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.new_block import BlockIdentity, block_metadata, points_per_km2, refuse_existing
from amers.app.usecases.registration.result_folder import older_result, replacing
from amers.app.usecases.report_files import write_report
from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.adjusted_images import write_adjusted_images
from amers.services.formats.block.document import AccuracyFigure, BlockMetadata, BlockSpecification
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.scenes import UNKNOWN_SIGMA_M, read_scene
from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.formats.stac.places import image_place
from amers.services.formats.stac.scenes import read_item_scene
from amers.services.formats.work_folder import WorkFolder
from amers.services.imagery.scene import Scene
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.reports.block_adjustment import adjustment_report, points_csv
from amers.services.reports.block_adjustment_pages import ADJUSTMENT_PAGE
from amers.services.sensors.refined import refined_rpc
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Subject, Use, gathered
from amers.services.tasks import Work
from amers.services.types import Progress, no_progress, part_of


@dataclass(frozen=True)
class ProductionImages:
    """The images of a production.

    Attributes:
        files: images with their models beside them or inside.
        selection: folder that `run_selection` has written; its images are added.
        sigma_m: accuracy of the images' models, metres; by default that of the producer or the sensor.
        ortho_sigma_m: the same of those that are ortho-images; by default `sigma_m`.
        sigmas_m: the same of single files.
        control: places the block on the Earth.
        ground: where no points are wanted, and what points stand on.
        models: of the files whose names and tags do not give them.
    """

    files: tuple[FilePlace, ...] = ()
    selection: Path | None = None
    sigma_m: float | None = None
    ortho_sigma_m: float | None = None
    sigmas_m: Mapping[FilePlace, float] = field(default_factory=dict)
    control: ControlFiles = field(default_factory=ControlFiles)
    ground: GroundFiles = field(default_factory=GroundFiles)
    models: ModelChoice = field(default_factory=ModelChoice)


@dataclass(frozen=True)
class WorkPlace:
    """Where the work is done.

    Attributes:
        folder: of the results of all tasks, so that an interrupted production continues; by default next
            to the block, until the block is complete.
        compute: processes or a cluster.
        most_bytes: that these results may take; None for any.
    """

    folder: Path | None = None
    compute: ComputeOptions = field(default_factory=ComputeOptions)
    most_bytes: int | None = None


def run_image_production(
    images: ProductionImages,
    folder: Path,
    identity: BlockIdentity,
    options: ProductionOptions = ProductionOptions(),
    *,
    place: WorkPlace = WorkPlace(),
    progress: Progress = no_progress,
) -> Production:
    """Make a block of points from overlapping images; write its folder, and FOLDER.adjustment.

    When the same production was interrupted, it goes on from where it was.

    Args:
        images: two or more.
        folder: of the block; must not exist.
        identity: of the block.
        options: of the production.
        place: of the work.
        progress: receives the fraction done and a message.

    Raises:
        InputError: an image cannot be used, the folder exists, the report cannot be written, or the
            work folder is that of another production.
        ComputationError: the images do not make a block.
    """
    refuse_existing(folder)
    report_folder = folder.with_name(f"{folder.name}.adjustment")
    older_result(report_folder)
    with ExitStack() as stack:
        scenes, files = _read(images, stack, part_of(progress, 0.0, 0.05))
        work_folder = place.folder or folder.with_name(f"{folder.name}.work")
        control = read_control(images.control, scenes, files, stack)
        ground = read_ground(images.ground)
        kept = WorkFolder(work_folder, _inputs(scenes, files, images, options), place.most_bytes)
        executor, ahead = stack.enter_context(open_executor(place.compute))
        work = Work(executor, kept, ahead)
        production = produce_points(
            scenes,
            options,
            part_of(progress, 0.05, 0.85),
            control=control,
            excluded=ground.excluded,
            work=work,
        )
        stated = chain(*(scene.statements for scene in scenes), control.statements, ground.statements)
        production = replace(production, statements=gathered(stated))
        if control.neighbour is None and len(production.control) == 0:
            production = _with_what_was_assumed(production, scenes)
        # Before the block, whose folder would refuse the run that makes up for a missing report.
        _write_report(report_folder, identity.id, production)
        write_block(
            folder,
            _metadata(identity, scenes, production, options, control.neighbour),
            production.points,
            production.chips,
            _adjusted_models(scenes, production),
            typology=ground.typology(production.points),
            progress=part_of(progress, 0.9, 0.1),
        )
    if place.folder is None:
        shutil.rmtree(work_folder)
    return production


def _with_what_was_assumed(production: Production, scenes: Sequence[Scene]) -> Production:
    """The production, whose frame names the accuracy that was assumed for images that state none."""
    unstated = sum(
        statement.subject is Subject.ACCURACY and statement.use is Use.ASSUMED
        for scene in scenes
        for statement in scene.statements
        if scene.sigma_m == UNKNOWN_SIGMA_M
    )
    if unstated == 0:
        return production
    assumed = (
        f"{UNKNOWN_SIGMA_M:g} m for the models of {unstated} of {len(scenes)} images, which state none; "
        "give --sigma-m or --control"
    )
    [frame] = production.points.frames
    points = replace(production.points, frames=(replace(frame, assumed=assumed),))
    return replace(production, points=points)


def _write_report(folder: Path, block: str, production: Production) -> None:
    """The report on the adjustment, in a folder of its own: a block holds nothing else than a block."""
    report = adjustment_report(
        block, production, finished_at=datetime.now(UTC), software_version=version("amers")
    )
    with replacing(folder) as new:
        write_report(new, ADJUSTMENT_PAGE, report)
        if production.adjustment.known is not None:
            write_adjusted_images(new / IMAGES_NPZ, block, production.adjustment.known)
        (new / "points.csv").write_text(points_csv(report), encoding="utf-8")


def _read(
    images: ProductionImages, stack: ExitStack, progress: Progress
) -> tuple[list[Scene], list[FilePlace]]:
    """The scenes of all images, open until the stack closes, and their files."""
    scenes: list[Scene] = []
    files = list(images.files)

    def add(scene: Scene) -> None:
        stack.callback(scene.image.close)  # type: ignore[attr-defined]
        scenes.append(scene)

    sigma_m, ortho_sigma_m, sigmas_m = images.sigma_m, images.ortho_sigma_m, images.sigmas_m
    chosen_models = images.models.of([path for path in images.files if isinstance(path, Path)])
    for path in images.files:
        model, origin = chosen_models[path] if isinstance(path, Path) else (None, None)
        own_m = sigmas_m.get(path)
        add(
            read_scene(
                path,
                model,
                sigma_m=own_m or sigma_m,
                ortho_sigma_m=own_m or ortho_sigma_m,
                crop_origin=origin,
            )
        )
    if images.selection is not None:
        source = images.selection / ITEMS
        chosen = read_catalogue(str(source), elsewhere=True)
        if chosen.bad:
            raise FormatError(
                f"{source}: {chosen.bad} chosen items cannot be used; the first: {chosen.problems[0]}"
            )
        masks = chosen.images.mask.tolist()
        for row, item in enumerate(chosen.items.read(range(len(masks)))):
            progress(row / len(masks), f"reading {len(masks)} images")
            add(
                read_item_scene(
                    item, str(source), masks[row], sigma_m=sigma_m, ortho_sigma_m=ortho_sigma_m
                )
            )
            files.append(image_place(item, str(source)))
    return scenes, files


def _inputs(
    scenes: Sequence[Scene],
    files: Sequence[FilePlace],
    given: ProductionImages,
    options: ProductionOptions,
) -> dict[str, Any]:
    """What the results of all tasks depend on."""
    return {
        "version": version("amers"),
        "images": [
            {
                "name": scene.acquisition.image_id,
                **_file_facts(file),
                "model": hashlib.sha256(pickle.dumps(scene.model)).hexdigest(),
                "sigma_m": scene.sigma_m,
            }
            for scene, file in zip(scenes, files, strict=True)
        ],
        "control": control_inputs(given.control),
        "ground": given.ground.inputs(),
        "options": asdict(options),
    }


def _file_facts(file: FilePlace) -> dict[str, Any]:
    """Which file it is, and what changes with its content."""
    if isinstance(file, Address):
        opened = file.open()
        return {"file": str(file), "bytes": opened.size, "version": opened.version}
    stat = file.stat()
    return {"file": str(file.resolve()), "bytes": stat.st_size, "modified": stat.st_mtime_ns}


def _adjusted_models(scenes: Sequence[Scene], production: Production) -> dict[str, RpcModel]:
    """The adjusted model of every image that an RPC expresses, by the image's name."""
    models = {}
    for scene, corrected in zip(scenes, production.adjustment.models, strict=True):
        refined = refined_rpc(corrected, scene.image.shape).model
        if refined is not None:
            models[scene.acquisition.image_id] = refined
    return models


def _metadata(
    identity: BlockIdentity,
    scenes: Sequence[Scene],
    production: Production,
    options: ProductionOptions,
    neighbour: KnownImages | None,
) -> BlockMetadata:
    relative, n_points = production.relative_accuracy, len(production.points)
    return block_metadata(
        identity,
        [scene.acquisition for scene in scenes],
        production.points,
        description=f"{n_points} ground control points with chips, from {len(scenes)} images",
        outline=production.outline,
        specification=BlockSpecification(
            gsds_m=production.gsds_m,
            min_views=options.min_views,
            points_per_km2=points_per_km2(options.spacing_m),
        ),
        options=asdict(options),
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
                relative.frame.sigma_m,
                len(scenes),
                _frame_source(production, neighbour),
            ),
        ),
    )


def _frame_source(production: Production, neighbour: KnownImages | None) -> str:
    """What places a block on the Earth."""
    stated = "the stated accuracy of the images' models"
    if neighbour is not None:
        names = {image.name for image in production.image_fits}
        stated = f"{len(names & set(neighbour.names))} images of a neighbouring block, and {stated}"
    if len(production.control) == 0:
        return stated if neighbour is not None else f"{stated}, not measured"
    sources = sorted({name.partition(":")[0] for name in production.control.names})
    used = int(production.adjustment.control_active.sum())
    return f"{used} control points of {', '.join(sources)}, and {stated}"
