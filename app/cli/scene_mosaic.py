"""`amers scene mosaic`: many scenes as one ortho-image, with the seams between them."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from amers.app.cli.box_option import box_of
from amers.app.cli.image_production import WorkOptions
from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.production_rows import effort_row
from amers.app.cli.progress import shown_progress
from amers.app.cli.terrain_options import TerrainOptions
from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.mosaic import MosaicGround, box_outline, run_mosaic, step_words
from amers.app.usecases.mosaic_scenes import MosaicFiles
from amers.services.mosaic.layout import MosaicMap
from amers.services.mosaic.options import MosaicOptions
from amers.services.orthorectification.rectify import OrthoOptions

Files = Annotated[MosaicFiles, Shown(images=typer.Argument(exists=True), registered=None, block=None)]


@dataclass(frozen=True)
class MapOptions:
    """The map of a mosaic.

    Attributes:
        crs: reference system of the map; by default the UTM zone at the centre of all scenes.
        gsd_m: pixel size of the map, metres; by default the ground sampling of the finest scene.
        bbox: bounding box of the map, W,S,E,N in degrees; scenes outside it are left out.
    """

    crs: str | None = None
    gsd_m: Annotated[float | None, typer.Option(min=0.001)] = None
    bbox: str | None = None

    def wanted(self) -> MosaicMap:
        """The same as the service takes it.

        Raises:
            InputError: the box cannot be used.
        """
        outline = None
        if self.bbox is not None:
            box = box_of(self.bbox)
            outline = box_outline(box.west, box.south, box.east, box.north)
        return MosaicMap(self.crs, self.gsd_m, outline)


@dataclass(frozen=True)
class MadeOptions:
    """How the mosaic is made.

    Attributes:
        height_m: height of flat ground above the ellipsoid, metres; replaces --dem.
        level: change the grey values of the scenes so that they agree where they overlap.
        anchor: with --level, name of the scene whose grey values stay unchanged; by default the mean of
            all scenes stays unchanged.
        feather_px: width of the strip along a seam in which both scenes are blended, pixels.
        hide: do not use a scene where the ground is hidden from it by other ground; other scenes fill
            this ground.
        kernel: interpolation: cubic or bilinear.
    """

    height_m: float | None = None
    level: bool = False
    anchor: str | None = None
    feather_px: Annotated[float, typer.Option(min=0.0, max=512.0)] = 0.0
    hide: bool = False
    kernel: str = "cubic"

    def options(self) -> MosaicOptions:
        """The same as the service takes it.

        Raises:
            InputError: the kernel is not known, or an anchor has nothing to do.
        """
        if self.kernel not in ("cubic", "bilinear"):
            raise InputError(f"--kernel: {self.kernel} found, cubic or bilinear expected")
        if self.anchor is not None and not self.level:
            raise InputError(
                f"--anchor: {self.anchor} given without --level, to which it belongs; add --level, or "
                "leave --anchor out"
            )
        kernel: Literal["cubic", "bilinear"] = "cubic" if self.kernel == "cubic" else "bilinear"
        ortho = OrthoOptions(kernel=kernel, hide=self.hide)
        return MosaicOptions(self.level, self.anchor, self.feather_px, ortho)


def mosaic(
    *,
    files: Files,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    ground: TerrainOptions,
    mosaic_map: MapOptions,
    made: MadeOptions,
    place: WorkOptions,
    as_json: AsJson = False,
) -> None:
    """Make an ortho-image of scenes, cut where they agree best; measure the steps at seams.

    The command writes three files: a cloud-optimised GeoTIFF, NAME.sources.tif with the scene number of
    each pixel, and NAME.seams.gpkg with the ground that each scene shows. With --registered or --block,
    it also measures the steps with the delivered models.
    """
    with shown_progress() as progress:
        written = run_mosaic(
            files,
            MosaicGround(ground.terrain, made.height_m),
            output,
            made.options(),
            wanted=mosaic_map.wanted(),
            place=WorkPlace(place.work, ComputeOptions(place.jobs, place.cluster)),
            progress=progress,
        )
    record = asdict(written)
    record |= effort_row(written.effort, as_json=as_json)
    if not as_json:
        record.pop("effort")
        step = written.seam_step
        record["seam_step"] = "no seams" if step is None else step_words(step)
        record["pairs"] = [f"{' + '.join(pair['scenes'])}: {step_words(pair)}" for pair in written.pairs]
        record["scenes"] = [f"{one['scene']} {100.0 * one['share']:.1f} %" for one in written.scenes]
    show_one(record, as_json=as_json)
