"""Scenes: an image file with its sensor model, its acquisition and its accuracy."""

import math
import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.band_registration import with_registered_bands
from amers.services.formats.images.bands import BandMix
from amers.services.formats.images.georeference import georeference
from amers.services.formats.images.map_statements import map_statements, unused_heights
from amers.services.formats.images.masks import MaskedImage, apply_mask
from amers.services.formats.images.raster import map_grid_of, shift_of_grid
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.formats.sensor_models.dimap import (
    parse_dimap_acquisition,
    parse_dimap_pixel_codes,
    parse_imaging_time,
)
from amers.services.formats.sensor_models.geom import parse_geom_acquisition
from amers.services.formats.sensor_models.product_image import open_image
from amers.services.formats.sensor_models.rigorous_files import rigorous_model_of_image
from amers.services.formats.sensor_models.rpc_files import DeliveredModel, has_rpc, model_of_image
from amers.services.formats.sensor_models.rpc_text import rpb_satellite
from amers.services.formats.sensor_models.worldview_isd import parse_isd_acquisition
from amers.services.formats.text_files import parse_xml, read_text
from amers.services.geodesy import sun_direction
from amers.services.imagery.scene import Scene, view_direction
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.parameter_sets import ParameterSet
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import Acquisition, Array

CE90_TO_SIGMA = 1.0 / math.sqrt(2.0 * math.log(10.0))
"""Ratio of one standard deviation of each coordinate to CE90, for a circular normal law: 1 / 2.1460."""

CE90_M = (
    ("PHR", 8.5),
    ("PNEO", 5.0),
    ("SPOT6", 10.0),
    ("SPOT7", 10.0),
    ("SPOT5", 75.0),
    *((f"SPOT{number}", 530.0) for number in (1, 2, 3, 4)),
    ("WV", 5.0),
    ("GE01", 5.0),
    ("QB02", 21.0),
)
"""Horizontal accuracy without control points, by the start of the sensor's name, metres.

Sources: Pléiades and Pléiades Neo, imagery user guides of Airbus Defence and Space (incidence up to 30
degrees); SPOT 6/7, their technical sheet; SPOT 5, an attitude known to 6e-5 rad (ESA), 50 m rms; SPOT 1
to 4, "300 to 500 metres (rms)" of Spot Image, taken as 350 m as Toutin and Carbonneau (1992) do, both
for a circular normal law; WorldView and GeoEye, "better than 5 m CE90" of their
operator; QuickBird, Smiley (2009), the worst quarter in two years.
"""

ORTHO_CE90_M = (("S2", 17.5), ("LC0", 18.2), ("LO0", 18.2))
"""Horizontal accuracy of delivered ortho-images, by the start of the sensor's name, metres.

Sentinel-2: 20 m at two standard deviations without control points (ESA, GMES-GSEG-EOPG-TN-09-0008, table
4-6), taken as 95 % of a circular normal law, hence 17.5 m CE90. Since 2021, products refined on the
mission's reference images reach 8 m at 95 %, but the image file does not show whether it is refined.
Landsat 8 and 9: a Tier 1 scene has a radial root mean square error of at most 12 m (USGS, Landsat
Collections), hence 18.2 m CE90 for a circular normal law; the USGS states no figure for Tier 2.
"""

_GRANULE = re.compile(r"^T\d{2}[A-Z]{3}_\d{8}T\d{6}_", re.IGNORECASE)
"""File names of granules of Sentinel-2: tile, and the time when they were seen."""

_SENSOR_IN_NAME = (
    (re.compile(r"(?:^|_)(S2[A-D])_", re.IGNORECASE), "{0}"),
    (_GRANULE, "S2"),
    (re.compile(r"(?:^|_)(L[CO]0[89])_L1TP_(?:\d+_){4}T1(?:_|$)", re.IGNORECASE), "{0}"),
)
"""Patterns of the file names of ortho-images, with the name of the sensor."""

_FIRST_LINE_TIME = re.compile(r"\bfirstLineTime\s*=\s*\"?([\d-]+)T([\d:.]+)Z")
_TIME_OF_DIGITS = re.compile(r"(\d{4})(\d{2})(\d{2})(\d{2})(\d{2})(\d{2})")
_TIME_IN_NAME = re.compile(r"_(\d{4})(\d{2})(\d{2})T(\d{2})(\d{2})(\d{2})")

