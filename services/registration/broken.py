"""Refusal of a scene with lost or repeated lines, which names these lines."""

from collections.abc import Iterator
from contextlib import contextmanager

from amers.services.errors import BrokenImage, NoConsensus, NotEnoughPoints
from amers.services.imagery.line_breaks import format_breaks, scene_breaks
from amers.services.imagery.scene import Scene


@contextmanager
def naming_breaks(scene: Scene) -> Iterator[None]:
    """Add to the refusal of a scene at which lines its pixels show that some were lost or repeated.

    Raises:
        BrokenImage: instead of `NoConsensus` and `NotEnoughPoints`, where there are such lines.
    """
    try:
        yield
    except (NoConsensus, NotEnoughPoints) as error:
        breaks = scene_breaks(scene)
        if not len(breaks):
            raise
        parts = f"the image has {len(breaks) + 1} parts that lie apart"
        raise BrokenImage(f"{format_breaks(breaks)}: {parts} ({error})") from error
