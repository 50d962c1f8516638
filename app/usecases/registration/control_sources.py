"""Where control points of a scene come from: a block folder, or the published blocks of the store."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from app.db.engine import Database
from app.db.points import control_points
from app.storage import Storage, StoredChips
from services.formats.block.check import check_block
from services.formats.block.reader import FolderChips
from services.reports.report import BlockUsed
from services.types import Array, ChipSource, ControlPoints


@dataclass(frozen=True)
class ControlSet:
    """Control points of a piece of ground.

    Attributes:
        chips: where the chips of the points are.
        blocks: whose points they are.
        frame_sigma_m: how well the frame of the worst of them is known, one standard deviation a
            coordinate; NaN when a block does not say.
    """

    points: ControlPoints
    chips: ChipSource
    blocks: tuple[BlockUsed, ...]
    frame_sigma_m: float


FindPoints = Callable[[Array], ControlSet]
"""Points inside an outline (n, 2) of lon, lat."""


def points_of_block(folder: Path) -> FindPoints:
    """Points straight out of a block folder, once it has been checked entirely."""
    contents = check_block(folder)
    metadata = contents.document.metadata
    said = next((figure.value for figure in metadata.accuracy if figure.name == "frame_sigma_m"), None)

    def find(outline: Array) -> ControlSet:
        block = BlockUsed(metadata.id, metadata.version)
        return ControlSet(contents.points, FolderChips(folder), (block,), _frame_sigma_m([said]))

    return find


def points_of_store(database: Database, storage: Storage) -> FindPoints:
    """Points of the published blocks of the store."""

    def find(outline: Array) -> ControlSet:
        with database.transaction() as connection:
            found = control_points(connection, outline)
        blocks = tuple(BlockUsed(block.id, block.version) for block in found.blocks)
        frame_sigma_m = _frame_sigma_m([block.frame_sigma_m for block in found.blocks])
        return ControlSet(found.points, StoredChips(storage), blocks, frame_sigma_m)

    return find


def _frame_sigma_m(said: Sequence[float | None]) -> float:
    """The worst of what blocks say of their frames; NaN when one says nothing."""
    return math.nan if None in said or not said else max(value for value in said if value is not None)
