"""Sources of control points for a scene: block folders, or the published blocks of the store."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from app.db.engine import Database
from app.db.points import control_points
from app.errors import InputError
from app.storage import Storage
from app.usecases.damage import open_chips
from services.formats.block.check import check_block
from services.formats.block.reader import FolderChips
from services.formats.block.several import SeveralChips, points_of_several
from services.reports.report import BlockUsed
from services.types import Array, ChipSource, ControlPoints


@dataclass(frozen=True)
class ControlSet:
    """Control points of an area.

    Attributes:
        points: the control points.
        chips: source of their chips.
        blocks: that the points come from.
    """

    points: ControlPoints
    chips: ChipSource
    blocks: tuple[BlockUsed, ...]


FindPoints = Callable[[Array], ControlSet]
"""Finds the control points inside an outline (n, 2) of lon, lat."""


def points_of_blocks(folders: Sequence[Path]) -> FindPoints:
    """A source of the points of block folders, which are checked completely first.

    Raises:
        InputError: a folder is given twice, or is no complete block.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError("--block: a folder is given twice; name each once")
    contents = [check_block(folder) for folder in folders]
    metadata = [one.document.metadata for one in contents]
    blocks = tuple(BlockUsed(one.id, one.version) for one in metadata)
    points = contents[0].points
    if len(contents) > 1:
        points = points_of_several([one.points for one in contents])

    def find(outline: Array) -> ControlSet:
        sources = tuple(FolderChips(folder) for folder in folders)
        return ControlSet(points, sources[0] if len(sources) == 1 else SeveralChips(sources), blocks)

    return find


def points_of_store(database: Database, storage: Storage) -> FindPoints:
    """A source of the points of the published blocks of the store."""

    def find(outline: Array) -> ControlSet:
        with database.snapshot() as connection:
            stored = control_points(connection, outline)
        blocks = tuple(BlockUsed(block.id, block.version) for block in stored.blocks)
        return ControlSet(stored.points, open_chips(database, storage), blocks)

    return find
