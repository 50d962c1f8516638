"""The adjusted images of a block in a file, for blocks that are made beside it later."""

import zipfile
from pathlib import Path

import numpy as np

from services.adjustment.known_images import KnownImages
from services.errors import FormatError
from services.types import Frame

FORMAT = "amers-images/2"
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
    )


def read_adjusted_images(path: Path) -> tuple[str, KnownImages]:
    """The id of a block, and its adjusted images.

    Raises:
        FormatError: the file is missing, or is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["format"]) != FORMAT:
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
    numbers = (known.values, known.relative, known.frame.covariance_m2)
    if not all(np.isfinite(array).all() for array in numbers):
        raise FormatError(f"{path}: unknown numbers found, finite ones expected")
    return block, known
