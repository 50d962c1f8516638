"""Scenes: an image file, the sensor model that belongs to it, and what is known of the acquisition."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from services.errors import FormatError
from services.formats.images.bands import BandMix
from services.formats.images.masks import masked
from services.formats.images.raster import RasterImage, map_grid_of, open_raster
from services.formats.sensor_models.dimap import parse_dimap_acquisition, parse_imaging_time
from services.formats.sensor_models.rpc_files import DeliveredModel, has_rpc, model_of_image, read_text
from services.formats.sensor_models.rpc_text import rpb_satellite
from services.imagery.scene import Scene, view_direction
from services.imagery.source import ImageSource
from services.sensors.ortho import OrthoModel
from services.sensors.rpc import RpcModel
from services.types import Acquisition, Array

CE90_TO_SIGMA = 1.0 / math.sqrt(2.0 * math.log(10.0))
"""From CE90 to one standard deviation a coordinate, for a circular normal law: 1 / 2.1460."""

CE90_M = (
    ("PHR", 8.5),
    ("PNEO", 5.0),
    ("SPOT6", 10.0),
    ("SPOT7", 10.0),
    ("WV", 5.0),
    ("GE01", 5.0),
    ("QB02", 21.0),
)
"""Horizontal accuracy without control, by the start of the sensor's name.

Sources: Pléiades and Pléiades Neo, imagery user guides of Airbus Defence and Space (incidence to 30
degrees); SPOT 6/7, their technical sheet; WorldView and GeoEye, "better than 5 m CE90" of their
operator; QuickBird, Smiley (2009), the worst quarter of two years.
"""

ORTHO_CE90_M = (("S2", 17.5), ("LC0", 18.2), ("LO0", 18.2))
"""Horizontal accuracy of ortho-images without control of ours, by the start of the sensor's name.

