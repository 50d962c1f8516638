"""Images without the pixels inside outlines from a catalogue, such as clouds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely

from amers.services.imagery.scene import Scene, scene_centre
from amers.services.imagery.source import ImageSource, Window
from amers.services.types import Array, FloatImage

_SUBPIXEL_BITS = 4


@dataclass(frozen=True)
class OutlinedImage:
    """An image without what lies inside outlines; an `ImageSource`.

    Attributes:
        image: the image.
        outlines: (k, 2) line and sample of the corners of each outline; they may overlap.
    """

    image: ImageSource
    outlines: tuple[Array, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def close(self) -> None:
        """Close the image."""
        self.image.close()  # type: ignore[attr-defined]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN inside the outlines as well."""
        pixels = self.image.read(window)
        inside = np.zeros(pixels.shape, dtype=np.uint8)
        first = np.array([window.line, window.sample])
        last = first + [window.lines, window.samples]
        for outline in self.outlines:
            if (outline.max(axis=0) >= first).all() and (outline.min(axis=0) <= last).all():
                column_row = (outline - first)[:, ::-1] * 2**_SUBPIXEL_BITS
                cv2.fillPoly(inside, [np.rint(column_row).astype(np.int32)], 1, shift=_SUBPIXEL_BITS)
        pixels[inside != 0] = np.nan
        return pixels


def without_hidden_ground(scene: Scene, hidden: shapely.Geometry | None) -> Scene:
    """A scene without the ground that polygons hide; holes in them are hidden as well.

    The polygons are placed at the middle height of the scene's model: on ground far from it they are off
    by the parallax, as those of a catalogue are anyway, which are drawn on images.

    Args:
        scene: the scene.
        hidden: polygons, longitude and latitude; None hides nothing.
    """
    if hidden is None or hidden.is_empty:
        return scene
    height_m = scene_centre(scene)[2]
    outlines = _outlines(scene, shapely.get_parts(hidden), height_m)
    return replace(scene, image=OutlinedImage(scene.image, outlines)) if outlines else scene


def _outlines(scene: Scene, polygons: Sequence[shapely.Polygon], height_m: float) -> tuple[Array, ...]:
    """The outlines of polygons in an image; those of which a corner cannot be projected are left out."""
    outlines = []
    for polygon in polygons:
        lon_lat = shapely.get_coordinates(shapely.get_exterior_ring(polygon))
        ground = np.column_stack([lon_lat, np.full(len(lon_lat), height_m)])
        line_sample = scene.model.project(ground)
        if np.isfinite(line_sample).all():
            outlines.append(line_sample)
    return tuple(outlines)
