"""DIMAP version 2: the rigorous model of SPOT 6/7 and Pléiades products that have `Refined_Model`."""

from xml.etree import ElementTree

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.sensor_models.xml_values import (
    check_increasing,
    midnight_before,
    number,
    numbers,
    seconds,
    single,
    whole_number,
)
from amers.services.formats.text_files import parse_xml
from amers.services.sensors.attitude import interpolated_attitude
from amers.services.sensors.piecewise import (
    LAGRANGE_NODES,
    PiecewisePolynomial,
    extended,
    hermite,
    lagrange,
    polynomial,
)
from amers.services.sensors.pushbroom import (
    MAX_SIZE,
    TERRAIN_M,
    PushbroomModel,
    check_pushbroom,
    used_times,
)
from amers.services.types import Array

_PERIOD_UNITS_S = {"microsecond": 1e-6, "ms": 1e-3, "millisecond": 1e-3, "s": 1.0, "second": 1.0}
_MAX_DEGREE = 9


def parse_dimap_rigorous(text: str, source: str = "DIMAP") -> PushbroomModel:
    """The rigorous model of a DIMAP document of version 2, for its first band.

    The first line has the time START. Orbit and attitude are in the Earth-fixed frame. The frame corners
    of SPOT 6 in the document are reproduced without aberration, light time and refraction.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: it is not such a document, or a value is missing, impossible or not supported.
    """
    root = parse_xml(text, source)
    declared = root.find("Metadata_Identification/METADATA_FORMAT")
    version = "" if declared is None else declared.get("version", "")
    if root.tag != "Dimap_Document" or not version.startswith("2."):
        raise FormatError(
            f"{source}: expected a DIMAP document of version 2, found <{root.tag[:60]}> of version "
            f"{version[:20] or 'unknown'}"
        )
    refined = single(root, "Geometric_Data/Refined_Model", source)
    shape = (
        whole_number(root, "Raster_Dimensions/NROWS", source, (1, MAX_SIZE)),
        whole_number(root, "Raster_Dimensions/NCOLS", source, (1, MAX_SIZE)),
    )
    start = single(refined, "Time/Time_Range/START", source)
    midnight = midnight_before(start, source)
    start_s = seconds(start, midnight, source)
    line_time = polynomial(0.0, 1.0, np.array([[start_s, _line_period_s(refined, source)]]))
    used = used_times(line_time, shape[0])

    def times(entries: list[ElementTree.Element], name: str, needed: int) -> Array:
        """Times (n,) of entries, seconds after midnight."""
        found = [seconds(single(entry, "TIME", source), midnight, source) for entry in entries]
        return check_increasing(np.array(found), name, needed, source)

    points = refined.findall("Ephemeris/Point_List/Point")
    orbit = _orbit(points, times(points, "Ephemeris", 2), source)
    entries = refined.findall("Attitudes/Quaternion_List/Quaternion")
    attitude_s = times(entries, "Quaternion_List", LAGRANGE_NODES)
    quaternions = _quaternions(entries, source)
    for name in ("YAW", "PITCH", "ROLL"):
        number(refined, f"Instrument_Biases/{name}", source, (0.0, 0.0))
    model = PushbroomModel(
        image_shape=shape,
        line_time=line_time,
        orbit=extended(orbit, used, 2),
        attitude=extended(interpolated_attitude(attitude_s, quaternions), used, 1),
        look=polynomial(0.0, 1.0, _look(refined, source)),
        height_range_m=TERRAIN_M,
    )
    return check_pushbroom(model, source)


def _line_period_s(refined: ElementTree.Element, source: str) -> float:
    name = "Time/Time_Stamp/LINE_PERIOD"
    unit = single(refined, name, source).get("unit", "").strip()
    if unit not in _PERIOD_UNITS_S:
        raise FormatError(
            f"{source}: LINE_PERIOD: unit {unit[:20]!r} found, one of "
            f"{', '.join(_PERIOD_UNITS_S)} expected"
        )
    return _PERIOD_UNITS_S[unit] * number(refined, name, source, (1e-9, 1e6))


def _orbit(points: list[ElementTree.Element], orbit_s: Array, source: str) -> PiecewisePolynomial:
    """Positions by times (n,): by polynomials where there are enough points."""
    position, velocity = (
        np.array([numbers(single(point, name, source), source, 3) for point in points])
        for name in ("LOCATION_XYZ", "VELOCITY_XYZ")
    )
    if len(points) < LAGRANGE_NODES:
        return hermite(orbit_s, position, velocity)
    return lagrange(orbit_s, position)


def _quaternions(entries: list[ElementTree.Element], source: str) -> Array:
    """(n, 4), the scalar last."""
    quaternions = np.array(
        [[number(entry, f"Q{k}", source, (-1.1, 1.1)) for k in (1, 2, 3, 0)] for entry in entries]
    )
    if not (np.linalg.norm(quaternions, axis=1) > 0.5).all():
        raise FormatError(f"{source}: Quaternion_List: a quaternion is not of unit length")
    return quaternions


def _look(refined: ElementTree.Element, source: str) -> Array:
    """Tangents along and across (2, degree + 1), constant first, of the samples of the first band."""
    bands = refined.findall("Geometric_Calibration/Instrument_Calibration//Band_Calibration")
    if not bands:
        raise FormatError(f"{source}: no Band_Calibration found, that of a band expected")
    number(bands[0], "Swath_Range/FIRST_COL", source, (1.0, 1.0))
    angles = single(bands[0], "Polynomial_Look_Angles", source)
    found = np.zeros((2, _MAX_DEGREE + 1))
    for i, name in enumerate(("YLOS", "XLOS")):
        degrees = [k for k in range(_MAX_DEGREE + 1) if angles.find(f"{name}_{k}") is not None]
        if not degrees:
            raise FormatError(f"{source}: {name}_0 is missing in Polynomial_Look_Angles")
        for k in degrees:
            found[i, k] = number(angles, f"{name}_{k}", source)
    used = max(1, int(np.flatnonzero(found.any(axis=0)).max(initial=0)))
    return found[:, : used + 1] * np.array([[1.0], [-1.0]])
