"""The options that state the control of a block, and the marks that a scene is registered on."""

from dataclasses import dataclass
from pathlib import Path

from amers.app.cli.options import FromMilli, GeoidFile, Places, refuse_alone
from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.usecases.control_files import ControlFiles, HeightFile
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.registration.control_marks import MarkFiles
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.pieces import source_of

_OF_POINTS = (
    "control_sigma_m",
    "control_frame_sigma_m",
    "control_mark_sigma_px",
    "control_vertical",
    "control_geoid",
    "control_crs",
    "control_columns",
    "control_sigma_axes",
)
"""Options that describe --control."""
_OF_HEIGHTS = ("control_dem_vertical", "control_dem_geoid", "control_dem_sigma_m")
"""Options that describe --control-dem."""


@dataclass(frozen=True)
class MarkOptions:
    """Ground points that a person marked in a scene.

    Attributes:
        control: file of ground points marked in the scene (CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI,
            PCI); repeat for several.
        control_sigma_m: accuracy of marked ground points if their file states none: HORIZONTAL,UP, one
            sigma, metres; by default one pixel.
        control_frame_sigma_m: common error of all marked ground points on the Earth: HORIZONTAL,UP, one
            sigma, metres.
        control_mark_sigma_px: sigma of marks if their file states none, pixels; by default 0.5.
        control_vertical: vertical datum of the marked ground points: ellipsoid, EGM96, EGM2008, EPSG:…
        control_geoid: grid file of the geoid of these heights, GTX or GeoTIFF.
        control_crs: reference system of x and y of a CSV, such as EPSG:32633.
        control_columns: names of the columns of a CSV, if they differ from the usual ones:
            lon=COLUMN,lat=COLUMN,…
        control_sigma_axes: axes of the sigmas of an ASP file: ecef or lat-lon-height.
        control_dem: heights for marks without heights, such as those of QGIS: a file, folder, archive,
            .txt list or STAC catalogue of tiles; path or address; repeat for several.
        control_dem_vertical: vertical datum of --control-dem: ellipsoid, EGM96, EGM2008, EPSG:…
        control_dem_geoid: grid file of the geoid of --control-dem, GTX or GeoTIFF.
        control_dem_sigma_m: sigma of the heights of --control-dem, metres; by default the sigmas that
            the file contains, or a tenth of its posting.
    """

    control: tuple[Path, ...] = ()
    control_sigma_m: str | None = None
    control_frame_sigma_m: str | None = None
    control_mark_sigma_px: FromMilli = None
    control_vertical: str | None = None
    control_geoid: GeoidFile = None
    control_crs: str | None = None
    control_columns: str | None = None
    control_sigma_axes: str | None = None
    control_dem: Places = ()
    control_dem_vertical: str | None = None
    control_dem_geoid: GeoidFile = None
    control_dem_sigma_m: FromMilli = None

    def files(self, of_many: bool = False) -> MarkFiles | None:
        """The files of the marks, with what the options state about them; None without any.

        Args:
            of_many: see `MarkFiles`.

        Raises:
            InputError: a value is wrong, or states something of a file that is not given.
        """
        refuse_alone("control", self, *_OF_POINTS, "control_dem", *_OF_HEIGHTS)
        refuse_alone("control_dem", self, *_OF_HEIGHTS)
        if not self.control:
            return None
        terrain = None
        if self.control_dem:
            terrain = TerrainFile(
                source_of(self.control_dem),
                self.control_dem_vertical,
                self.control_dem_geoid,
                geoid_option="--control-dem-geoid",
            )
        statements = _point_statements(self)
        return MarkFiles(self.control, statements, terrain, self.control_dem_sigma_m, of_many)


