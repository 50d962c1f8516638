"""Real views of four places: points made from other views, and ties that tell what each pixel shows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.sensors.base import SensorModel
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array, BoolArray, ControlPoints, Observations, Views
from benchmarks._worlds import Block
from tests.journeys.ties import independent_tracks

CHIPS = ProductionOptions(
    fine_gsd_m=0.5, coarse_gsd_m=2.0, features=FeatureOptions(per_megapixel=40_000)
)
"""More features than by default: the small wooded pair has twice as many points with them."""
PLEIADES_SIGMA_M = 4.0
"""Of the models as delivered, where their files do not say it."""
_NEIGHBOURS = 12
_BLUNDER = 5.0
_PASSES = 5


@dataclass(frozen=True)
class Place:
    """Views of one place.

    Attributes:
        folder: of the images, inside that of the real data.
        files: of the images.
        crop: lines and samples of the scenes cut out of each.
    """

    folder: str
    files: tuple[str, ...]
    crop: int


PLACES = {
    "calanques": Place("phr_calanques_triplet", ("img_01.tif", "img_02.tif", "img_03.tif"), 760),
    "gizeh": Place("phr_gizeh_pair", ("img1.tif", "img2.tif"), 640),
    "iceland": Place("phr_iceland_pair", ("img_01.tif", "img_02.tif"), 560),
    "ventoux": Place("phr_ventoux_pair", ("left_image.tif", "right_image.tif"), 440),
}
VIEWS = tuple(
    f"{name}_{k + 1}" for k in range(3) for name, place in PLACES.items() if k < len(place.files)
)


@dataclass(frozen=True)
class RealView:
    """A real view, points made without its pixels' chips, and where it shows the ground of ties.

    Attributes:
        scene: the whole image with its model as delivered.
        crop: lines and samples of scenes cut out of it.
        another: the model of another view of the place.
        block: points with the chips of the other views.
        ground: (t, 3) where the rays of ties meet, in the frame of the points.
        line_sample: (t, 2) where the image shows it.
        placed: (n, 2) where the image shows the points.
        noise_px: median distance of a tie as measured from `line_sample`, which is smoother.
    """

    scene: Scene
    crop: int
    another: RpcModel
    block: Block
    ground: Array
    line_sample: Array
    placed: Array
    noise_px: float


def is_kept_apart(name: str) -> bool:
    """Whether the points of a view are made without it; those of a pair were measured in it as well."""
    return len(PLACES[_place_of(name)].files) > 2


def _place_of(name: str) -> str:
    return name.rsplit("_", 1)[0]


@lru_cache(maxsize=1)
def real_view(real_data: Path, name: str) -> RealView:
    """A view by its name; one is kept at a time.

    Two views of three give the points for the third. Of a pair both give them, with the chips of the
    other one alone: no pixel of the scene is matched with itself.
    """
    place, shown = PLACES[_place_of(name)], int(name.rsplit("_", 1)[1]) - 1
    scenes = [_in_memory(read_scene(real_data / place.folder / file)) for file in place.files]
    others = [k for k in range(len(scenes)) if k != shown]
    sources = others if len(others) > 1 else [0, 1]
    made = produce_points([scenes[k] for k in sources], CHIPS)
    of_others = [scenes[k].acquisition.image_id for k in others]
    block = _with_chips_of(made, of_others)
    tracks = independent_tracks([scene.image.read(_whole(scene)) for scene in scenes])
    ground, seen = ties_of(tracks, sources, made.adjustment.models, shown)
    models = dict(zip(sources, made.adjustment.models, strict=True))
    model = models.get(shown, scenes[shown].model)
    line_sample, fitting, offset, noise_px = smoothed_ties(model, ground, seen)
    return RealView(
        scenes[shown],
        place.crop,
        rpc_of(scenes[others[0]].model),
        block,
        ground[fitting],
        line_sample[fitting],
        moved_by(model.project(block.points.lon_lat_h), offset),
        noise_px,
    )


def _in_memory(scene: Scene) -> Scene:
    return replace(scene, image=ArrayImage(scene.image.read(_whole(scene))), sigma_m=PLEIADES_SIGMA_M)


def _whole(scene: Scene) -> Window:
    return Window(0, 0, *scene.image.shape)


def rpc_of(model: SensorModel) -> RpcModel:
    if not isinstance(model, RpcModel):
        raise TypeError(f"a view with an RPC expected, {type(model).__name__} given")
    return model


def ties_of(
    tracks: Observations, sources: list[int], models: Sequence[SensorModel], shown: int
) -> tuple[Array, Array]:
    """Ground (t, 3) where the rays of the sources meet, and where (t, 2) the image shown shows it."""
    count = int(tracks.point[-1]) + 1
    used = tracks.take(np.isin(tracks.image, sources))
    used = replace(used, image=np.searchsorted(sources, used.image))
    ground = intersect(models, used, count).lon_lat_h
    return ground, tracks.line_sample[tracks.image == shown]


def smoothed_ties(
    model: SensorModel, ground: Array, seen: Array, *, blunder: float = _BLUNDER, locally: bool = True
) -> tuple[Array, BoolArray, Array, float]:
    """Where an image shows ground: its model, an affine that fits the ties, and medians of neighbours.

    Args:
        model: as delivered.
        ground: (t, 3) of the ties.
        seen: (t, 2) where the image shows them.
        blunder: ties farther off than this many times the median are none.
        locally: whether medians of neighbours are added. Ties between dates err by more than models do
            beside an affine: they are noisy, and few.

    Returns:
        Positions (t, 2); ties (t,) that are no blunders; parameters (3, 2) of the affine; median
        distance of the ties from the positions, pixels.
    """
    modelled = model.project(ground)
    misfit = seen - modelled
    fitting = np.isfinite(misfit).all(axis=1)
    offset = np.zeros((3, 2))
    offset[0] = np.median(misfit[fitting], axis=0)
    for _ in range(_PASSES):
        rest = misfit - _design(modelled) @ offset
        far = np.linalg.norm(rest, axis=1)
        fitting = far < blunder * np.median(far[fitting])
        offset = np.linalg.lstsq(_design(modelled)[fitting], misfit[fitting], rcond=None)[0]
    rest = misfit - _design(modelled) @ offset
    places = moved_by(modelled, offset)
    if locally:
        tree = KDTree(places[fitting])
        _, near = tree.query(np.where(np.isfinite(places), places, 0.0), _NEIGHBOURS)
        places += np.median(rest[fitting][near], axis=1)
    noise_px = float(np.median(np.linalg.norm((seen - places)[fitting], axis=1)))
    return places, fitting, offset, noise_px


def _design(line_sample: Array) -> Array:
    return np.column_stack([np.ones(len(line_sample)), line_sample / 1000.0])


def moved_by(line_sample: Array, offset: Array) -> Array:
    return np.asarray(line_sample + _design(line_sample) @ offset)


def _with_chips_of(made: Production, image_ids: list[str]) -> Block:
    """The points of a production with the chips of some of its images alone."""
    points, views = made.points, made.points.views
    kept_images = [image.image_id in image_ids for image in views.images]
    kept = np.array(kept_images)[views.image]
    of_point = np.repeat(np.arange(len(points)), np.diff(views.start))
    counts = np.bincount(of_point[kept], minlength=len(points))
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    chips = np.concatenate([made.chips(row) for row in range(len(points))])[kept]
    fewer = Views(
        start,
        views.gsd_m[kept],
        views.image[kept],
        views.incidence_deg[kept],
        views.azimuth_deg[kept],
        views.health[kept],
        views.images,
    )
    alone = ControlPoints(
        points.id,
        points.lon_lat_h,
        points.covariance_m2,
        points.block,
        points.frames,
        points.saliency,
        points.health,
        fewer,
        np.zeros(len(points), dtype=np.int64),
        start[:-1].copy(),
        points.chip_files,
    )
    with_views = np.flatnonzero(counts > 0).astype(np.int64)
    return Block(alone.take(with_views), chips)
