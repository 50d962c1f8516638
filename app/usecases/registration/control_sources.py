"""Sources of control points for a scene: a block folder, or the published blocks of the store."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from amers.app.db.blocks import find_surface_heights
from amers.app.db.engine import Database
from amers.app.db.points import control_points
from amers.app.storage import Storage
from amers.app.usecases.damage import open_chips
from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import FolderChips
from amers.services.registration.scene_marks import NO_MARKS, NoChips
from amers.services.reports.report import BlockUsed
from amers.services.types import Array, ChipSource, ControlPoints


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


def points_of_block(folder: Path) -> FindPoints:
    """A source of the points of a block folder, which is checked completely first."""
    contents = check_block(folder)
    metadata = contents.document.metadata

    def find(outline: Array) -> ControlSet:
        block = BlockUsed(metadata.id, metadata.version)
        return ControlSet(contents.points, FolderChips(folder), (block,))

    return find


def no_points(outline: Array) -> ControlSet:
    """A source of no points, where scenes are registered on marks of a person alone."""
    return ControlSet(NO_MARKS.points, NoChips(), ())


def points_of_store(database: Database, storage: Storage) -> FindPoints:
    """A source of the points of the published blocks of the store."""

    def find(outline: Array) -> ControlSet:
        with database.snapshot() as connection:
            stored = control_points(connection, outline)
            surface = find_surface_heights(connection, stored.points.id)
        points = replace(stored.points, surface=surface)
        blocks = tuple(BlockUsed(block.id, block.version) for block in stored.blocks)
        return ControlSet(points, open_chips(database, storage), blocks)

    return find
