"""Images as files, written by GDAL."""

from pathlib import Path
from typing import Any

import numpy as np
import rasterio


def write_geotiff(
    path: Path, pixels: np.ndarray, *, names: tuple[str, ...] = (), rpcs: Any = None, **profile: Any
) -> Path:
    """Write the bands of an image, (lines, samples) or (bands, lines, samples); returns its path.

    Args:
        path: of the file.
        pixels: of the type that the file gets.
        names: of the bands.
        rpcs: model for its tags.
        profile: what else the file states, such as `crs`, `transform` and `nodata`.
    """
    bands = pixels if pixels.ndim == 3 else pixels[None]
    shape = dict(zip(("count", "height", "width"), bands.shape, strict=True))
    with rasterio.open(path, "w", driver="GTiff", dtype=bands.dtype, **shape, **profile) as file:
        file.write(bands)
        if names:
            file.descriptions = names
        if rpcs is not None:
            file.rpcs = rpcs
    return path
