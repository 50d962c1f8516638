"""Sources of control points for a scene: a block folder, or the published blocks of the store."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from app.db.engine import Database
from app.db.points import control_points
from app.storage import Storage
from app.usecases.damage import open_chips
from services.formats.block.check import check_block
from services.formats.block.reader import FolderChips
from services.reports.report import BlockUsed
from services.types import Array, ChipSource, ControlPoints


@dataclass(frozen=True)
class ControlSet:
    """Control points of an area.

    Attributes:
        points: the control points.
        chips: source of their chips.
        blocks: that the points come from.
        frame_sigma_m: accuracy of the worst frame of these blocks, one standard deviation per
            coordinate; NaN when a block does not state it.
    """

    points: ControlPoints
    chips: ChipSource
    blocks: tuple[BlockUsed, ...]
    frame_sigma_m: float


FindPoints = Callable[[Array], ControlSet]
"""Finds the control points inside an outline (n, 2) of lon, lat."""


def points_of_block(folder: Path) -> FindPoints:
    """A source of the points of a block folder, which is checked completely first."""
    contents = check_block(folder)
    metadata = contents.document.metadata
    figures = (figure.value for figure in metadata.accuracy if figure.name == "frame_sigma_m")
    frame_sigma_m = next(figures, None)

    def find(outline: Array) -> ControlSet:
        block = BlockUsed(metadata.id, metadata.version)
        return ControlSet(
            contents.points, FolderChips(folder), (block,), _worst_sigma_m([frame_sigma_m])
        )

    return find


def points_of_store(database: Database, storage: Storage) -> FindPoints:
    """A source of the points of the published blocks of the store."""

    def find(outline: Array) -> ControlSet:
        with database.snapshot() as connection:
            stored = control_points(connection, outline)
        blocks = tuple(BlockUsed(block.id, block.version) for block in stored.blocks)
        frame_sigma_m = _worst_sigma_m([block.frame_sigma_m for block in stored.blocks])
        return ControlSet(stored.points, open_chips(database, storage), blocks, frame_sigma_m)

    return find


def _worst_sigma_m(stated: Sequence[float | None]) -> float:
    """The largest of the frame sigmas that blocks state; NaN when a block states none."""
    return math.nan if None in stated or not stated else max(s for s in stated if s is not None)