Sentinel-2: 20 m at two standard deviations without control points (ESA, GMES-GSEG-EOPG-TN-09-0008, table
4-6), taken as 95 % of a circular normal law, hence 17.5 m CE90. Products refined on the mission's
reference images, since 2021, reach 8 m at 95 %, but their pixels do not say that they are. Landsat 8 and
9: a scene is of Tier 1 when its radial root mean square error is 12 m at most (USGS, Landsat
Collections), hence 18.2 m CE90 of a circular normal law; no figure is stated for those of Tier 2.
"""

_SENSOR_IN_NAME = (
    (re.compile(r"(?:^|_)(S2[A-D])_", re.IGNORECASE), "{0}"),
    (re.compile(r"^T\d{2}[A-Z]{3}_\d{8}T\d{6}_", re.IGNORECASE), "S2"),
    (re.compile(r"(?:^|_)(L[CO]0[89])_L1TP_(?:\d+_){4}T1(?:_|$)", re.IGNORECASE), "{0}"),
)
"""How producers of ortho-images name the sensor in the name of a file."""

_TIME_IN_NAME = re.compile(r"_(\d{4})(\d{2})(\d{2})T(\d{2})(\d{2})(\d{2})")

UNKNOWN_SIGMA_M = 50.0
"""Accuracy of a model whose producer and sensor say nothing."""


def read_scene(
    path: Path,
    model_path: Path | None = None,
    sigma_m: float | None = None,
    bands: BandMix | None = None,
    crop_origin: tuple[float, float] | None = None,
    mask: Path | None = None,
) -> Scene:
    """An image with its model; the image stays open and is read by windows.

    An image without an RPC that lies on a map is an ortho-image.

    Args:
        path: GeoTIFF, JPEG 2000 or NITF.
        model_path, crop_origin: as of `read_rpc`.
        sigma_m: horizontal accuracy of the model, one standard deviation a coordinate; by default what
            the producer states, else what is known of the sensor, else 50 m; that of an ortho-image of
            an unknown sensor has to be given.
        bands: what is looked at; by default the panchromatic band or the mean of the visible ones.
        mask: image of the same ground, coarser or not, that is not zero where pixels shall not be used.

    Raises:
        FormatError: when the image, its model or its mask cannot be used.
    """
    image = open_raster(path, bands)
    try:
        seen: ImageSource = image if mask is None else masked(image, mask)
        grid = map_grid_of(image)
        if grid is not None and model_path is None and crop_origin is None and not has_rpc(image):
            acquisition = _ortho_acquisition(image)
            if sigma_m is None:
                sigma_m = _ortho_sigma_m(path, acquisition.sensor)
            return Scene(seen, OrthoModel(grid), acquisition, sigma_m)
        delivered = model_of_image(image, model_path, crop_origin)
        acquisition = _acquisition(image, delivered)
    except FormatError:
        image.close()
        raise
    if sigma_m is None:
        sigma_m = prior_sigma_m(delivered.model, acquisition.sensor)
    return Scene(seen, delivered.model, acquisition, sigma_m)


def model_files(path: Path, model_path: Path | None = None) -> list[Path]:
    """The files beside an image that hold its model; none where the image holds it itself.

    Raises:
        FormatError: when the image has no usable model.
    """
    image = open_raster(path)
    try:
        if model_path is None and map_grid_of(image) is not None and not has_rpc(image):
            return []
        delivered = model_of_image(image, model_path, None)
    finally:
        image.close()
    product = delivered.path.with_name(_product_name(delivered.path))
    found = dict.fromkeys([delivered.path, product])
    return [file for file in found if file.is_file() and file.resolve() != path.resolve()]


def prior_sigma_m(model: RpcModel, sensor: str) -> float:
    """Horizontal accuracy of a model before registration, one standard deviation a coordinate.

    What the model states (RPC00B: bias and random error, each a standard deviation a horizontal axis),
    else the CE90 of the sensor as a circular normal law, else 50 m.
    """
    if model.error_bias_m > 0.0:
        random_m = 0.0 if math.isnan(model.error_random_m) else model.error_random_m
        return math.hypot(model.error_bias_m, random_m)
    for start, ce90_m in CE90_M:
        if sensor.startswith(start):
            return ce90_m * CE90_TO_SIGMA
    return UNKNOWN_SIGMA_M


def _acquisition(image: RasterImage, delivered: DeliveredModel) -> Acquisition:
    """What the files say of the acquisition, with the direction of view of the model."""
    image_id = image.path.stem
    told = Acquisition(image_id)
    if delivered.convention == "dimap":
        told = _dimap_acquisition(delivered.path, image_id)
    elif delivered.convention == "rpb":
        told = Acquisition(image_id, sensor=rpb_satellite(read_text(delivered.path)))
    if not told.sensor:
        tags = image.dataset.tags()
        sensor = tags.get("MISSION", "") + tags.get("MISSION_INDEX", "")
        time = parse_imaging_time(tags.get("IMAGING_DATE", ""), tags.get("IMAGING_TIME", ""))
        told = replace(told, sensor=sensor, acquired_at=time)
    incidence_deg, azimuth_deg = _central_view(delivered.model, image.shape)
    return replace(told, incidence_deg=incidence_deg, azimuth_deg=azimuth_deg)


def _ortho_acquisition(image: RasterImage) -> Acquisition:
    """What the name of an ortho-image says; its ground is seen from straight above."""
    name = image.path.stem
    sensor = ""
    for pattern, form in _SENSOR_IN_NAME:
        match = pattern.search(name)
        if match is not None:
            sensor = form.format(*(part.upper() for part in match.groups()))
            break
    time = None
    told = _TIME_IN_NAME.search(name)
    if sensor and told is not None:
        date = "-".join(told.group(1, 2, 3))
        time = parse_imaging_time(date, ":".join(told.group(4, 5, 6)))
    return Acquisition(name, sensor, time, incidence_deg=0.0, azimuth_deg=0.0)


def _ortho_sigma_m(path: Path, sensor: str) -> float:
    for start, ce90_m in ORTHO_CE90_M:
        if sensor.startswith(start):
            return ce90_m * CE90_TO_SIGMA
    raise FormatError(
        f"{path}: an ortho-image of an unknown sensor: say how accurate its place on the map is, "
        "sigma_m in metres"
    )


def _product_name(path: Path) -> str:
    return re.sub("^RPC_", "DIM_", path.name, flags=re.IGNORECASE)


def _dimap_acquisition(path: Path, image_id: str) -> Acquisition:
    """From the product's document when it lies beside the RPC's, else from the RPC's."""
    product = path.with_name(_product_name(path))
    source = product if product.is_file() else path
    return parse_dimap_acquisition(read_text(source), image_id, source.name)


def _central_view(model: RpcModel, shape: tuple[int, int]) -> tuple[float, float]:
    centre: Array = (np.array([shape], dtype=np.float64) - 1.0) / 2.0
    ground = model.locate(centre, np.array([sum(model.height_range_m) / 2.0]))
    incidence_deg, azimuth_deg = view_direction(model, centre, ground)
    return float(incidence_deg[0]), float(azimuth_deg[0])
