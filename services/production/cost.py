"""Predicted cost of a production: core-hours, memory and bytes, from measured rates."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.block_plan import PlannedImage
from amers.services.production.image_pairs import PARTNERS
from amers.services.production.tie_patches import searched_pixels

_FEATURE_S = 0.65
"""Of a million pixels in which features are found."""
_PAIR_S = 0.17
"""Of the matches of two images, for a million pixels in which features of one are found."""
_CANDIDATE_S, _CANDIDATES = 0.0025, 3
"""Of a measure of a candidate in one image; candidates of a point."""
_CHIP_S, _CHIPS = 0.007, 2
"""Of one chip; chips of a point in one image."""
_SURFACE_S = 0.055
"""Of the surface at a point by one pair of images. All seconds are of one core, from `python -m
benchmarks.production_cost --sides 5000 10000 40000`, that of surfaces with `--surfaces`."""
_ADJUSTMENT_S, _ADJUSTMENTS = 0.13, 3
"""Of an image in one adjustment: 2,536 s for 20,000 images, 83 s for 2,000 (`python -m
benchmarks.block_parts`)."""
_MEMORY_MIB = 600
"""Of a process, whatever the size of the images: the same benchmark."""
_BLOCK_MIB, _BLOCK_IMAGE_MIB, _BLOCK_OBSERVATION_MIB = 300, 0.12, 54e-6
"""Of the process that assembles the adjustment: Python, an image, an observation (`python -m
benchmarks.block_parts`, 2,000 images with 300 points each and 20,000 with 40)."""
_CHIP_BYTES = 2 * 101 * 101
_VALUE_BYTES = 2
"""Of a pixel, unpacked."""


@dataclass(frozen=True)
class ProductionCost:
    """What a production costs.

    Attributes:
        points: number of them.
        core_s: seconds of a core, by stage.
        memory_mib: of a process.
        block_mib: of the process that assembles the adjustment of the block.
        read_bytes: pixels that are read, unpacked: compressed files have fewer.
        written_bytes: chips of the block; the work folder has as much again.
    """

    points: int
    core_s: Mapping[str, float]
    memory_mib: int
    block_mib: int
    read_bytes: float
    written_bytes: float

    @property
    def words(self) -> str:
        """The cost as a sentence."""
        hours = {stage: seconds / 3600.0 for stage, seconds in self.core_s.items()}
        stages = ", ".join(f"{stage} {value:.2g}" for stage, value in hours.items())
        memory = f"{self.memory_mib} MiB a process"
        if self.block_mib > self.memory_mib:
            memory += f", {self.block_mib:,} MiB in the one that assembles the adjustment"
        return (
            f"Cost of {self.points:,} points from these images: {sum(hours.values()):.2g} core-hours "
            f"({stages}), {memory}, {self.read_bytes / 1e9:.2g} GB of unpacked "
            f"pixels read, {self.written_bytes / 1e9:.2g} GB of chips written"
        )


def production_cost(
    images: Sequence[PlannedImage],
    area_km2: float,
    spacing_m: float,
    *,
    surface_pairs: int = 10,
    fine_gsd_m: float | None = None,
) -> ProductionCost:
    """The cost of a block of points.

    Args:
        images: that are planned.
        area_km2: ground that two of them show.
        spacing_m: of the points.
        surface_pairs: pairs of images that give the surface at a point, at most.
        fine_gsd_m: ground sampling of the fine chips; by default that of the coarsest image.
    """
    count, shown_km2 = len(images), sum(one.size_m[0] * one.size_m[1] for one in images) / 1e6
    points = area_km2 * 1e6 / spacing_m**2
    views = shown_km2 / area_km2
    pairs_of_point = min(surface_pairs, views * (views - 1.0) / 2.0)
    pixels = [one.size_m[0] * one.size_m[1] / one.gsd_m**2 for one in images]
    coarsest_m = max(one.gsd_m for one in images)
    features = FeatureOptions().for_chips(coarsest_m, fine_gsd_m or coarsest_m)
    smallest = min(pixels)
    searched = [searched_pixels(one, smallest, points * views / count, features) for one in pixels]
    partners = min(PARTNERS, count - 1)
    observations = points * views * _CANDIDATES
    found_mpx = sum(found for found, _ in searched) / 1e6
    core_s = {
        "features": found_mpx * _FEATURE_S,
        "matches": found_mpx * partners / 2.0 * _PAIR_S,
        "measures": points * views * _CANDIDATES * _CANDIDATE_S,
        "surfaces": points * pairs_of_point * _SURFACE_S,
        "points": points * views * _CHIPS * _CHIP_S,
        "adjustment": count * _ADJUSTMENTS * _ADJUSTMENT_S,
    }
    return ProductionCost(
        round(points),
        core_s,
        _MEMORY_MIB,
        max(
            _MEMORY_MIB,
            round(_BLOCK_MIB + count * _BLOCK_IMAGE_MIB + observations * _BLOCK_OBSERVATION_MIB),
        ),
        sum(read for _, read in searched) * _VALUE_BYTES,
        points * views * _CHIPS * _CHIP_BYTES,
    )
