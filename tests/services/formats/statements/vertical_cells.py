"""Vertical systems as other programs write them: without codes, by ESRI's names, with unknown datums."""

from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine

from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.elevation.rows import GEOID_READER, GRID_READER, TERRAIN_READER
from amers.services.statements import Subject
from amers.services.terrain import Terrain
from tests.services.formats.elevation.test_dem import write_geoid
from tests.services.formats.elevation.test_grid_files import WGS84_PRJ, bil
from tests.services.formats.statements.cell import Read, add, cell
from tests.services.formats.statements.terrain_cells import HEIGHT, US_FT, dem, terrain_of

WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
METRE = 'UNIT["metre",1,AUTHORITY["EPSG","9001"]]'
US_FOOT = 'UNIT["US survey foot",0.304800609601219,AUTHORITY["EPSG","9003"]]'
PLACE = {"transform": Affine(1e-4, 0, 5.0, 0, -1e-4, 44.0)}


def compound(name: str, unit: str = METRE, kind: int = 2005) -> str:
    vertical = f'VERT_CS["{name}",VERT_DATUM["{name}",{kind}],{unit},AXIS["Up",UP]]'
    return f'COMPD_CS["WGS 84 + {name}",{WGS84},{vertical}]'


for name in ("unknown", "Unnamed", "undefined", "Unknown height"):
    height_m, form = HEIGHT * US_FT, {"crs": compound(name, US_FOOT)} | PLACE
    read = terrain_of(height_m, **form)
    add(TERRAIN_READER, Subject.UNIT, "used", "US survey foot", f"feet_above_{name}", read)
    read = terrain_of(None, None, **form)
    shows = "does not state its vertical datum"
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "refused", shows, f"datum_{name}", read)
for name in ("WGS 84 ellipsoid", "Ellipsoid (m)", "WGS_1984"):
    read = terrain_of(HEIGHT, None, crs=compound(name), **PLACE)
    shows = "the ellipsoid: used"
    add(TERRAIN_READER, Subject.VERTICAL_DATUM, "used", shows, f"datum_{name}", read)


def above_geoid(name: str, grid: str) -> Read:
    """A file above a datum of this name, with a grid of this name."""

    def read(folder: Path) -> Terrain:
        path = dem(folder, compound(name), **PLACE)
        return read_dem(path, geoid=write_geoid(folder / grid))

    return read


for name, grid in (
    ("EGM96_Geoid", "egm96_15.gtx"),
    ("EGM2008_Geoid", "egm08_25.gtx"),
    ("EGM 96 height", "egm96_15.gtx"),
    ("EGM08", "us_nga_egm08_25.gtx"),
):
    read = above_geoid(name, grid)
    add(GEOID_READER, Subject.VERTICAL_DATUM, "used", f"from {grid}", f"{name}_{grid}", read)
for name, grid in (
    ("EGM2008_Geoid", "egm96_15.gtx"),
    ("EGM96_Geoid", "egm08_25.gtx"),
    ("EGM84", "egm96_15.gtx"),
):
    read = above_geoid(name, grid)
    shows = "the same geoid expected"
    add(GEOID_READER, Subject.VERTICAL_DATUM, "refused", shows, f"{name}_{grid}", read)
read = above_geoid("NAVD88 (Geoid12B) (ftUS)", "egm96_15.gtx")
add(GEOID_READER, Subject.VERTICAL_DATUM, "named", "EGM96, and is used", "NAVD88_by_name", read)


def esri(name: str, unit: str) -> str:
    return f'{WGS84_PRJ},VERTCS["{name}",VDATUM["{name}"],PARAMETER["Direction",1.0],UNIT[{unit}]]'


@cell(GRID_READER.name, Subject.VERTICAL_DATUM, "used", "EGM96 height: used")
def the_prj_of_a_bil_states_its_heights(folder: Path) -> Terrain:
    path = bil(folder)
    (folder / "a.prj").write_text(esri("EGM96_Geoid", '"Foot_US",0.3048006096012192'))
    terrain = read_dem(path, geoid=write_geoid(folder / "geoid.gtx"))
    assert terrain.nodes()[0, 0] == pytest.approx(300.0 * US_FT)
    return terrain


@cell(TERRAIN_READER.name, Subject.HORIZONTAL_DATUM, "refused", "expected one with a transformation")
def a_terrain_of_the_moon(folder: Path) -> Terrain:
    moon = (
        'GEOGCS["Moon 2000",DATUM["D_Moon_2000",SPHEROID["Moon_2000_IAU_IAG",1737400,0]],'
        'PRIMEM["Reference_Meridian",0],UNIT["degree",0.0174532925199433]]'
    )
    return read_dem(dem(folder, moon, **PLACE), "ellipsoid")


@cell(TERRAIN_READER.name, Subject.HORIZONTAL_DATUM, "refused", "expected one with a transformation")
def a_terrain_on_a_local_plan(folder: Path) -> Terrain:
    return read_dem(dem(folder, 'LOCAL_CS["Site grid",UNIT["metre",1]]'), "ellipsoid")


@cell(TERRAIN_READER.name, Subject.VERTICAL_DATUM, "used", "moved by its datum shift")
def three_axes_of_a_national_system_move_heights(folder: Path) -> Terrain:
    """DB_REF is on the ellipsoid of Bessel, which lies 46.6 m above that of WGS 84 there."""
    terrain = read_dem(dem(folder, "EPSG:5830", transform=Affine(1e-4, 0, 10.45, 0, -1e-4, 51.18)))
    middle = terrain.grid.lon_lat(np.array([[4.0, 4.0]]))
    assert terrain.height_m(middle)[0] - HEIGHT == pytest.approx(46.6, abs=0.05)
    return terrain
