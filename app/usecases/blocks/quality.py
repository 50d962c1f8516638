"""Measure the quality of a block against references, and write its report."""

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import chain
from pathlib import Path

from amers.app.errors import InputError
from amers.app.usecases.registration.reference_source import ReferenceFiles, read_reference
from amers.app.usecases.registration.result_folder import replacing
from amers.app.usecases.report_files import write_report
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.block.check import check_block
from amers.services.formats.block.document import BlockMetadata
from amers.services.formats.block.reader import FolderChips, block_member
from amers.services.formats.ground_masks import any_of, read_ground_mask, read_land_cover
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.quality.block_cells import block_cells
from amers.services.quality.block_heights import HeightErrors, HeightModel, HeightQuality
from amers.services.quality.block_heights import height_errors as compare_heights
from amers.services.quality.block_heights import height_quality as summarise_heights
from amers.services.quality.block_requirements import BlockRequirements
from amers.services.quality.planimetry import PlanimetricQuality, planimetric_quality
from amers.services.quality.site_errors import Site, SiteErrors, expected_reach_m, point_errors
from amers.services.quality.site_images import image_errors, least_inclined
from amers.services.reports.block_quality import (
    BlockIdentification,
    BlockQualityReport,
    Measured,
    MeasuredErrors,
    block_quality_report,
)
from amers.services.reports.block_quality_pages import QUALITY_PAGE
from amers.services.statements import Statements, gathered
from amers.services.types import ChipSource, ControlPoints, Progress, no_progress, part_of

LEAST_INCLINED = 10
"""Images that are compared with the ortho-image of a site."""
DOCUMENT, PAGE = "block_quality.json", "block_quality.html"


@dataclass(frozen=True)
class HeightFiles:
    """Heights that those of the points are compared with.

    Attributes:
        terrain: a terrain or surface model.
        sigma_m: of its heights, one standard deviation, independent from point to point; by default
            that of each cell of a surface, else a tenth of the distance of its nodes.
        frame_sigma_m: of the error that all its heights share; None when unknown.
        excluded: masks of ground where its heights are not to be trusted.
        land_cover: image on a map with the classes of the ground.
    """

    terrain: TerrainFile
    sigma_m: float | None = None
    frame_sigma_m: float | None = None
    excluded: tuple[Path, ...] = ()
    land_cover: Path | None = None


@dataclass(frozen=True)
class SiteFile:
    """A reference ortho-image.

    Attributes:
        image: on a map.
        is_control: whether the production used it as control.
    """

    image: Path
    is_control: bool = False


@dataclass(frozen=True)
class QualityReferences:
    """What a block is measured against.

    Attributes:
        heights: None compares no heights.
        sites: places with ortho-images.
        site_sigma_m: accuracy of the reference ortho-images, one sigma per coordinate, metres.
        reach_m: largest shift that is searched at the reference images, metres; by default 3 times the
            declared sigma.
        images: image of the block to compare with the reference images; only for a block folder; repeat
            for several.
        excluded: ground where no points are expected, such as water: GeoJSON, or an image that is not 0
            there; repeat for several.
    """

    heights: HeightFiles | None = None
    sites: tuple[SiteFile, ...] = ()
    site_sigma_m: float | None = None
    reach_m: float | None = None
    images: tuple[Path, ...] = ()
    excluded: tuple[Path, ...] = ()