UNKNOWN_SIGMA_M = 50.0
"""Accuracy of a model when neither its producer nor its sensor is known."""


def read_scene(
    path: FilePlace,
    model_path: Path | None = None,
    *,
    sigma_m: float | None = None,
    ortho_sigma_m: float | None = None,
    bands: BandMix | None = None,
    crop_origin: tuple[float, float] | None = None,
    mask: Path | None = None,
    parameter_set: ParameterSet | None = None,
) -> Scene:
    """The scene of an image file with its sensor model; the image stays open and is read by windows.

    An image with a map grid and without an RPC is an ortho-image.

    Args:
        path: GeoTIFF, JPEG 2000 or NITF; or its address, beside which its model lies.
        model_path, crop_origin: as for `read_rpc`.
        sigma_m: horizontal accuracy of the model, one standard deviation of each coordinate; by default
            the figure of the producer, else that of the sensor, else 50 m. Required for an ortho-image
            of an unknown sensor. The accuracy of a datum transformation is added to it.
        ortho_sigma_m: the same where the image is an ortho-image; by default `sigma_m`.
        bands: the bands to use; by default the panchromatic band or the mean of the visible bands.
        mask: image of the same ground, with the same or coarser pixels, nonzero where pixels are
            excluded.
        parameter_set: keep the rigorous model of an image whose metadata have one, with these parameters
            free; other images are read as without it. By default every model is an RPC or a map grid.

    Raises:
        FormatError: the image, its model or its mask cannot be used.
    """
    image = open_image(path, bands)
    siblings = Siblings(image.path)
    try:
        image = _with_bands(image, is_requested=bands is not None)
        rigorous = None
        if parameter_set is not None:
            rigorous = rigorous_model_of_image(image, model_path, crop_origin)
        grid = map_grid_of(image) if rigorous is None else None
        file: FilePlace | None = model_path
        if grid is not None or rigorous is not None:
            has_model = model_path is not None or crop_origin is not None or has_rpc(image, siblings)
            if grid is not None and not has_model:
                return _ortho_scene(image, grid, ortho_sigma_m or sigma_m, mask)
            if rigorous is not None and not has_model:
                file = rigorous.path
        delivered = model_of_image(image, file, crop_origin, siblings)
        acquisition = _acquisition(image, delivered)
        image = _with_codes(image, delivered)
        source = _masked(image, mask)
    except FormatError:
        image.close()
        raise
    sigma_m, accuracy = _accuracy(delivered, acquisition.sensor, sigma_m)
    statements = (
        *source.statements,
        *delivered.statements,
        *_unused_grid(image, delivered),
        *_identity(acquisition, image, delivered),
        *accuracy,
    )
    if rigorous is None:
        statements += _through_rpc(delivered)
        return Scene(source, delivered.model, acquisition, sigma_m, statements=statements)
    model = rigorous.model
    if delivered.convention != "rigorous":
        model = replace(model, height_range_m=delivered.model.height_range_m)
    used = Statement(rigorous.path.name, Subject.MODEL, Use.USED, "rigorous sensor model")
    return Scene(source, model, acquisition, sigma_m, parameter_set, (used, *statements))


def _through_rpc(delivered: DeliveredModel) -> Statements:
    """What is not adjusted of a rigorous model that is read as an RPC; nothing of other models."""
    if delivered.convention != "rigorous":
        return ()
    note = "the RPC fitted to them is used; amers scene register-many --rigorous srp adjusts them"
    value = "parameters of orbit and attitude"
    return (Statement(delivered.path.name, Subject.MODEL, Use.NOT_USED, value, note=note),)


def scene_name(path: FilePlace) -> str:
    """The name of a scene: that of its file; where all files are called alike, that of its product.

    The images of SPOT 1 to 5 are all called `IMAGERY.TIF`, and their documents `METADATA.DIM`: the
    document has the name of the product, else the folder has one.

    Args:
        path: of its image, of the document of its product, or of a folder.
    """
    if path.stem.upper() not in ("IMAGERY", "METADATA"):
        return path.stem
    found = Siblings(path).named(["METADATA.DIM"])
    try:
        root = parse_xml(read_text(found[0]), found[0].name) if found else None
    except FormatError:
        root = None
    elements = ("DATASET_NAME", "SOURCE_ID", "JOB_ID")
    stated = [] if root is None else [root.findtext(f".//{element}", "") for element in elements]
    names = [re.sub(r"\W+", "_", name.strip()).strip("_")[:100] for name in stated]
    if any(names):
        return next(name for name in names if name)
    return path.resolve().parent.name if isinstance(path, Path) else path.stem


