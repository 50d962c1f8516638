"""Metadata of products written from a simulated satellite, whose true model the readers must find."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from services.sensors.light_path import GEOMETRIC, LightPath
from services.sensors.pushbroom import PushbroomModel
from services.simulation.orbit import pushbroom_over

SHAPE = (4000, 3000)
_MIDDLE = datetime(2021, 6, 3, 10, 20, 30, 250000)


def truth(light_path: LightPath = GEOMETRIC, incidence_deg: float = 18.0) -> PushbroomModel:
    """The model of a satellite over the Alps; its time zero is the middle of the image."""
    target = np.array([7.0, 45.9, 1500.0])
    model = pushbroom_over(target, SHAPE, 0.7, (incidence_deg, 100.0), (0.0, 4000.0))
    return replace(model, light_path=light_path)


def utc(time_s: float) -> str:
    """A time of the model as text, to a tenth of a microsecond."""
    ticks = round(time_s * 1e7)
    whole = _MIDDLE + timedelta(microseconds=ticks // 10)
    return whole.strftime("%Y-%m-%dT%H:%M:%S.%f") + str(ticks % 10) + "Z"


def row(values: np.ndarray) -> str:
    """Numbers with all their digits, separated by blanks."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def line_time_s(model: PushbroomModel, line: float) -> float:
    """The time of a line of the model, seconds after the middle of the image."""
    return float(model.line_time(np.array([line]))[0, 0])


def worldview_isd(model: PushbroomModel) -> str:
    """An ISD document with orbit and attitude at 50 Hz."""
    focal_mm = 13246.0
    step_s, count = 0.02, 101
    first_s = -step_s * (count // 2)
    times = first_s + step_s * np.arange(count)
    position, velocity = model.orbit(times), model.orbit.derivative(times)
    quaternions = model.attitude(times)
    quaternions[::3] *= -1.0
    ephemeris = "".join(
        f"<EPHEMLIST>{row([i + 1])} {row(p)} {row(v)} 0 0 0 0 0 0</EPHEMLIST>\n"
        for i, (p, v) in enumerate(zip(position, velocity, strict=True))
    )
    attitude = "".join(
        f"<ATTLIST>{row([i + 1])} {row(q)} 0 0 0</ATTLIST>\n" for i, q in enumerate(quaternions)
    )
    origin_mm = model.look(np.zeros(1))[0] * focal_mm
    pitch_mm = -model.look.derivative(np.zeros(1))[0, 1] * focal_mm
    start_s = line_time_s(model, 0.0)
    last_s = line_time_s(model, SHAPE[0] / 2.0) - start_s
    table = f"<STARTTIME>{utc(first_s)}</STARTTIME><NUMPOINTS>{count}</NUMPOINTS>"
    table += f"<TIMEINTERVAL>{step_s}</TIMEINTERVAL>"
    return f"""<?xml version="1.0" encoding="utf-8"?>
<isd><IMD><NUMROWS>{SHAPE[0]}</NUMROWS><NUMCOLUMNS>{SHAPE[1]}</NUMCOLUMNS><IMAGE>
<SATID>WV02</SATID><TLCTIME>{utc(start_s)}</TLCTIME><TLCLISTList>
<TLCLIST>0.0 0.0</TLCLIST><TLCLIST>{SHAPE[0] / 2.0!r} {last_s!r}</TLCLIST></TLCLISTList></IMAGE></IMD>
<EPH>{table}<EPHEMLISTList>{ephemeris}</EPHEMLISTList></EPH>
<ATT>{table}<ATTLISTList>{attitude}</ATTLISTList></ATT>
<GEO><PRINCIPAL_DISTANCE><PD>{focal_mm}</PD></PRINCIPAL_DISTANCE>
<OPTICAL_DISTORTION><POLYORDER>-1</POLYORDER></OPTICAL_DISTORTION>
<PERSPECTIVE_CENTER><CX>0</CX><CY>0</CY><CZ>0</CZ></PERSPECTIVE_CENTER>
<CAMERA_ATTITUDE><QCS1>0</QCS1><QCS2>0</QCS2><QCS3>0</QCS3><QCS4>1</QCS4></CAMERA_ATTITUDE>
<DETECTOR_MOUNTING><BAND_P><DETECTOR_ARRAY><DETORIGINX>{row(origin_mm[0])}</DETORIGINX>
<DETORIGINY>{row(origin_mm[1])}</DETORIGINY><DETROTANGLE>0</DETROTANGLE>
<DETPITCH>{row(pitch_mm)}</DETPITCH></DETECTOR_ARRAY></BAND_P></DETECTOR_MOUNTING></GEO></isd>
"""


def phr_dimap(model: PushbroomModel) -> str:
    """A PHRDIMAP document with quaternions as polynomials of degree six."""
    start_s, end_s = line_time_s(model, 0.0), line_time_s(model, SHAPE[0] - 1.0)
    midnight_s = (_MIDDLE - _MIDDLE.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()
    half_s = 2.0 * (end_s - start_s)
    times = half_s * np.cos(np.pi * (np.arange(40) + 0.5) / 40.0) / 2.0
    fitted = np.polynomial.polynomial.polyfit(times / half_s, model.attitude(times), 6)
    x, y, z, w = fitted.T
    points = "".join(
        f"<Point><LOCATION_VALUES unit='m'>{row(model.orbit(np.array([t])))}</LOCATION_VALUES>"
        f"<UTC_TIME>{utc(t)}</UTC_TIME></Point>\n"
        for t in np.round(np.linspace(-0.6, 0.6, 10), 7)
    )
    polynomials = "".join(
        f"<Q{k}><DEGREE>6</DEGREE><COEFFICIENTS>{row(q)}</COEFFICIENTS></Q{k}>"
        for k, q in enumerate((w, x, y, z))
    )
    across = [model.look(np.zeros(1))[0, 1], model.look.derivative(np.zeros(1))[0, 1]]
    return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<PHR_Dimap_Document><Raster_Dimensions><NROWS>{SHAPE[0]}</NROWS><NCOLS>{SHAPE[1]}</NCOLS></Raster_Dimensions>
<Geometric_Data><Sensor_Model_Characteristics>
<UTC_Sensor_Model_Range><START>{utc(start_s)}</START><END>{utc(end_s)}</END></UTC_Sensor_Model_Range>
<Sensor_Ephemeris><Point_List>{points}</Point_List></Sensor_Ephemeris>
<Sensor_Attitudes><Polynomial_Models>{polynomials}</Polynomial_Models>
<OFFSET>{midnight_s!r}</OFFSET><SCALE>{half_s!r}</SCALE></Sensor_Attitudes>
<SENSOR_LINE_PERIOD>{1e3 * (end_s - start_s) / (SHAPE[0] - 1.0)!r}</SENSOR_LINE_PERIOD>
<Sensor_Viewing_Model><Viewing_Directions>
<PsiX_Model><DEGREE>1</DEGREE><COEFFICIENTS>{row(-np.array(across))}</COEFFICIENTS></PsiX_Model>
<PsiY_Model><DEGREE>0</DEGREE><COEFFICIENTS>0.0</COEFFICIENTS></PsiY_Model>
</Viewing_Directions></Sensor_Viewing_Model></Sensor_Model_Characteristics></Geometric_Data>
</PHR_Dimap_Document>
"""
