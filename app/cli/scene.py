"""`amers scene register`: scenes registered one by one."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.control_options import MarkOptions
from amers.app.cli.options import FromMilli, GeoidFile, Places, refuse_alone, words_of
from amers.app.cli.output import AsJson
from amers.app.cli.scene_registration import (
    Control,
    Remote,
    SceneRequest,
    images_of,
    register_scenes,
    worst_status,
)
from amers.app.cli.scene_rows import (
    refuse_shared_files,
    show_failures,
    show_outcome,
    show_outcomes,
    write_overview,
)
from amers.app.errors import InputError
from amers.app.usecases.model_choice import CropOrigin, ModelChoice
from amers.app.usecases.registration.control_marks import MarkFiles
from amers.app.usecases.registration.reference_source import ReferenceFiles, check_map
from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.images.scenes import scene_name
from amers.services.formats.pieces import source_of


@dataclass(frozen=True)
class ControlOptions:
    """What scenes are registered on; by default the points of the store.

    Attributes:
        block: block folder whose points are used instead of the store.
        reference: ortho-image to register on, or its pieces: file, folder, .SAFE, .zip, .vrt, .txt list
            or STAC catalogue; path or address; repeat for several. With --block, it is used only if the
            block has no points in the scene.
        dem: heights of the ground of --reference, in one file or in pieces, with the same choices as for
            --reference.
        vertical: vertical datum of the heights of --dem: ellipsoid, EGM96, EPSG:…
        geoid: grid file of the geoid, GTX or GeoTIFF; also its name among PROJ's grids.
        reference_sigma_m: accuracy of the reference on the Earth, one sigma, metres.
        reference_sigma_up_m: accuracy of the heights of the reference on the Earth, one sigma, metres.
    """

    block: Path | None = None
    reference: Places = ()
    dem: Places = ()
    vertical: str | None = None
    geoid: GeoidFile = None
    reference_sigma_m: FromMilli = None
    reference_sigma_up_m: FromMilli = None

    def files(self, marks: MarkFiles | None) -> Control:
        """The block, the reference, and the marks of a person.

        Raises:
            InputError: an option belongs to a file that is not given, or the reference is not on a map.
        """
        refuse_alone("reference", self, "dem", "reference_sigma_m", "reference_sigma_up_m")
        refuse_alone("dem", self, "vertical", "geoid")
        if not self.reference:
            return Control(self.block, None, marks)
        image = source_of(self.reference)
        check_map(image)
        terrain = TerrainFile(source_of(self.dem), self.vertical, self.geoid) if self.dem else None
        reference = ReferenceFiles(image, terrain, self.reference_sigma_m, self.reference_sigma_up_m)
        return Control(self.block, reference, marks)


@dataclass(frozen=True)
class SceneOptions:
    """How scenes are read.

    Attributes:
        bands: bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.
        mask: image of the same ground, used as a mask: pixels of the scene are ignored where it is not
            0.
        check_points: file of check points, which take no part in the adjustment: ASP, QGIS, ENVI, ODM,
            PCI, GeoJSON or OPF.
        check_heights: vertical datum of the check points if the file does not state it: ellipsoid,
            EPSG:…
    """

    bands: str | None = None
    mask: Path | None = None
    check_points: Path | None = None
    check_heights: str | None = None

    @property
    def files_of_one(self) -> list[str]:
        """The options given whose file belongs to one scene."""
        files = {"--mask": self.mask, "--check-points": self.check_points}
        return [name for name, file in files.items() if file is not None]

    def of(
        self, image: Path, model: tuple[Path | None, CropOrigin | None], sigma_m: float | None
    ) -> SceneFiles:
        """The files of one scene."""
        return SceneFiles(
            image,
            model[0],
            sigma_m,
            self.bands,
            self.mask,
            self.check_points,
            self.check_heights,
            crop_origin=model[1],
        )


@dataclass(frozen=True)
class ResultOptions:
    """What a registration must reach, and where its result goes.

    Attributes:
        max_ce90_on_earth_m: largest allowed CE90 on the Earth, metres, including the common error of the
            points.
        copy_image: also write a copy of a GeoTIFF with the refined model in its tags.
        output: output folder; with several scenes, each scene gets its own folder inside it.
    """

    max_ce90_on_earth_m: FromMilli = None
    copy_image: bool = False
    output: Annotated[Path, typer.Option("-o")] = Path("registered")


@dataclass(frozen=True)
class WorkOptions:
    """Who does the work.

    Attributes:
        jobs: number of scenes that are registered at once, each in its own process.
        server: address of an Amers service that registers the scenes instead of this machine.
        token: token for the service; the environment variable is safer, because other users can see a
            command line.
    """

    jobs: Annotated[int, typer.Option(min=1)] = 1
    server: str | None = None
    token: Annotated[str | None, typer.Option(envvar="AMERS_TOKEN")] = None

    def remote(self, control: ControlOptions) -> Remote | None:
        """The service; None without any.

        Raises:
            InputError: the service is told what only this machine can do.
        """
        if self.server is None:
            return None
        if control.reference or control.block is not None:
            raise InputError(
                "--server: the service uses its own points and references; leave out --block and "
                "--reference"
            )
        if self.jobs > 1:
            raise InputError(
                "--jobs: the workers of the service do the jobs; leave it out with --server"
            )
        return Remote(self.server, self.token or "")


def register(
    context: typer.Context,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            help="Images: GeoTIFF, JPEG 2000, NITF, DIM_….XML or .TIL of a product in tiles, or "
            "folders of these."
        ),
    ],
    *,
    control: ControlOptions,
    marks: MarkOptions,
    sigma_m: Annotated[
        float | None,
        typer.Option(
            help="Accuracy of the delivered sensor model, one sigma, metres; the search covers "
            "three times this value.",
            min=0.01,
        ),
    ] = None,
    models: ModelChoice,
    options: SceneOptions,
    result: ResultOptions,
    work: WorkOptions,
    as_json: AsJson = False,
) -> None:
    """Refine the sensor models of scenes on control points; write report, points and refined models.

    With several scenes, each scene gets its own folder in the output folder, and a failed scene does not
    stop the others. A result replaces an older result in its folder as a whole. A folder with other
    files is refused.

    The points come from the store unless --block, --reference, --control or --server is given. With
    --control alone, the scene is registered on marks that a person set in it: one mark determines a
    shift.
    """
    images = images_of(scenes)
    is_one_scene = len(scenes) == len(images) == 1 and not scenes[0].is_dir()
    mark_files = marks.files(of_many=len(images) > 1)
    remote = work.remote(control)
    refuse_shared_files(images, options.files_of_one)
    control_files = control.files(mark_files)
    models_of = models.of(images)
    repeated = [*words_of(options), *words_of(control), *words_of(marks)]
    repeated += words_of(replace(result, output=ResultOptions.output))
    repeated += [] if work.server is None else ["--server", work.server]
    requests = []
    for image in images:
        folder = result.output if is_one_scene else result.output / scene_name(image)
        # Without the accuracy of the model, which the report of a failure advises to state anew.
        words = [str(image), *_model_words(*models_of[image]), *repeated, "-o", str(folder)]
        command = shlex.join(["amers", "scene", "register", *words])
        requests.append(
            SceneRequest(
                options.of(image, models_of[image], sigma_m),
                folder,
                result.copy_image,
                command,
                result.max_ce90_on_earth_m,
            )
        )
    outcomes = register_scenes(requests, control_files, remote, work.jobs)
    show_failures(outcomes, context)
    if is_one_scene:
        show_outcome(outcomes[0], as_json=as_json)
    else:
        write_overview(outcomes, result.output)
        show_outcomes(outcomes, as_json=as_json)
    raise typer.Exit(worst_status(outcomes))


def _model_words(model: Path | None, crop_origin: CropOrigin | None) -> list[str]:
    """The words of a command line that give one image its model."""
    words = [] if model is None else ["--model", str(model)]
    return words if crop_origin is None else [*words, "--crop-origin", "{},{}".format(*crop_origin)]