def _ortho_scene(image: SceneImage, grid: MapGrid, sigma_m: float | None, mask: Path | None) -> Scene:
    acquisition = _with_sun(_ortho_acquisition(image), grid, image.shape)
    if sigma_m is None:
        sigma_m = _ortho_sigma_m(image.path, acquisition.sensor)
    shift = shift_of_grid(image, grid)
    stated = map_statements(image, grid, shift) + unused_heights(image, grid)
    source = _masked(image, mask)
    return Scene(
        source,
        OrthoModel(grid),
        acquisition,
        math.hypot(sigma_m, shift.sigma_m),
        statements=(*source.statements, *stated),
    )


def _accuracy(delivered: DeliveredModel, sensor: str, sigma_m: float | None) -> tuple[float, Statements]:
    """The accuracy of a model, and what its file and its sensor state of it."""
    name, model = delivered.path.name, delivered.model
    stated_m = model.error_bias_m
    if sigma_m is not None:
        if not stated_m > 0.0 or sigma_m == stated_m:
            return sigma_m, ()
        value, note = f"bias {stated_m:g} m", f"{sigma_m:g} m was given"
        stated = Statement(name, Subject.ACCURACY, Use.NOT_USED, value, note=note, is_usual=True)
        return sigma_m, (stated,)
    prior_m = prior_sigma_m(model, sensor)
    if stated_m > 0.0:
        return prior_m, (Statement(name, Subject.ACCURACY, Use.USED, f"{prior_m:.2f} m, one sigma"),)
    known = any(sensor.startswith(start) for start, _ in CE90_M)
    note = (f"that of {sensor}" if known else "the sensor is unknown") + "; --sigma-m states another"
    value = f"{prior_m:.2f} m, one sigma"
    return prior_m, (Statement(name, Subject.ACCURACY, Use.ASSUMED, value, note=note),)


def _identity(acquisition: Acquisition, image: SceneImage, delivered: DeliveredModel) -> Statements:
    """The name, the sensor and the time that the files of an image state."""
    is_named = acquisition.image_id != image.path.stem
    words = [acquisition.image_id if is_named else "", acquisition.sensor]
    if acquisition.acquired_at is not None:
        words.append(f"{acquisition.acquired_at:%Y-%m-%d %H:%M:%S} UTC")
    value = ", ".join(word for word in words if word)
    return (Statement(delivered.path.name, Subject.IDENTITY, Use.USED, value),) if value else ()


def _unused_grid(image: SceneImage, delivered: DeliveredModel) -> Statements:
    """The map grid of an image whose sensor model is used."""
    stated = georeference(image.path, image.dataset)
    is_place = delivered.place is not None or any(
        statement.subject is Subject.PLACE for statement in delivered.statements
    )
    if stated.transform.is_identity or (stated.crs is None and is_place):
        return ()
    crs = "without a reference system" if stated.crs is None else f"in {stated.crs.to_string()[:40]}"
    note = f"{delivered.found.name} is used"
    return (Statement(image.path.name, Subject.PLACE, Use.NOT_USED, f"map grid {crs}", note=note),)


def model_files(path: Path, model_path: Path | None = None) -> list[Path]:
    """The files beside an image that contain its model; none where the image file itself does.

    Raises:
        FormatError: the image has no usable model.
    """
    image = open_image(path)
    try:
        if model_path is None and map_grid_of(image) is not None and not has_rpc(image):
            return []
        delivered = model_of_image(image, model_path, None)
    finally:
        image.close()
    product = delivered.path.with_name(_product_name(delivered.path))
    documents: list[FilePlace] = []
    if isinstance(image, TiledImage):
        documents = [image.path, *(tile.path for tile in image.tiles[1:])]
    elif delivered.place is not None and delivered.place.file:
        documents = [image.path.with_name(delivered.place.file)]
    candidates = dict.fromkeys([delivered.path, product, *documents])
    beside = [file for file in candidates if isinstance(file, Path) and file.is_file()]
    own = image.tiles[0].path if isinstance(image, TiledImage) else image.path
    return [file for file in beside if file.resolve() != Path(str(own)).resolve()]


