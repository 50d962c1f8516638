"""Dates of a real town: points made from some of them, and ties that tell what each other date shows."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np

from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.production.image_production import Production, produce_points
from amers.services.types import Array
from benchmarks._real_views import CHIPS, RealView, moved_by, rpc_of, smoothed_ties, ties_of
from benchmarks._worlds import Block
from tests.journeys.ties import independent_tracks

FOLDER = "wv3_jacksonville"
DATES = ("001", "003", "005", "009", "010", "012", "016", "018", "019")
BLOCKS = (
    ("001", "003", "005", "010", "012", "018"),
    ("003", "009", "010", "016", "018", "019"),
    ("001", "005", "009", "012", "016", "019"),
    ("001", "010", "016"),
    ("003", "012", "019"),
    ("005", "009", "018"),
    ("001", "003", "018"),
    ("009", "012", "016"),
    ("001", "016"),
    ("003", "018"),
    ("005", "012"),
    ("003", "019"),
    ("009", "012"),
)
"""Dates of the blocks: of six, of three and of two."""
SIGMA_M = 4.0
"""Of the models as delivered, which are 0.5 to 6 px apart."""
_CROP = 600
FEWEST_TIES = 12
"""Ties that tell what a date shows; of fewer, nothing is judged."""
_TOWN_BLUNDER = 2.5
"""Distances of ties over their median, beyond which they are wrong."""
_TRIPLES = 3
"""Dates of a block up to which each two of them give ties of another date."""
_OPTIONS = replace(CHIPS, surface_pairs=0)


class TooFewTies(Exception):
    """What a date shows is not known well enough to judge a registration."""


@dataclass(frozen=True)
class DateOnBlock:
    """A date registered on points of others.

    Attributes:
        date: of the scene.
        block: dates of the points.
    """

    date: str
    block: tuple[str, ...]

    @property
    def name(self) -> str:
        """For outcomes."""
        return f"{self.date}_on_{'_'.join(self.block)}"


PAIRS = tuple(DateOnBlock(date, block) for block in BLOCKS for date in DATES if date not in block)


def date_view(real_data: Path, pair: DateOnBlock) -> RealView:
    """A date as a view: points of the block, and ground that two of its dates and the scene show."""
    made = _block(real_data, pair.block)
    scene = _scene(real_data, pair.date)
    ground, seen = [], []
    for some in _two_of(pair.block):
        images = [scene, *(_scene(real_data, date) for date in some)]
        tracks = independent_tracks([one.image.read(_whole(one)) for one in images])
        models = [made.adjustment.models[pair.block.index(date)] for date in some]
        found, shown = ties_of(tracks, [1, 2], models, 0)
        ground.append(found)
        seen.append(shown)
    if sum(map(len, ground)) < FEWEST_TIES:
        raise TooFewTies(f"{pair.name}: fewer than {FEWEST_TIES} ties")
    placed = scene.model.project(made.points.lon_lat_h)
    line_sample, fitting, offset, noise_px = smoothed_ties(
        scene.model,
        np.concatenate(ground),
        np.concatenate(seen),
        blunder=_TOWN_BLUNDER,
        locally=False,
    )
    if fitting.sum() < FEWEST_TIES:
        raise TooFewTies(f"{pair.name}: fewer than {FEWEST_TIES} ties")
    return RealView(
        scene,
        _CROP,
        rpc_of(_scene(real_data, pair.block[0]).model),
        _as_block(made),
        np.concatenate(ground)[fitting],
        line_sample[fitting],
        moved_by(placed, offset),
        noise_px,
    )


def _two_of(block: tuple[str, ...]) -> list[tuple[str, str]]:
    around = list(zip(block, (*block[1:], block[0]), strict=True))
    return around if len(block) > _TRIPLES else list(combinations(block, 2))


@lru_cache(maxsize=2)
def _block(real_data: Path, dates: tuple[str, ...]) -> Production:
    return produce_points([_scene(real_data, date) for date in dates], _OPTIONS)


def _as_block(made: Production) -> Block:
    chips: Array = np.concatenate([made.chips(row) for row in range(len(made.points))])
    return Block(made.points, chips)


@lru_cache(maxsize=9)
def _scene(real_data: Path, date: str) -> Scene:
    scene = read_scene(real_data / FOLDER / f"jax_{date}.tif")
    return replace(scene, image=ArrayImage(scene.image.read(_whole(scene))), sigma_m=SIGMA_M)


def _whole(scene: Scene) -> Window:
    return Window(0, 0, *scene.image.shape)
