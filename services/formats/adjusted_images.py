"""A file with the adjusted images of a block, for neighbouring blocks that are made later."""

import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np

from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import FormatError
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Frame

FORMAT = "amers-images/3"
_WITHOUT_DISPLACEMENTS = "amers-images/2"
_OF_A_GRID = tuple(field.name for field in fields(DisplacementGrid))
_SEPARATOR = "\n"


def write_adjusted_images(path: Path, block: str, known: KnownImages) -> None:
    """Write the images of a block, with the covariance of all their parameters.

    Args:
        path: of the file, `.npz`.
        block: id of the block.
        known: its images.
    """
    np.savez_compressed(
        path,
        format=FORMAT,
        block=block,
        names=np.array(known.names),
        parameters=np.array([_SEPARATOR.join(own) for own in known.parameters]),
        values=known.values,
        relative=known.relative,
        frame_m2=known.frame.covariance_m2,
        ground=known.ground,
        line_sample=known.line_sample,
        **{
            f"displacement_{number}_{name}": getattr(displacement, name)
            for number, displacement in enumerate(known.displacements)
            if displacement is not None
            for name in _OF_A_GRID
        },
    )


def read_adjusted_images(path: Path) -> tuple[str, KnownImages]:
    """The id of a block, and its adjusted images.

    Raises:
        FormatError: the file is missing, or is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["format"]) not in (FORMAT, _WITHOUT_DISPLACEMENTS):
                raise FormatError(f"{path}: format {str(file['format'])!r:.60}, {FORMAT!r} expected")
            names = tuple(str(name) for name in file["names"])
            known = KnownImages(
                names,
                tuple(tuple(str(own).split(_SEPARATOR)) for own in file["parameters"]),
                file["values"],
                file["relative"],
                Frame(file["frame_m2"]),
                file["ground"],
                file["line_sample"],
                tuple(_displacement(file, number) for number in range(len(names))),
            )
            block = str(file["block"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise FormatError(
            f"{path}: the adjusted images of a block expected, as `amers production run` writes them "
            f"beside a block of at most 333 images: {error}"
        ) from None
    n, size = len(names), known.values.size
    places = known.ground.shape[:2]
    shapes = (known.relative.shape, known.frame.covariance_m2.shape, known.line_sample.shape)
    if (
        not n
        or known.values.shape[:1] != (n,)
        or known.values.ndim != 2
        or [len(known.parameters), max(map(len, known.parameters))] != list(known.values.shape)
        or shapes != ((size, size), (3, 3), (*places, 2))
        or known.ground.shape != (n, places[-1], 3)
    ):
        raise FormatError(f"{path}: the arrays do not fit each other: {n} names, {shapes}")
    grids = [getattr(one, name) for one in known.displacements if one for name in _OF_A_GRID]
    numbers = (known.values, known.relative, known.frame.covariance_m2, *grids)
    if not all(np.isfinite(array).all() for array in numbers):
        raise FormatError(f"{path}: unknown numbers found, finite ones expected")
    return block, known


def _displacement(file: "np.lib.npyio.NpzFile", number: int) -> DisplacementGrid | None:
    """The displacement of an image; None where it has none."""
    names = [f"displacement_{number}_{name}" for name in _OF_A_GRID]
    if names[0] not in file:
        return None
    grid = DisplacementGrid(*(file[name] for name in names))
    shape = (len(grid.line), len(grid.sample), 2)
    if grid.displacement_px.shape != shape or grid.variance_px2.shape != shape or min(shape) < 2:
        raise ValueError(f"the displacement of image {number + 1} does not fit its nodes")
    return grid
