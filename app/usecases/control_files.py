"""Files that place a new block on the Earth: older blocks, and ground points marked in its images."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from app.errors import InputError
from app.usecases.marked_files import PointStatements, read_marked
from services.formats.block.document_json import BLOCK_JSON
from services.formats.block.reader import FolderChips, file_sha256, read_block
from services.imagery.scene import Scene
from services.production.control import Control
from services.production.control_points import ControlBlock


@dataclass(frozen=True)
class ControlFiles:
    """Files that place a new block on the Earth.

    Attributes:
        paths: folders of older blocks, and files of ground points marked in the images.
        points: what the files of points do not state.
    """

    paths: tuple[Path, ...] = ()
    points: PointStatements = field(default_factory=PointStatements)


def read_control(
    files: ControlFiles, scenes: Sequence[Scene], images: Sequence[Path], stack: ExitStack
) -> Control:
    """The control of a production; chips stay open until the stack closes.

    Args:
        files: of the control.
        scenes: that it places.
        images: files of the scenes, by whose names marks refer to them.
        stack: closes what is opened.

    Raises:
        InputError: a file cannot be used, or does not state what it must.
    """
    of_points = [path for path in files.paths if path.is_file()]
    missing = [path for path in files.paths if not path.exists()]
    if missing:
        raise InputError(f"{missing[0]}: no such folder of a block or file of points (--control)")
    if not of_points and files.points != PointStatements():
        raise InputError(
            "accuracy, datum or columns of control points stated (--control-…), but no --control is a "
            "file of points; add it, or leave them out"
        )
    marked = (read_marked(of_points, files.points, scenes, images),) if of_points else ()
    blocks = tuple(_block(path, stack) for path in files.paths if path.is_dir())
    return Control(blocks=blocks, marked=marked)


def control_inputs(files: ControlFiles) -> dict[str, Any]:
    """What results depend on, as far as control goes."""
    return {
        "paths": [
            {
                "path": str(path.resolve()),
                "sha256": file_sha256(path / BLOCK_JSON if path.is_dir() else path),
            }
            for path in files.paths
        ],
        "points": asdict(files.points),
    }


def _block(folder: Path, stack: ExitStack) -> ControlBlock:
    contents = read_block(folder)
    chips = stack.enter_context(FolderChips(folder))
    return ControlBlock(contents.document.metadata.id, contents.points, chips)