def prior_sigma_m(model: RpcModel, sensor: str) -> float:
    """Horizontal accuracy of a model before registration, one standard deviation of each coordinate.

    It is the figure of the model (RPC00B: bias and random error, each one standard deviation of each
    horizontal axis), else the CE90 of the sensor as a circular normal law, else 50 m.
    """
    if model.error_bias_m > 0.0:
        random_m = 0.0 if math.isnan(model.error_random_m) else model.error_random_m
        return math.hypot(model.error_bias_m, random_m)
    for start, ce90_m in CE90_M:
        if sensor.startswith(start):
            return ce90_m * CE90_TO_SIGMA
    return UNKNOWN_SIGMA_M


def _with_bands(image: SceneImage, *, is_requested: bool) -> SceneImage:
    """The image with bands that lie on each other, and what is said of them."""
    image, said = with_registered_bands(image, is_requested=is_requested)
    stated = (*image.statements, *([] if said is None else [said]), *_units(image))
    return replace(image, statements=stated)


def _units(image: SceneImage) -> Statements:
    """What is said of the unit of the pixels: only their contrast counts."""
    band = image.mix.bands[0]
    scale, offset = image.dataset.scales[band - 1], image.dataset.offsets[band - 1]
    stated = [image.dataset.units[band - 1] or ""]
    stated += [f"scale {scale:g}, offset {offset:g}"] if (scale, offset) != (1.0, 0.0) else []
    value = ", ".join(part for part in stated if part)
    if not value:
        return ()
    note = "grey values are used as they are stored: only their contrast counts"
    return (Statement(image.path.name, Subject.UNIT, Use.NOT_USED, value, f"band {band}", note),)


def _masked(image: SceneImage, mask: Path | None) -> SceneImage | MaskedImage:
    return image if mask is None else apply_mask(image, mask)


def _with_codes(image: SceneImage, delivered: DeliveredModel) -> SceneImage:
    """The image with the codes that the DIMAP document of its product states, if there is one."""
    product = delivered.path.with_name(_product_name(delivered.path))
    if delivered.convention != "dimap" or not product.is_file():
        return image
    codes = parse_dimap_pixel_codes(read_text(product), product.name)
    image = image.with_codes(codes)
    if codes.nodata is None:
        return image
    is_used = not image.validity.is_stated(image.mix.bands[0])
    said = Statement(
        product.name,
        Subject.VALIDITY,
        Use.USED if is_used else Use.NOT_USED,
        f"no data where the value is {codes.nodata}",
        note="" if is_used else f"{image.path.name} goes before it",
    )
    return replace(image, statements=(*image.statements, said))


def _acquisition(image: SceneImage, delivered: DeliveredModel) -> Acquisition:
    """Sensor, time and sun from the files, with the viewing direction from the model."""
    image_id = scene_name(image.path)
    acquisition = Acquisition(image_id)
    if delivered.convention == "dimap":
        acquisition = _dimap_acquisition(delivered.path, image_id)
    elif delivered.convention == "rpb":
        sensor = rpb_satellite(read_text(delivered.path))
        acquisition = Acquisition(image_id, sensor, _imd_time(delivered.path))
    elif delivered.convention == "isd":
        acquisition = parse_isd_acquisition(read_text(delivered.path), image_id, delivered.path.name)
    elif delivered.convention == "rigorous":
        acquisition = _rigorous_acquisition(delivered.path, image_id)
    elif delivered.convention == "geom":
        acquisition = parse_geom_acquisition(read_text(delivered.path), image_id, delivered.path.name)
    if not acquisition.sensor:
        tags = image.dataset.tags()
        sensor = tags.get("MISSION", "") + tags.get("MISSION_INDEX", "")
        time = parse_imaging_time(tags.get("IMAGING_DATE", ""), tags.get("IMAGING_TIME", ""))
        acquisition = replace(acquisition, sensor=sensor, acquired_at=time)
    if acquisition.acquired_at is None:
        acquisition = replace(acquisition, acquired_at=_nitf_time(image))
    incidence_deg, azimuth_deg = _central_view(delivered.model, image.shape)
    return replace(acquisition, incidence_deg=incidence_deg, azimuth_deg=azimuth_deg)


