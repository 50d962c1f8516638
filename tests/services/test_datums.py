"""Datums of maps: which operation leads to WGS 84, how accurate it is, and when there is none."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import Transformer

from amers.services import datums
from amers.services.datums import datum_shift, filled_sigmas, from_wgs84, to_wgs84
from amers.services.errors import FormatError
from amers.services.map_grid import lon_lat_of_xy

GAUSS_KRUEGER = "+proj=tmerc +lon_0=12 +x_0=4500000 +ellps=bessel +type=crs"


@pytest.mark.parametrize(
    ("crs", "xy", "name", "sigma_m"),
    [
        ("EPSG:32631", (5e5, 4.9e6), "", 0.0),
        ("EPSG:4326+5773", (5.0, 44.0), "", 0.0),
        ("EPSG:25832", (5e5, 5e6), "ETRS89 to WGS 84 (1), accuracy 1 m", 0.0),
        ("EPSG:26713", (482e3, 4.34e6), "NAD27 to WGS 84 (6), accuracy 7 m", 7.0),
        ("EPSG:31468", (4.54e6, 5.85e6), "DHDN to WGS 84 (3), accuracy 2 m", 2.0),
        ("EPSG:4230", (5.4, 43.3), "ED50 to WGS 84 (17), accuracy 2 m", 2.0),
        ("EPSG:4267", (-100.0, 60.0), "NAD27 to WGS 84 (13), accuracy 8 m", 8.0),
        ("EPSG:27572", (6e5, 2.2e6), "NTF to WGS 84 (1), accuracy 2 m", 2.0),
    ],
)
def test_the_operation_of_a_place_is_named_and_enters_the_sigma_unless_it_is_null(
    crs: str, xy: tuple[float, float], name: str, sigma_m: float
) -> None:
    shift = datum_shift(crs, np.array(xy), "a file")
    assert name in str(shift.statement("a.tif"))
    assert shift.sigma_m == sigma_m


@pytest.mark.parametrize(
    "ellipsoid", ["+ellps=bessel", "+ellps=intl", "+ellps=krass", "+a=6378137 +rf=290"]
)
def test_a_system_without_a_datum_is_refused_in_a_sentence(ellipsoid: str) -> None:
    with pytest.raises(FormatError, match=r"a\.tif: reference system: unknown on .*\+towgs84"):
        datum_shift(f"+proj=utm +zone=31 {ellipsoid} +type=crs", np.array([5e5, 5e6]), "a.tif")


@pytest.mark.parametrize("ellipsoid", ["+ellps=GRS80", "+ellps=WGS84", "+a=6378137 +b=6356752.314245"])
def test_a_system_without_a_datum_on_the_ellipsoid_of_wgs84_is_assumed_to_be_like_it(
    ellipsoid: str,
) -> None:
    crs = f"+proj=utm +zone=31 {ellipsoid} +type=crs"
    shift = datum_shift(crs, np.array([5e5, 5e6]), "a.tif")
    assert "assumed" in str(shift.statement("a.tif"))
    a_millimetre_deg = 1e-8
    wanted = lon_lat_of_xy("EPSG:32631", np.array([[5e5, 5e6]]))
    np.testing.assert_allclose(lon_lat_of_xy(crs, np.array([[5e5, 5e6]])), wanted, atol=a_millimetre_deg)


def test_a_definition_with_its_own_shift_is_used_and_its_accuracy_is_unknown() -> None:
    shift = datum_shift(
        GAUSS_KRUEGER.replace(" +type", " +towgs84=598,73,418,0,0,0,0 +type"),
        np.array([4536584.8, 5851385.5]),
        "a.tif",
    )
    assert math.isnan(shift.accuracy_m)
    assert "unknown accuracy" in str(shift.statement("a.tif"))


def test_positions_in_wgs84_are_bitwise_those_of_proj() -> None:
    xy = np.random.default_rng(1).uniform([4e5, 4e6], [6e5, 6e6], (100, 2))
    plain = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True)
    expected = plain.transform(xy[:, 0], xy[:, 1])
    np.testing.assert_array_equal(to_wgs84("EPSG:32631").transform(xy[:, 0], xy[:, 1]), expected)
    back = Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform(*expected)
    np.testing.assert_array_equal(from_wgs84("EPSG:32631").transform(*expected), back)


def test_sigmas_that_a_user_states_fill_those_that_are_unknown_with_the_datum_in_the_plane() -> None:
    unknown = np.nan
    sigma_m = np.array([[unknown] * 3, [1.0, 2.0, 3.0], [unknown, 2.0, unknown]])
    filled = filled_sigmas(sigma_m, (3.0, 0.5), 4.0)
    np.testing.assert_allclose(filled, [[5.0, 5.0, 0.5], [1.0, 2.0, 3.0], [5.0, 2.0, 0.5]])


def test_a_grid_that_is_not_installed_is_advised_where_it_is_known_to_be_more_accurate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of NAD27 in the west, whose operation has an accuracy of 7 m."""

    def lacking(*operations: tuple[float, str, str]) -> str:
        unavailable = [
            SimpleNamespace(accuracy=accuracy, grids=[SimpleNamespace(short_name=name, url=url)])
            for accuracy, name, url in operations
        ]
        group = SimpleNamespace(unavailable_operations=unavailable)
        monkeypatch.setattr(datums, "transformations", lambda *_: group)
        return datum_shift("EPSG:26713", np.array([482e3, 4.34e6]), str(operations)).missing

    url = "https://cdn.proj.org"
    unknown, as_good, unpublished = (-1.0, "a.tif", url), (7.0, "b.tif", url), (0.1, "c.tif", "")
    assert lacking(unknown, as_good, unpublished) == ""
    sentence = lacking(unknown, (2.0, "d.tif", url), (0.15, "e.tif", url), as_good, unpublished)
    assert sentence == "; 0.15 m with its grid: pyproj sync --file e.tif"


@pytest.mark.parametrize(("metres", "is_null"), [(0.005, True), (0.05, False), (5.0, False)])
def test_an_operation_that_moves_positions_by_more_than_a_centimetre_is_not_null(
    metres: float, is_null: bool
) -> None:
    crs = f"+proj=utm +zone=31 +ellps=GRS80 +towgs84=0,{metres},0,0,0,0,0 +units=m +type=crs"
    assert datum_shift(crs, np.array([5e5, 5e6]), "a.tif").is_null is is_null
