"""Grids of geoids are found where PROJ keeps them, and the message says how to get a missing one."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pyproj import datadir

from amers.services.errors import MissingGeoid, VerticalDatumError
from amers.services.formats.elevation import geoid
from amers.services.formats.elevation.geoid import (
    find_grid,
    geoid_model,
    geoid_of_crs,
    geoid_of_grid,
    vertical_crs,
)
from tests.services.formats.elevation.test_dem import undulation, write_geoid

PLACE = np.array([5.0, 44.0])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder in which grids are looked for; it is not that of the process."""
    place = tmp_path / "proj"
    place.mkdir()
    monkeypatch.setattr(geoid, "grid_folders", lambda: [tmp_path / "nowhere", place])
    return place


def test_a_name_alone_is_found_among_the_grids_of_proj(folder: Path) -> None:
    write_geoid(folder / "local.gtx")
    assert find_grid(Path("local.gtx")) == folder / "local.gtx"
    lon_lat = PLACE[None, :]
    assert geoid_of_grid(Path("local.gtx"))(lon_lat) == pytest.approx(undulation(lon_lat))
    with pytest.raises(VerticalDatumError, match=r"elsewhere/local\.gtx: expected the grid file"):
        find_grid(Path("elsewhere/local.gtx"))


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("egm96_15.gtx", "pyproj sync --file us_nga_egm96_15.tif, or install the package proj-data"),
        ("us_nga_egm08_25.tif", "pyproj sync --file us_nga_egm08_25.tif"),
        ("my.gtx", "correct --geoid"),
    ],
)
def test_the_message_of_a_missing_grid_says_how_to_get_it(folder: Path, name: str, how: str) -> None:
    with pytest.raises(VerticalDatumError) as refused:
        find_grid(Path(name))
    assert how in str(refused.value)
    assert str(folder) in str(refused.value)


def test_a_datum_uses_the_grid_of_a_folder_that_pyproj_does_not_look_in(folder: Path) -> None:
    vertical = vertical_crs("EGM96")
    assert vertical is not None
    try:
        geoid_of_crs(vertical, PLACE)
    except MissingGeoid as missing:
        assert "us_nga_egm96_15.tif" in str(missing)  # noqa: PT017
    else:
        pytest.skip("pyproj has the grid of EGM96 here")
    write_geoid(folder / "egm96_15.gtx")
    assert geoid_of_crs(vertical, PLACE)(PLACE[None, :]) == pytest.approx(undulation(PLACE[None, :]))


def test_a_geoid_that_proj_has_is_used_by_other_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_geoid(tmp_path / "egm08_25.gtx")
    before = datadir.get_data_dir()
    monkeypatch.setattr(geoid, "grid_folders", list)
    datadir.append_data_dir(str(tmp_path))
    try:
        vertical = vertical_crs("EGM2008")
        assert vertical is not None
        again = pickle.loads(pickle.dumps(geoid_of_crs(vertical, PLACE)))
        assert again(PLACE[None, :]) == pytest.approx(undulation(PLACE[None, :]))
    finally:
        datadir.set_data_dir(before)


def test_the_variable_of_proj_names_a_folder(tmp_path: Path) -> None:
    code = "from amers.services.formats.elevation.geoid import grid_folders as f; print(*f(), sep='\\n')"
    environment = {"PROJ_DATA": str(tmp_path)}
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert str(tmp_path) in said.stdout.splitlines()
    assert "/usr/share/proj" in said.stdout.splitlines()


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("egm96_15.gtx", "EGM96"),
        ("us_nga_egm96_15.tif", "EGM96"),
        ("egm08_25.gtx", "EGM2008"),
        ("EGM2008-1.gtx", "EGM2008"),
        ("egm84_30.gtx", "EGM84"),
        ("es_ign_egm08-rednap.gtx", None),
        ("geoid.gtx", None),
    ],
)
def test_a_grid_is_of_a_model_by_its_published_name(
    tmp_path: Path, name: str, model: str | None
) -> None:
    assert geoid_model(write_geoid(tmp_path / name)) == model


@pytest.mark.parametrize(
    ("north_m", "south_m", "model"),
    [(13.606, -29.535, "EGM96"), (14.899, -30.150, "EGM2008"), (13.0, -29.0, None)],
)
def test_a_renamed_grid_is_known_by_the_heights_of_the_poles(
    tmp_path: Path, north_m: float, south_m: float, model: str | None
) -> None:
    values = np.zeros((181, 361), ">f4")
    values[0], values[-1] = south_m, north_m
    header = np.array([-90.0, -180.0, 1.0, 1.0], ">f8").tobytes() + np.array([181, 361], ">i4").tobytes()
    (tmp_path / "world.gtx").write_bytes(header + values.tobytes())
    assert geoid_model(tmp_path / "world.gtx") == model