def _imd_time(model: FilePlace) -> datetime | None:
    """The time of the first line in the `.IMD` beside a `.RPB`; None when there is none."""
    path = model.with_name(f"{model.stem}.IMD")
    match = _FIRST_LINE_TIME.search(read_text(path)) if path.is_file() else None
    return None if match is None else parse_imaging_time(*match.groups())


def _nitf_time(image: SceneImage) -> datetime | None:
    """The time in the image header of a NITF file; unknown digits are hyphens, and then it is None."""
    match = _TIME_OF_DIGITS.fullmatch(image.dataset.tags().get("NITF_IDATIM", ""))
    if match is None:
        return None
    return parse_imaging_time("-".join(match.group(1, 2, 3)), ":".join(match.group(4, 5, 6)))


def _ortho_acquisition(image: SceneImage) -> Acquisition:
    """Sensor and time from the file name of an ortho-image, with a vertical viewing direction."""
    name = image.path.stem
    sensor = ""
    for pattern, form in _SENSOR_IN_NAME:
        match = pattern.search(name)
        if match is not None:
            sensor = form.format(*(part.upper() for part in match.groups()))
            break
    time = None
    digits = _TIME_IN_NAME.search(name)
    if sensor and digits is not None:
        date = "-".join(digits.group(1, 2, 3))
        time = parse_imaging_time(date, ":".join(digits.group(4, 5, 6)))
    return Acquisition(name, sensor, time, incidence_deg=0.0, azimuth_deg=0.0)


def _with_sun(acquisition: Acquisition, grid: MapGrid, shape: tuple[int, int]) -> Acquisition:
    """The sun of a granule of Sentinel-2, whose name has the time when it was seen.

    Names of other products have the time of their production.
    """
    time = acquisition.acquired_at
    if time is None or not _GRANULE.search(acquisition.image_id):
        return acquisition
    middle = grid.lon_lat(np.array(shape)[None] / 2.0)[0]
    elevation_deg, azimuth_deg = sun_direction(middle, time)
    return replace(acquisition, sun_elevation_deg=elevation_deg, sun_azimuth_deg=azimuth_deg)


def product_sigma_m(sensor: str) -> float | None:
    """Horizontal accuracy of a delivered ortho-image, one standard deviation; None when unknown."""
    for start, ce90_m in ORTHO_CE90_M:
        if sensor.startswith(start):
            return ce90_m * CE90_TO_SIGMA
    return None


def _ortho_sigma_m(path: FilePlace, sensor: str) -> float:
    sigma_m = product_sigma_m(sensor)
    if sigma_m is not None:
        return sigma_m
    raise FormatError(
        f"{path}: the sensor of this ortho-image is unknown: give the horizontal accuracy of its map "
        "grid as `sigma_m`, one standard deviation in metres"
    )


def _product_name(path: FilePlace) -> str:
    """File name of the DIMAP document of the product, from that of its RPC."""
    return re.sub("^RPC_", "DIM_", path.name, flags=re.IGNORECASE)


def _dimap_acquisition(path: FilePlace, image_id: str) -> Acquisition:
    """The acquisition in the DIMAP document of the product, where it exists, else in that of the RPC."""
    product = path.with_name(_product_name(path))
    of_rpc = parse_dimap_acquisition(read_text(path), image_id, path.name)
    if not product.is_file():
        return of_rpc
    stated = parse_dimap_acquisition(read_text(product), image_id, product.name)
    return stated if stated.sensor else replace(stated, sensor=of_rpc.sensor)


def _rigorous_acquisition(path: FilePlace, image_id: str) -> Acquisition:
    """The acquisition in a document with a rigorous model; that of CNES names no satellite."""
    text = read_text(path)
    root = parse_xml(text, path.name)
    if root.tag == "isd":
        return parse_isd_acquisition(text, image_id, path.name)
    if root.tag == "Dimap_Document":
        return parse_dimap_acquisition(text, image_id, path.name)
    return Acquisition(image_id, "PHR")


def _central_view(model: RpcModel, shape: tuple[int, int]) -> tuple[float, float]:
    """Incidence and azimuth of the view at the image centre, degrees."""
    centre: Array = (np.array([shape], dtype=np.float64) - 1.0) / 2.0
    ground = model.locate(centre, np.array([sum(model.height_range_m) / 2.0]))
    incidence_deg, azimuth_deg = view_direction(model, centre, ground)
    return float(incidence_deg[0]), float(azimuth_deg[0])
