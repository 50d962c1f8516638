"""Options of a mosaic."""

from dataclasses import dataclass, field

from amers.services.errors import InputError
from amers.services.orthorectification.rectify import OrthoOptions

BLOCK_PX = 512
"""Side of the windows in which scenes are rectified, whatever the tiles are: equal to `OrthoOptions`."""


@dataclass(frozen=True)
class MosaicOptions:
    """How a mosaic is made.

    Attributes:
        level: change the grey values of the scenes so that they agree where they overlap.
        anchor: name of the scene whose grey values stay; None keeps the mean of all.
        feather_px: width of the strip along a seam in which both scenes are blended, pixels.
        ortho: how every scene is rectified.
        tile_px: side of the tiles that are made at once, a multiple of 512 pixels; the mosaic does not
            depend on it.
    """

    level: bool = False
    anchor: str | None = None
    feather_px: float = 0.0
    ortho: OrthoOptions = field(default_factory=OrthoOptions)
    tile_px: int = 4 * BLOCK_PX

    def __post_init__(self) -> None:
        """Refuse tiles that would cut the windows, and a negative width."""
        if self.tile_px < BLOCK_PX or self.tile_px % BLOCK_PX or self.ortho.window_px != BLOCK_PX:
            raise InputError(
                f"tile_px {self.tile_px} and window_px {self.ortho.window_px} given, a multiple of "
                f"{BLOCK_PX} and {BLOCK_PX} expected"
            )
        if not self.feather_px >= 0.0:
            raise InputError(f"feather_px: {self.feather_px:g} found, 0 or more pixels expected")
