"""PHRDIMAP: the rigorous model of the primary Pléiades products of CNES (`PHR_Dimap_Document`)."""

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
from amers.services.sensors.piecewise import extended, lagrange, polynomial
from amers.services.sensors.pushbroom import (
    MAX_SIZE,
    TERRAIN_M,
    PushbroomModel,
    check_pushbroom,
    used_times,
)
from amers.services.types import Array

_ROOT = "PHR_Dimap_Document"


def parse_phr_dimap(text: str, source: str = "PHRDIMAP") -> PushbroomModel:
    """The rigorous model of a PHRDIMAP document.

    The document has the model of an ideal sensor: quaternions as polynomials of time, one straight row
    of detectors, an ephemeris in the Earth-fixed frame. The centre of the first line has the time START.
    Aberration and light time are within the polynomials: the location grids of CNES agree to 1 mm
    without them.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: it is not such a document, or a value is missing or impossible.
    """
    root = parse_xml(text, source)
    if root.tag != _ROOT:
        raise FormatError(f"{source}: expected <{_ROOT}>, found <{root.tag[:60]}>")
    sensor = single(root, "Sensor_Model_Characteristics", source)
    start = single(sensor, "UTC_Sensor_Model_Range/START", source)
    midnight = midnight_before(start, source)
    shape = (
        whole_number(root, "Raster_Dimensions/NROWS", source, (1, MAX_SIZE)),
        whole_number(root, "Raster_Dimensions/NCOLS", source, (1, MAX_SIZE)),
    )
    period_s = 1e-3 * number(sensor, "SENSOR_LINE_PERIOD", source, (1e-3, 100.0))
    points = sensor.findall("Sensor_Ephemeris/Point_List/Point")
    times = np.array([seconds(single(point, "UTC_TIME", source), midnight, source) for point in points])
    check_increasing(times, "Sensor_Ephemeris", 8, source)
    position = np.array(
        [numbers(single(point, "LOCATION_VALUES", source), source, 3) for point in points]
    )

    def coefficients(*names: str) -> Array:
        """Coefficients (values, degree + 1), constant first, of polynomials of several degrees."""
        rows = [numbers(single(sensor, f"{name}/COEFFICIENTS", source), source) for name in names]
        out = np.zeros((len(rows), max(len(row) for row in rows)))
        for i, row in enumerate(rows):
            out[i, : len(row)] = row
        return out

    line_time = polynomial(0.0, 1.0, np.array([[seconds(start, midnight, source), period_s]]))
    model = PushbroomModel(
        image_shape=shape,
        line_time=line_time,
        orbit=extended(lagrange(times, position), used_times(line_time, shape[0]), 2),
        attitude=polynomial(
            number(sensor, "Sensor_Attitudes/OFFSET", source),
            number(sensor, "Sensor_Attitudes/SCALE", source, (1e-3, 1e5)),
            coefficients("Q1", "Q2", "Q3", "Q0"),
        ),
        look=polynomial(0.0, 1.0, coefficients("PsiY_Model", "PsiX_Model") * np.array([[1.0], [-1.0]])),
        height_range_m=TERRAIN_M,
    )
    return check_pushbroom(model, source)