@dataclass(frozen=True)
class ControlOptions:
    """What places a block on the Earth.

    Attributes:
        control: control of the block: folder of an older block, or file of ground points marked in the
            images (CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI, PCI); repeat for several.
        control_sigma_m: accuracy of control points if their file states none: HORIZONTAL,UP, one sigma,
            metres.
        control_frame_sigma_m: common error of all control points on the Earth: HORIZONTAL,UP, one sigma,
            metres.
        control_mark_sigma_px: sigma of marks if their file states none, pixels; by default 0.5.
        control_vertical: vertical datum of control points: ellipsoid, EGM96, EGM2008, EPSG:…
        control_geoid: grid file of the geoid of the control points, GTX or GeoTIFF.
        control_crs: reference system of x and y of a CSV, such as EPSG:32633.
        control_columns: names of the columns of a CSV, if they differ from the usual ones:
            lon=COLUMN,lat=COLUMN,…
        control_sigma_axes: axes of the sigmas of an ASP file: ecef or lat-lon-height.
        control_ortho: ortho-image as horizontal control of the block: a file, or a folder, archive,
            .vrt, .txt list or STAC catalogue of its pieces; path or address; repeat for several.
        control_ortho_sigma_m: accuracy of --control-ortho on the Earth, one sigma per coordinate,
            metres; by default the accuracy of the product.
        control_dem: heights of the ground as vertical control of the block: a file, folder, archive,
            .txt list or STAC catalogue of tiles; path or address; repeat for several.
        control_dem_vertical: vertical datum of --control-dem: ellipsoid, EGM96, EGM2008, EPSG:…
        control_dem_geoid: grid file of the geoid of --control-dem, GTX or GeoTIFF.
        control_dem_sigma_m: sigma of single heights of --control-dem, metres; not needed for a surface,
            which contains its sigmas.
        control_dem_frame_sigma_m: common error of all heights of --control-dem: HORIZONTAL,UP, one
            sigma, metres.
    """

    control: tuple[Path, ...] = ()
    control_sigma_m: str | None = None
    control_frame_sigma_m: str | None = None
    control_mark_sigma_px: FromMilli = None
    control_vertical: str | None = None
    control_geoid: GeoidFile = None
    control_crs: str | None = None
    control_columns: str | None = None
    control_sigma_axes: str | None = None
    control_ortho: Places = ()
    control_ortho_sigma_m: FromMilli = None
    control_dem: Places = ()
    control_dem_vertical: str | None = None
    control_dem_geoid: GeoidFile = None
    control_dem_sigma_m: FromMilli = None
    control_dem_frame_sigma_m: str | None = None

    def files(self, neighbour: Path | None = None) -> ControlFiles:
        """The files of the control, with what the options state about them.

        Raises:
            InputError: a value is wrong, or states something of a file that is not given.
        """
        refuse_alone("control", self, *_OF_POINTS)
        refuse_alone("control_dem", self, *_OF_HEIGHTS, "control_dem_frame_sigma_m")
        refuse_alone("control_ortho", self, "control_ortho_sigma_m")
        return ControlFiles(
            self.control,
            _point_statements(self),
            orthos=tuple(source_of([place]) for place in self.control_ortho),
            ortho_sigma_m=self.control_ortho_sigma_m,
            heights=self._heights(),
            neighbour=neighbour,
        )

    def _heights(self) -> HeightFile | None:
        if not self.control_dem:
            return None
        terrain = TerrainFile(
            source_of(self.control_dem),
            self.control_dem_vertical,
            self.control_dem_geoid,
            geoid_option="--control-dem-geoid",
        )
        frame_sigma_m = sigma_pair(self.control_dem_frame_sigma_m, "--control-dem-frame-sigma-m")
        return HeightFile(terrain, self.control_dem_sigma_m, frame_sigma_m)


def _point_statements(options: MarkOptions | ControlOptions) -> PointStatements:
    """What options state of files of ground points."""
    return PointStatements(
        stated_by_caller(
            options.control_geoid or options.control_vertical,
            options.control_crs,
            options.control_columns,
            options.control_sigma_axes,
            "--control-",
        ),
        sigma_pair(options.control_sigma_m, "--control-sigma-m"),
        sigma_pair(options.control_frame_sigma_m, "--control-frame-sigma-m"),
        options.control_mark_sigma_px,
    )