@dataclass(frozen=True)
class RequiredQuality:
    """Requirements that replace those that the block itself specifies.

    Attributes:
        points_per_km2: required points per square kilometre; by default the density that the block
            specifies.
        min_share: share of the ground, by cells, that shall reach the density, 0 to 1.
        min_views: required number of images that show a point; by default as the block specifies.
        ce90_m: largest allowed CE90 on the Earth, metres.
        le90_m: largest allowed LE90 on the Earth, metres.
    """

    points_per_km2: float | None = None
    min_share: float = BlockRequirements.min_share
    min_views: int | None = None
    ce90_m: float | None = None
    le90_m: float | None = None

    def __post_init__(self) -> None:
        """Refuse requirements that are no lengths, numbers or shares."""
        for name in ("points_per_km2", "min_views", "ce90_m", "le90_m"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name}: {value:g} found, more than 0 expected")
        if not 0.0 <= self.min_share <= 1.0:
            raise InputError(f"min_share: {self.min_share:g} found, a share of 0 to 1 expected")

    def of_block(self, metadata: BlockMetadata) -> BlockRequirements:
        """The requirements of a block."""
        specified = metadata.specification
        return BlockRequirements(
            points_per_km2=self.points_per_km2 or specified.points_per_km2,
            min_share=self.min_share,
            min_views=self.min_views or specified.min_views,
            ce90_m=self.ce90_m,
            le90_m=self.le90_m,
        )


@dataclass(frozen=True)
class BlockToAssess:
    """A block with its points and chips, from a folder or from the store.

    Attributes:
        metadata: of the block.
        points: all of them.
        chips: of the points.
        models: file with the adjusted model of each image, None where the block has none, by the name of
            the image; empty for a block of the store, which keeps no models.
    """

    metadata: BlockMetadata
    points: ControlPoints
    chips: ChipSource
    models: Mapping[str, Path | None]


def assess_folder(
    folder: Path,
    references: QualityReferences,
    required: RequiredQuality,
    progress: Progress = no_progress,
) -> BlockQualityReport:
    """The quality of a block in a folder, which is checked completely first.

    Raises:
        FormatError: the block breaks its format.
        InputError: a reference cannot be used.
    """
    contents = check_block(folder, part_of(progress, 0.0, 0.1))
    with FolderChips(folder) as chips:
        document = contents.document
        models = {
            image.image_id: None if name is None else block_member(folder, name)
            for image, name in zip(document.images, document.models, strict=True)
        }
        block = BlockToAssess(document.metadata, contents.points, chips, models)
        return assess_block(block, references, required, part_of(progress, 0.1, 0.9))


def assess_block(
    block: BlockToAssess,
    references: QualityReferences,
    required: RequiredQuality,
    progress: Progress = no_progress,
) -> BlockQualityReport:
    """The quality of a block: from its own points, and against references.

    Raises:
        InputError: a reference cannot be used.
    """
    started, now = time.monotonic(), datetime.now(UTC)
    points, metadata = block.points, block.metadata
    requirements = required.of_block(metadata)
    masks = [read_ground_mask(path) for path in references.excluded]
    stated = [mask.statements for mask in masks]
    excluded = any_of([*masks])
    progress(0.0, "density")
    cells = block_cells(points, metadata.extent, requirements.min_views, now, excluded)
    heights, height_errors = None, None
    if references.heights is not None:
        progress(0.1, "heights")
        heights, height_errors = _measure_heights(points, references.heights, stated)
    planimetry, errors = _measure_sites(block, references, stated, part_of(progress, 0.3, 0.7))
    progress(1.0, "done")
    report = block_quality_report(
        BlockIdentification(metadata.id, metadata.version, metadata.title, metadata.created),
        points,
        cells,
        requirements,
        Measured(heights, planimetry, MeasuredErrors(metadata.extent, height_errors, errors)),
        assessed_at=now,
        seconds=time.monotonic() - started,
        software_version=version("amers"),
    )
    return replace(report, statements=gathered(chain(*stated)))


def write_quality(report: BlockQualityReport, folder: Path) -> None:
    """Write the document and the page of a report into a folder; an older result there is replaced.

    Raises:
        InputError: the folder cannot be written or replaced.
    """
    with replacing(folder, DOCUMENT) as new:
        write_quality_files(report, new)


def write_quality_files(report: BlockQualityReport, folder: Path) -> dict[str, Path]:
    """Write the document and the page of a report into a folder; returns the files by name."""
    return write_report(folder, QUALITY_PAGE, report, "block_quality")


