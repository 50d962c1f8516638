"""Place a block on control that came later: its frame again, its points and chips as they are."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version as installed_version
from itertools import chain
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.control_files import ControlFiles, read_control
from amers.app.usecases.model_choice import CropOrigin, ModelChoice
from amers.app.usecases.new_block import refuse_existing
from amers.services.adjustment.frame_fit import FrameFit, fit_frame, misfits_m
from amers.services.formats.block.document import (
    AccuracyFigure,
    BlockDocument,
    BlockMetadata,
    Provenance,
)
from amers.services.formats.block.reader import BlockContents, FolderChips, block_member, read_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.formats.text_files import read_text
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.production.placed_block import (
    FoundControl,
    find_in_block,
    moved_model,
    moved_points,
)
from amers.services.quality.accuracy import Accuracy, NormalisedError, accuracy, normalised_error
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Statements, gathered
from amers.services.types import Array, ChipArray, ControlPoints, Frame, Progress, no_progress, part_of


@dataclass(frozen=True)
class PlacedBlock:
    """A block on its control.

    Attributes:
        points: after the translation.
        before: its frame as stated before.
        fit: the translation, and what is known of the frame now.
        control: names of the known ground.
        check: errors at the check points after the translation; None without any.
        normalised: of these errors, over what is declared; None without any.
        statements: of the files of the control, the check points and the images.
    """

    points: ControlPoints
    before: Frame
    fit: FrameFit
    control: tuple[str, ...]
    check: Accuracy | None
    normalised: NormalisedError | None
    statements: Statements = ()


_FOUND = ModelChoice()


def place_block(
    block: Path,
    images: Sequence[Path],
    control: ControlFiles,
    folder: Path,
    *,
    check: ControlFiles | None = None,
    version: str = "",
    models: ModelChoice = _FOUND,
    progress: Progress = no_progress,
) -> PlacedBlock:
    """Write a version of a block that is moved onto control; nothing of it is measured again.

    Args:
        block: its folder.
        images: of the block, in which control is found by the adjusted models; some are enough.
        control: known ground.
        folder: of the new version; must not exist.
        check: known ground that takes no part, and measures the result.
        version: of the new version; by default the next whole number.
        models: delivered ones of images whose names and tags do not give them.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used, or an image is not of the block.
        ComputationError: too little of the control is found, or it disagrees.
    """
    refuse_existing(folder)
    contents = read_block(block)
    points, document = contents.points, contents.document
    new_version = version or _next_version(document.metadata.version)
    adjusted = _models(block, document)
    delivered = models.of(images)
    with ExitStack() as stack:
        scenes = [_scene(path, delivered[path], adjusted, stack) for path in images]
        stated = [scene.statements for scene in scenes]

        def find(files: ControlFiles, share: Progress) -> FoundControl:
            known = read_control(files, scenes, images, stack)
            stated.append(known.statements)
            return find_in_block(scenes, points, known, progress=share)

        found = find(control, part_of(progress, 0.0, 0.4))
        checked = None if check is None else find(check, part_of(progress, 0.4, 0.3))
        fit = fit_frame(points.frames[0], found.known, found.lon_lat_h, found.covariance_m2)
        moved = replace(moved_points(points, fit.translation_m), frames=(fit.frame,))
        placed = PlacedBlock(
            moved,
            points.frames[0],
            fit,
            found.known.names,
            *_check(fit, checked),
            statements=gathered(chain(*stated)),
        )
        chips = stack.enter_context(FolderChips(block))
        write_block(
            folder,
            _metadata(contents, placed, new_version),
            moved,
            lambda row: _chips(chips, points, row),
            {name: moved_model(model, fit.translation_m) for name, model in adjusted.items()},
            typology=contents.typology.tolist(),
            progress=part_of(progress, 0.7, 0.3),
        )
    return placed


def _next_version(version: str) -> str:
    if not version.isdecimal():
        raise InputError(
            f"version {version} of the block is no whole number that another one follows; name the new "
            "version (--version)"
        )
    return str(int(version) + 1)


def _models(block: Path, document: BlockDocument) -> dict[str, RpcModel]:
    models = {}
    for image, path in zip(document.images, document.models, strict=True):
        if path is not None:
            models[image.image_id] = parse_rpc_text(read_text(block_member(block, path)), path)
    if not models:
        raise InputError(
            f"{block}: the block has no adjusted models of its images, by which control could be found; "
            "only blocks of `amers production run` have them"
        )
    return models


def _scene(
    path: Path,
    delivered: tuple[Path | None, CropOrigin | None],
    models: dict[str, RpcModel],
    stack: ExitStack,
) -> Scene:
    scene = read_scene(path, delivered[0], crop_origin=delivered[1])
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    name = scene.acquisition.image_id
    if name not in models:
        known = ", ".join(sorted(models)[:5])
        raise InputError(f"{path}: {name} is no image of the block with a model; expected: {known}")
    return replace(scene, model=models[name])


def _check(
    fit: FrameFit, checked: FoundControl | None
) -> tuple[Accuracy | None, NormalisedError | None]:
    """Errors at check points by a translation, and these over what is declared."""
    if checked is None:
        return None, None
    known = checked.known
    error_m = fit.translation_m - misfits_m(known, checked.lon_lat_h)
    of_sources = np.array([frame.covariance_m2 for frame in known.frames])[known.source]
    own = known.covariance_m2 + checked.covariance_m2
    return accuracy(error_m), normalised_error(error_m, own + of_sources + fit.frame.covariance_m2)


def _chips(chips: FolderChips, points: ControlPoints, row: int) -> ChipArray:
    first, last = points.views.start[row : row + 2].tolist()
    file = points.chip_files[points.chip_file[row]]
    return chips.read(file, int(points.chip_row[row]), last - first)


def _metadata(contents: BlockContents, placed: PlacedBlock, version: str) -> BlockMetadata:
    """The description of the block in its new place: its frame and what tells it."""
    old = contents.document.metadata
    used = int(placed.fit.active.sum())
    sources = sorted({name.rpartition(":")[0] for name in placed.control})
    frame = AccuracyFigure(
        "absolute",
        "frame_sigma_m",
        placed.fit.frame.sigma_m,
        used,
        f"{used} control points of {', '.join(sources)}, after the production",
    )
    kept = tuple(one for one in old.accuracy if one.name != frame.name)
    return replace(
        old,
        version=version,
        extent=_moved_outline(old.extent, placed.fit.translation_m),
        created=datetime.now(UTC),
        accuracy=(*kept, frame, *_check_figures(placed)),
        frame=placed.fit.frame,
        provenance=Provenance(
            "amers",
            installed_version("amers"),
            (f"{old.id}@{old.version}", *sources),
            {
                **old.provenance.options,
                "placed": {
                    "translation_east_north_up_m": placed.fit.translation_m.tolist(),
                    "control_points": len(placed.control),
                    "left_out": _left_out(placed),
                },
            },
        ),
    )


def _moved_outline(outline: Array, translation_m: Array) -> Array:
    ground = np.column_stack([outline, np.zeros(len(outline))])
    return np.asarray(move_metres(ground, np.tile(translation_m, (len(ground), 1)))[:, :2])


def _left_out(placed: PlacedBlock) -> list[str]:
    pairs = zip(placed.control, placed.fit.active.tolist(), strict=True)
    return [name for name, used in pairs if not used]


def _check_figures(placed: PlacedBlock) -> tuple[AccuracyFigure, ...]:
    check = placed.check
    if check is None or check.n == 0:
        return ()
    against = f"{check.n} check points that took no part"
    figures = [AccuracyFigure("absolute", "check_ce90_m", check.ce90_m.value, check.n, against)]
    if check.le90_m is not None:
        figures.append(AccuracyFigure("absolute", "check_le90_m", check.le90_m.value, check.n, against))
    return tuple(figures)
