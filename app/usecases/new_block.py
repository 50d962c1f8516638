"""What every new block of points states of itself, however its points are made."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.registration.result_folder import older_result
from amers.services.formats.block.document import (
    AccuracyFigure,
    BlockMetadata,
    BlockSpecification,
    Provenance,
)
from amers.services.types import Acquisition, Array, ControlPoints


@dataclass(frozen=True)
class BlockIdentity:
    """Name, version, title and licence of a new block.

    An id is a letter, then letters, digits, dots, dashes or underscores. A changed block needs a new
    version. Without a title, people see the id.

    Attributes:
        id: id of the block; by default the folder's name.
        version: version of the block.
        title: title of the block.
        license: licence: SPDX identifier.
    """

    id: str = ""
    version: str = "1"
    title: str = ""
    license: str = "proprietary"

    def named_after(self, folder: Path) -> "BlockIdentity":
        """The same with the name of the block's folder in place of an id that is missing."""
        return replace(self, id=self.id or folder.name)


def refuse_existing(folder: Path) -> None:
    """Refuse a folder that exists, or cannot be made, before the work that it is for.

    Raises:
        InputError: it exists, or its place cannot be written.
    """
    if folder.exists():
        raise InputError(f"{folder}: already exists; a block is written into a new folder")
    older_result(folder)


def fewest_views(points: ControlPoints) -> int:
    """The smallest number of images that show a point."""
    views = points.views
    of_point = np.repeat(np.arange(len(points)), np.diff(views.start))
    pairs = np.unique(np.column_stack([of_point, views.image]), axis=0)
    return int(np.bincount(pairs[:, 0]).min())


def image_accuracy(
    points: ControlPoints, local_sigma_m: float, n_images: int
) -> tuple[AccuracyFigure, ...]:
    """The stated accuracies of points whose position is that of images.

    Args:
        points: of the block.
        local_sigma_m: error of details relative to the rest of their image, from the disagreement of
            images; NaN where nothing shows it.
        n_images: number of images.
    """
    frame_sigma_m = points.frames[0].sigma_m
    figures = []
    if math.isfinite(local_sigma_m):
        disagreement = "the disagreement of the images, after one shift of each"
        figures = [AccuracyFigure("relative", "local_sigma_m", local_sigma_m, len(points), disagreement)]
    if math.isfinite(frame_sigma_m):
        stated = (
            "the stated accuracy of the first image, not measured; raised where images disagree by more"
        )
        if n_images == 1:
            stated = "the stated accuracy of the image, not measured"
        figures.append(AccuracyFigure("absolute", "frame_sigma_m", frame_sigma_m, n_images, stated))
    return tuple(figures)


def block_metadata(
    identity: BlockIdentity,
    images: Sequence[Acquisition],
    points: ControlPoints,
    *,
    description: str,
    outline: Array,
    specification: BlockSpecification,
    options: dict[str, Any],
    accuracy: tuple[AccuracyFigure, ...],
) -> BlockMetadata:
    """What a block states of itself: its identity, images, outline, specification and accuracy."""
    dates = [image.acquired_at for image in images if image.acquired_at is not None]
    return BlockMetadata(
        id=identity.id,
        version=identity.version,
        title=identity.title or identity.id,
        description=description,
        license=identity.license,
        extent=outline,
        created=datetime.now(UTC),
        specification=specification,
        provenance=Provenance(
            software="amers",
            version=version("amers"),
            sources=tuple(image.image_id for image in images),
            options=options,
        ),
        epoch=None if not dates else _decimal_year(max(dates)),
        accuracy=accuracy,
        frame=points.frames[0],
    )


def points_per_km2(spacing_m: float | None) -> float | None:
    """Density of one point for each square of a side in metres."""
    return None if spacing_m is None else (spacing_m / 1000.0) ** -2.0


def _decimal_year(moment: datetime) -> float:
    start = datetime(moment.year, 1, 1, tzinfo=UTC)
    end = datetime(moment.year + 1, 1, 1, tzinfo=UTC)
    return round(moment.year + (moment - start) / (end - start), 3)
