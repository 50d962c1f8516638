"""The tasks of the library: refine, register, produce points, maps, surfaces, vectors.

Each calls the use case that the command line and the service call; those have more options.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import ProductionImages, WorkPlace, run_image_production
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.mosaic import MosaicFile, MosaicGround, write_mosaic
from amers.app.usecases.mosaic_scenes import MosaicFiles, MosaicSource, sources_of
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.orthorectification import OrthoMap, Orthorectified, run_orthorectification
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.registration.control_marks import MarkFiles, read_control_marks
from amers.app.usecases.registration.control_sources import points_of_block
from amers.app.usecases.registration.on_marks import Refinement, read_marks, refine_on_marks, written
from amers.app.usecases.registration.reference_source import (
    CoveringReference,
    ReferenceFiles,
    given_reference,
    read_reference,
    register_on,
)
from amers.app.usecases.registration.register import ControlSources, SceneFiles, run_registration
from amers.app.usecases.registration.result_folder import replacing
from amers.app.usecases.registration.together import (
    BLOCK_FOLDER,
    JointPlace,
    run_joint_registration,
)
from amers.app.usecases.straightening import StraightenedScene, run_straightening
from amers.app.usecases.surface import (
    SurfaceFile,
    SurfaceFiles,
    check_images,
    run_surface,
    scene_of_file,
    write_surface,
)
from amers.app.usecases.terrain_file import TerrainFile
from amers.app.usecases.vector_files import CorrectionOptions, VectorFile
from amers.app.usecases.vectors import CorrectedFile, correct_file
from amers.opened import (
    Block,
    FilePath,
    Scene,
    Terrain,
    as_block,
    as_scene,
    ground_rows,
    open_block,
    rows_of,
)
from amers.services.errors import AmersError, InputError
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.pieces import source_of
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.formats.vector.pixel_coordinates import PixelOrigin
from amers.services.misfit.affine_fit import Order
from amers.services.mosaic.layout import MosaicMap
from amers.services.mosaic.options import MosaicOptions
from amers.services.orthorectification.rectify import OrthoOptions
from amers.services.production.image_production import ProductionOptions
from amers.services.quality.check_points import MARKING_SIGMA_PX, CheckPoints
from amers.services.quality.qualification import QualificationOptions
from amers.services.registration.on_marks import register_on_marks
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.joint import JointReport
from amers.services.surface.options import SurfaceOptions
from amers.services.types import Progress, no_progress


@dataclass(frozen=True, repr=False)
class JointRegistration:
    """Scenes registered together.

    Attributes:
        registrations: registration of each scene that fits, by the name of its image without suffix.
        failed: error of each scene that was not registered, by the name of its image without suffix.
        report: report on all scenes.
    """

    registrations: dict[str, Registration]
    failed: dict[str, AmersError]
    report: JointReport

    def __repr__(self) -> str:
        report = self.report
        return (
            f"JointRegistration: {report.verdict}; {report.verdict_words}\n"
            f"  {report.active_control_points} of {report.control_points} control points, "
            f"{report.tie_points} tie points\n"
            f"  not registered: {', '.join(self.failed) or 'none'}"
        )


def refine(
    scene: Scene | FilePath,
    marks: FilePath | tuple[ArrayLike, ArrayLike],
    folder: FilePath | None = None,
    *,
    heights: str | None = None,
    sigma_px: float = MARKING_SIGMA_PX,
    order: Order | None = None,
) -> Refinement:
    """Refine the model of a scene on known ground that you marked in its image.

    Args:
        scene: the scene or its path.
        marks: file of marked points in any format that Amers reads (GeoJSON, CSV, QGIS, ASP, ENVI, ODM,
            OPF, PCI); check points and points that are switched off are not used. Or a pair of arrays:
            ground positions (n, 3) as longitude, latitude, height above the ellipsoid, and their image
            positions (n, 2) as line and sample.
        folder: output folder for files with the refined model. By default no files are written.
        heights: vertical datum of the heights if the file does not state it; see `open_terrain`. By
            default the file must state it.
        sigma_px: precision of marks if the file states none, one standard deviation per coordinate,
            pixels. By default 0.5.
        order: order of a correction that least squares alone determine: "shift" needs two marks, "drift"
            three, "affine" four, which is one more than the minimum. By default None: the marks are
            weighted against the accuracy of the model, as by `register` with `control`. One mark is then
            enough, and wrong marks are rejected.

    Raises:
        InputError: a file cannot be used, or a latitude is beyond 90 degrees.
        ComputationError: the marks are too few for the correction, or do not determine it.
    """
    opened = as_scene(scene)
    files, content = opened.files, opened.content
    if not sigma_px > 0.0:
        raise InputError(f"sigma_px: {sigma_px:g} found, more than 0 px expected")
    if isinstance(marks, FilePath):
        read = read_marks(Path(marks), heights, files.image, content)
    else:
        read = _given_marks(*marks)
    read = replace(read, sigma_px=np.nan_to_num(read.sigma_px, nan=sigma_px))
    refinement = refine_on_marks(content, read, order)
    if folder is None:
        return refinement
    return written(refinement, files.image, files.model, content, Path(folder))


def register(  # noqa: PLR0913 - options by keyword, as those of the command
    scene: Scene | FilePath,
    block: Block | FilePath | None = None,
    folder: FilePath | None = None,
    *,
    control: FilePath | Sequence[FilePath] | None = None,
    control_heights: str | None = None,
    control_sigma_m: tuple[float, float] | None = None,
    control_frame_sigma_m: tuple[float, float] | None = None,
    check_points: FilePath | None = None,
    max_points: int = 500,
    max_ce90_on_earth_m: float | None = None,
    copy_image: bool = False,
    progress: Progress = no_progress,
) -> Registration:
    """Refine the model of a scene on the control points of a block, on your own marks, or on both.

    Args:
        scene: the scene or its path.
        block: the block or its folder. By default none: the scene is registered on marks alone.
        folder: output folder for the refined model, the report and the residuals. A result replaces an
            older result in the folder as a whole; a failure leaves the folder unchanged. By default
            nothing is written.
        control: file of ground points that you marked in the image, in any format that `refine` reads,
            or several files. One mark is enough; check points in the file take no part in the
            adjustment. By default none.
        control_heights: vertical datum of the heights of `control`, as `heights` of `refine`. By default
            the file must state it.
        control_sigma_m: horizontal and vertical standard deviation of the ground points of `control` if
            the file states none, metres. By default one pixel.
        control_frame_sigma_m: horizontal and vertical standard deviation of the common error of all
            ground points of `control` on the Earth, metres. By default it is unknown.
        check_points: file of marked points that take no part in the adjustment. They lower the verdict
            if the result contradicts them; needs a folder. By default none.
        max_points: largest number of points that are tried, well distributed over the image; more points
            take longer. By default 500; 0 tries all.
        max_ce90_on_earth_m: largest allowed CE90 on the Earth, metres; a result with a larger value is
            "failed". By default there is no limit.
        copy_image: also write a copy of a GeoTIFF with the refined model in its tags; needs a folder. By
            default no copy is written.
        progress: function that receives the completed fraction and a message. By default none.

    Returns:
        The registration. `model` is the refined model. `qualification` contains the verdict, the
        criteria and the accuracy. `marks` contains the result of each mark, and the place where one more
        mark would help most.

    Raises:
        InputError: the scene, the block, the marks or the folder cannot be used.
        ComputationError: the scene cannot be registered.
    """
    limits = QualificationOptions(max_ce90_on_earth_m=max_ce90_on_earth_m)
    options = RegistrationOptions(max_points=max_points, qualification=limits)
    marks = _mark_files(control, control_heights, control_sigma_m, control_frame_sigma_m)
    if block is None and marks is None:
        raise InputError("register: a block, marks (control), or both are expected")
    if folder is not None:
        points = None if block is None else points_of_block(_folder_of(block))
        sources = ControlSources(points, marks=marks)
        outputs = _Outputs(Path(folder), check_points, copy_image)
        return _registered(scene, sources, outputs, options, progress)
    _refuse_without_folder(check_points, copy_image)
    opened = as_scene(scene)
    content, own = opened.content, None
    if marks is not None:
        own = read_control_marks(marks, opened.files.image, content).control
    if block is None:
        assert own is not None
        return register_on_marks(content, own, options)
    base = as_block(block)
    return register_scene(content, base.points, base.chips, options, marks=own, progress=progress)


def register_on_reference(
    scene: Scene | FilePath,
    reference: FilePath | Sequence[FilePath],
    terrain: Terrain | FilePath | None,
    folder: FilePath | None = None,
    *,
    check_points: FilePath | None = None,
    max_ce90_on_earth_m: float | None = None,
    copy_image: bool = False,
    progress: Progress = no_progress,
) -> Registration:
    """Refine the model of a scene on a reference ortho-image and its terrain, without control points.

    Args:
        scene: the scene or its path.
        reference: ortho-image on a map: a path or an address, or several pieces of it; also a folder, an
            archive, a list or a STAC catalogue of pieces.
        terrain: heights of the same ground: an open terrain, or the path of a file that states its
            vertical datum. None only if the scene is an ortho-image, because heights do not displace it.
        folder, check_points, max_ce90_on_earth_m, copy_image, progress: as for `register`, with the same
            defaults.

    Returns:
        The registration, as for `register`; its points are the matched places.

    Raises:
        InputError: the scene, the reference or the folder cannot be used.
        ComputationError: the scene cannot be registered.
    """
    limits = QualificationOptions(max_ce90_on_earth_m=max_ce90_on_earth_m)
    options = RegistrationOptions(qualification=limits)
    if folder is None:
        _refuse_without_folder(check_points, copy_image)
    image = source_of([reference] if isinstance(reference, str | Path) else reference)
    files = ReferenceFiles(image, None if terrain is None else _terrain_file(terrain))
    if folder is not None:
        sources = ControlSources(find_reference=given_reference(files))
        outputs = _Outputs(Path(folder), check_points, copy_image)
        return _registered(scene, sources, outputs, options, progress)
    covering = CoveringReference(files.image.name, files)
    opened = read_reference(files)
    content = as_scene(scene).content
    return register_on(covering, opened, content, options, progress=progress)[0]


def register_together(
    scenes: Sequence[Scene | FilePath],
    block: Block | FilePath,
    folder: FilePath,
    *,
    copy_image: bool = False,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> JointRegistration:
    """Refine the models of overlapping scenes in one adjustment, connected by tie points.

    A scene that cannot be read or does not fit is left out, and does not stop the others.

    Args:
        scenes: scenes or their paths.
        block: the block or its folder.
        folder: output folder. It gets a folder for each scene, named by its image, and a folder "block"
            with the report on all scenes; older results in these folders are replaced.
        copy_image: also write copies of GeoTIFFs with the refined models in their tags. By default no
            copies are written.
        jobs: number of processes that search at the same time. By default 1: this process.
        progress: function that receives the completed fraction and a message. By default none.

    Raises:
        InputError: no scene can be used, or a folder cannot be replaced.
        ComputationError: no scene can be registered.
    """
    files = {one.image.stem: one for one in map(_files_of, scenes)}
    if len(files) < len(scenes) or BLOCK_FOLDER in files:
        raise InputError(
            f"scenes: images with different names expected, none of them {BLOCK_FOLDER}: each gives its "
            "name to the folder of its results"
        )
    with ExitStack() as stack:
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        new = {name: stack.enter_context(replacing(place / name)) for name in (*files, BLOCK_FOLDER)}
        outcome = run_joint_registration(
            files,
            points_of_block(_folder_of(block)),
            JointPlace(new.__getitem__, place.name, ComputeOptions(jobs)),
            copy_image=copy_image,
            progress=progress,
        )
    registrations = {name: one.registration for name, one in outcome.registered.items()}
    return JointRegistration(registrations, outcome.failed, outcome.report)


def produce_points(
    images: Sequence[FilePath],
    folder: FilePath,
    *,
    gsds_m: tuple[float, float] | None = None,
    points: int = 300,
    sigma_m: float | None = None,
    licence: str = "proprietary",
    jobs: int = 1,
    progress: Progress = no_progress,
) -> Block:
    """Make a block of control points from overlapping images.

    A report on the adjustment of the images is written into FOLDER.adjustment. A production that was
    interrupted continues when it is called again with the same arguments.

    Args:
        images: two or more images, with their models inside or next to them.
        folder: folder of the block, which gets the name of the folder; it must not exist.
        gsds_m: two ground samplings of the chips, the finer one first, metres: the ground sampling of
            the scenes to register, and a coarser one for models with large errors. By default the
            ground sampling of the coarsest image, and four times that.
        points: desired number of points. By default 300.
        sigma_m: accuracy of the models, one standard deviation per coordinate, metres. By default the
            accuracy that the producer states, otherwise that of the sensor, otherwise 50 m.
        licence: licence of points and chips, an SPDX identifier. By default "proprietary".
        jobs: number of processes. By default 1: this process.
        progress: function that receives the completed fraction and a message. By default none.

    Returns:
        The block that was written.

    Raises:
        InputError: an image cannot be used, or the folder exists.
        ComputationError: the images do not make a block.
    """
    new = Path(folder)
    fine_m, coarse_m = gsds_m or (None, None)
    run_image_production(
        ProductionImages(tuple(map(Path, images)), sigma_m=sigma_m),
        new,
        BlockIdentity(new.name, license=licence),
        ProductionOptions(fine_m, coarse_m, points=points),
        place=WorkPlace(compute=ComputeOptions(jobs)),
        progress=progress,
    )
    return open_block(new)


def orthorectify(
    scene: Scene | FilePath,
    terrain: Terrain | FilePath,
    output: FilePath,
    *,
    crs: str | None = None,
    gsd_m: float | None = None,
    hide: bool = False,
    registration: FilePath | None = None,
    progress: Progress = no_progress,
) -> Orthorectified:
    """Write a scene with all its bands as a cloud-optimised GeoTIFF on a map.

    Args:
        scene: the scene or its path.
        terrain: an open terrain, or the path of a file that states its vertical datum.
        output: path of the ortho-image; an existing file is replaced.
        crs: reference system of the map, such as "EPSG:32631". By default the UTM zone of the scene.
        gsd_m: pixel size of the map, metres. By default the ground sampling of the scene.
        hide: write nodata where the ground is hidden from the sensor by other ground. By default the map
            shows the hiding ground there.
        registration: output folder of `register`, whose refined model is used. By default the model of
            the scene, for example of a scene opened with `model=` and the file of a refined model.
        progress: function that receives the completed fraction and a message. By default none.

    Raises:
        InputError: the scene or the terrain cannot be used.
        ComputationError: the mapping cannot be computed within a tenth of a pixel.
    """
    files = _files_of(scene)
    return run_orthorectification(
        ImageFiles(files.image, files.model, files.crop_origin),
        _terrain_file(terrain),
        Path(output),
        ortho_map=OrthoMap(crs, gsd_m),
        options=OrthoOptions(hide=hide),
        registration=None if registration is None else Path(registration),
        progress=progress,
    )


def straighten(
    scene: Scene | FilePath,
    registration: FilePath,
    output: FilePath,
    *,
    progress: Progress = no_progress,
) -> StraightenedScene:
    """Resample a scene with displaced lines or samples, so that an RPC expresses its model.

    Args:
        scene: the delivered scene or its path.
        registration: output folder of `register`, which measured the displacements.
        output: path of the GeoTIFF; an existing file is replaced.
        progress: function that receives the completed fraction and a message. By default none.

    Raises:
        InputError: the scene or its registration cannot be used, or the correction is affine, so that
            nothing has to be straightened.
    """
    files = _files_of(scene)
    source = ImageFiles(files.image, files.model, files.crop_origin)
    return run_straightening(source, Path(registration), Path(output), progress)


def surface(
    scenes: Sequence[Scene | FilePath],
    output: FilePath,
    *,
    registered: FilePath | None = None,
    gsd_m: float | None = None,
    heights_m: tuple[float, float] | None = None,
    pairs: int = 10,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> SurfaceFile:
    """Write the surface that overlapping scenes show: heights on a map, with their accuracy.

    The bands are the height above the ellipsoid and its standard deviation in metres, the number of
    images, and a code for the reason if a cell has no height. An interrupted surface continues when it
    is called again with the same arguments.

    Args:
        scenes: two or more scenes or their paths; their models must agree.
        output: path of the GeoTIFF; an existing file is replaced.
        registered: output folder of `register_together`, whose refined models are used. By default the
            models of the scenes, for example of scenes opened with the adjusted models of a block.
        gsd_m: side of a cell, metres. By default the ground sampling of the finest scene.
        heights_m: lowest and highest height of the surface above the ellipsoid, metres. By default the
            height range of the models; a narrower range is faster.
        pairs: largest number of scene pairs that are matched. By default 10.
        jobs: number of processes. By default 1: this process.
        progress: function that receives the completed fraction and a message. By default none.

    Raises:
        InputError: a scene cannot be used.
        CoverageError: the scenes do not show the same ground, or nothing of it was matched.
    """
    images, file = tuple(_files_of(scene).image for scene in scenes), Path(output)
    options, place = SurfaceOptions(gsd_m, heights_m, pairs), WorkPlace(compute=ComputeOptions(jobs))
    if registered is not None:
        files = SurfaceFiles(images, Path(registered))
        return run_surface(files, file, options, place=place, progress=progress)
    check_images(images, file)
    with ExitStack() as stack:
        opened = [s if isinstance(s, Scene) else stack.enter_context(as_scene(s)) for s in scenes]
        named = [scene_of_file(one.content, image) for one, image in zip(opened, images, strict=True)]
        return write_surface(named, file, options, place=place, progress=progress)


def mosaic(
    scenes: Sequence[Scene | FilePath],
    output: FilePath,
    terrain: Terrain | FilePath | None = None,
    *,
    registered: FilePath | None = None,
    gsd_m: float | None = None,
    level: bool = False,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> MosaicFile:
    """Write one ortho-image of many scenes, cut where they agree best, and measure the steps at seams.

    Next to the output, NAME.sources.tif contains the scene number of each pixel, and NAME.seams.gpkg the
    ground that each scene shows. An interrupted mosaic continues when it is called again with the same
    arguments.

    Args:
        scenes: scenes or their paths, all with the same bands. A scene that lies completely within
            earlier scenes of this list is not shown.
        output: path of the GeoTIFF; an existing file is replaced.
        terrain: heights of the ground, or a surface: an open terrain, or the path of a file that states
            its vertical datum. By default none, which is possible only if all scenes are ortho-images.
        registered: output folder of `register_together`, whose refined models are used. By default the
            models of the scenes.
        gsd_m: pixel size of the map, metres. By default the ground sampling of the finest scene.
        level: change the grey values of the scenes so that they agree where the scenes overlap. By
            default the grey values stay unchanged.
        jobs: number of processes. By default 1: this process.
        progress: function that receives the completed fraction and a message. By default none.

    Raises:
        InputError: a file cannot be used, or the scenes have different bands.
        CoverageError: the terrain does not reach a scene.
    """
    files = [_files_of(scene) for scene in scenes]
    if registered is None:
        images = [MosaicSource(one.image, model=one.model, crop_origin=one.crop_origin) for one in files]
    else:
        images = sources_of(MosaicFiles(tuple(one.image for one in files), Path(registered)))
    return write_mosaic(
        images,
        MosaicGround(None if terrain is None else _terrain_file(terrain)),
        Path(output),
        MosaicOptions(level=level),
        wanted=MosaicMap(gsd_m=gsd_m),
        place=WorkPlace(compute=ComputeOptions(jobs)),
        progress=progress,
    )


def correct_vectors(
    vectors: FilePath,
    scene: Scene | FilePath,
    terrain: Terrain | FilePath,
    output: FilePath,
    *,
    registration: FilePath | None = None,
    crs: str | None = None,
    pixels: PixelOrigin = "qgis",
    sigma_px: float = 0.5,
) -> CorrectedFile:
    """Transform vectors drawn on a raw scene to the map, with their predicted accuracy.

    Args:
        vectors: GeoPackage, GeoJSON, shapefile or FlatGeobuf with one layer, in pixel coordinates of the
            scene.
        scene: the scene or its path.
        terrain: an open terrain, or the path of a file that states its vertical datum.
        output: output file; its suffix selects the format. An existing file is replaced.
        registration: output folder of `register`, whose refined model is used. By default none: the
            delivered model is used.
        crs: reference system of the map. By default the UTM zone of the scene, or EPSG:4326 for GeoJSON.
        pixels: pixel coordinates of the vectors: "qgis" (x is column, y is minus row, from the corner of
            the first pixel), or "corner" or "centre" (from this place of the first pixel, y downwards).
            By default "qgis".
        sigma_px: precision of the drawn vertices, one standard deviation per coordinate, pixels; it is
            part of the predicted accuracy. By default 0.5.

    Raises:
        InputError: a file cannot be used, or a vertex is outside the image, or its line of sight does
            not meet the terrain.
    """
    files = _files_of(scene)
    of_registration = None if registration is None else Path(registration)
    origin = None if files.crop_origin is None else "{},{}".format(*files.crop_origin)
    return correct_file(
        VectorFile(Path(vectors)),
        SceneModel(files.image, files.model, of_registration, files.sigma_m, origin),
        _terrain_file(terrain),
        Path(output),
        crs=crs,
        options=CorrectionOptions(pixels, sigma_px=sigma_px),
    )


def _given_marks(lon_lat_h: ArrayLike, line_sample: ArrayLike) -> CheckPoints:
    ground, marks = ground_rows(lon_lat_h, "marks"), rows_of(line_sample, "marks", (2,))
    if len(ground) != len(marks):
        raise InputError(
            f"marks: {len(ground)} ground positions and {len(marks)} image positions found, as many of "
            "both expected"
        )
    unknown = np.full((len(marks), 3), np.nan)
    return CheckPoints(ground, marks, unknown, unknown[:, 0])


@dataclass(frozen=True)
class _Outputs:
    """Where the results of a registration go, and what they include."""

    folder: Path
    check_points: FilePath | None
    copy_image: bool


def _registered(
    scene: Scene | FilePath,
    sources: ControlSources,
    outputs: _Outputs,
    options: RegistrationOptions,
    progress: Progress,
) -> Registration:
    """The registration of a scene whose results are written."""
    files = _files_of(scene)
    if outputs.check_points is not None:
        files = replace(files, check_points=Path(outputs.check_points))
    with replacing(outputs.folder) as new:
        copy_image = outputs.copy_image
        run = run_registration(
            files, sources, new, options=options, copy_image=copy_image, progress=progress
        )
    return run.registration


def _mark_files(
    control: FilePath | Sequence[FilePath] | None,
    heights: str | None,
    sigma_m: tuple[float, float] | None,
    frame_sigma_m: tuple[float, float] | None,
) -> MarkFiles | None:
    """Files of marks, with what the caller states of them; None without any."""
    if control is None:
        return None
    paths = (control,) if isinstance(control, FilePath) else tuple(control)
    points = PointStatements(StatedByCaller(heights), sigma_m, frame_sigma_m)
    return MarkFiles(tuple(Path(path) for path in paths), points)


def _refuse_without_folder(check_points: FilePath | None, copy_image: bool) -> None:
    if check_points is not None or copy_image:
        raise InputError("check_points, copy_image: a folder for the results is expected with them")


def _files_of(scene: Scene | FilePath) -> SceneFiles:
    return scene.files if isinstance(scene, Scene) else SceneFiles(Path(scene))


def _folder_of(block: Block | FilePath) -> Path:
    return block.folder if isinstance(block, Block) else Path(block)


def _terrain_file(terrain: Terrain | FilePath) -> TerrainFile:
    if isinstance(terrain, Terrain):
        return terrain.file
    return TerrainFile(source_of([terrain]), geoid_option="`geoid`")