def _measure_heights(
    points: ControlPoints, files: HeightFiles, stated: list[Statements]
) -> tuple[HeightQuality, HeightErrors]:
    """The heights of points against a height model; what its files state is added to `stated`."""
    terrain = read_terrain(files.terrain, files.sigma_m)
    masks = [read_ground_mask(path) for path in files.excluded]
    stated.extend([terrain.statements, *(mask.statements for mask in masks)])
    model = HeightModel(terrain, files.frame_sigma_m or 0.0, any_of([*masks]))
    errors = compare_heights(points, model)
    cover = None
    if files.land_cover is not None:
        classes = read_land_cover(files.land_cover)
        stated.append(classes.statements)
        cover = classes(errors.lon_lat)
    return summarise_heights(errors, points, model, files.terrain.dem.name, cover), errors


def _measure_sites(
    block: BlockToAssess,
    references: QualityReferences,
    stated: list[Statements],
    progress: Progress,
) -> tuple[tuple[PlanimetricQuality, ...], tuple[SiteErrors, ...]]:
    """The planimetry of the points at sites, then that of the images where there are any."""
    sites = _read_sites(references)
    stated.extend(site.reference.statements for site in sites)
    if not sites:
        return (), ()
    frame, share = block.points.frames[0], (0.5 if references.images else 1.0) / len(sites)
    of_points = []
    for k, site in enumerate(sites):
        part = part_of(progress, k * share, share)
        of_points.append(point_errors(block.points, block.chips, site, references.reach_m, part))
    planimetry = [planimetric_quality(of_points, "points", frame)]
    of_images = _measure_images(block, references, sites, part_of(progress, 0.5, 0.5))
    if of_images:
        planimetry.append(planimetric_quality(of_images, "images", frame))
    return tuple(planimetry), (*of_points, *of_images)


def _read_sites(references: QualityReferences) -> list[Site]:
    names = [file.image.stem for file in references.sites]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise InputError(f"sites: two files are named {repeated}: name each site by a file of its own")
    if references.images and not names:
        raise InputError("images: no site to compare them with; add reference ortho-images (--site)")
    return [
        Site(
            file.image.stem,
            file.is_control,
            read_reference(ReferenceFiles(file.image, None, references.site_sigma_m)),
        )
        for file in references.sites
    ]


def _measure_images(
    block: BlockToAssess, references: QualityReferences, sites: list[Site], progress: Progress
) -> list[SiteErrors]:
    """The errors of the least inclined of some images of the block, at each site."""
    heights = references.heights
    terrain = None if heights is None else read_terrain(heights.terrain)
    errors = []
    with ExitStack() as stack:
        scenes = []
        for path in references.images:
            scenes.append(_read_adjusted(block, path))
            stack.callback(scenes[-1].image.close)  # type: ignore[attr-defined]
        for k, site in enumerate(sites if scenes else ()):
            reach_m = references.reach_m or expected_reach_m(block.points, site)
            for scene in least_inclined(scenes, site, terrain, LEAST_INCLINED):
                progress(k / len(sites), f"{scene.acquisition.image_id} at {site.name}")
                errors.append(image_errors(scene, site, terrain, reach_m))
    if references.images and not errors:
        raise InputError(
            f"images: none of {len(references.images)} shows the middle of a site where heights are "
            "known; give other images, or heights of the sites (--dem)"
        )
    return errors


def _read_adjusted(block: BlockToAssess, path: Path) -> Scene:
    """An image of the block with its adjusted model; with its own map where the block has none."""
    if path.stem not in block.models:
        names = ", ".join(sorted(block.models))
        raise InputError(
            f"{path}: {path.stem[:100]} is no image of the block; expected one of {names[:300]}"
        )
    model = block.models[path.stem]
    return read_scene(path, model, sigma_m=1.0, crop_origin=None if model is None else (0.0, 0.0))
