"""`amers points reach`: how far each of several known sites carries alone."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np
import typer

from amers.app.cli.options import FromMilli, GeoidFile, Places, Shown, refuse_alone
from amers.app.cli.output import AsJson, print_json, show, show_statements
from amers.app.cli.point_intersection import GroundStatements
from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.errors import InputError
from amers.app.json_values import usable
from amers.app.usecases.known_sites import SiteHeights, SiteSigmas, SitesReached, reach_of_sites
from amers.app.usecases.marks_in_images import MarkedImages
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.pieces import source_of

Files = Annotated[
    MarkedImages,
    Shown(
        marks=typer.Argument(exists=True),
        images=None,
        rigorous=None,
        sigma_m=typer.Option(),
        mark_sigma_px=typer.Option(min=0.001),
    ),
]


@dataclass(frozen=True)
class TieHeights:
    """Heights of the points that tie images, or none.

    Attributes:
        dem: heights of the points without known ground, which ortho-images need: a file, folder,
            archive, .txt list or STAC catalogue of tiles; path or address; repeat for several.
        dem_vertical: vertical datum of --dem: ellipsoid, EGM96, EGM2008, EPSG:…
        dem_geoid: grid file of the geoid of these heights, GTX or GeoTIFF.
        dem_sigma_m: sigma of single heights, metres; by default the sigmas that the file contains, or a
            tenth of its posting.
        dem_frame_sigma_m: sigma of the common error of all heights, metres; by default 0.
    """

    dem: Places = ()
    dem_vertical: str | None = None
    dem_geoid: GeoidFile = None
    dem_sigma_m: FromMilli = None
    dem_frame_sigma_m: FromMilli = None

    @property
    def heights(self) -> SiteHeights | None:
        """The heights; None without --dem.

        Raises:
            InputError: an option belongs to --dem, which is not given.
        """
        refuse_alone("dem", self, "dem_vertical", "dem_geoid", "dem_sigma_m", "dem_frame_sigma_m")
        if not self.dem:
            return None
        source = source_of(self.dem)
        terrain = TerrainFile(source, self.dem_vertical, self.dem_geoid, geoid_option="--dem-geoid")
        return SiteHeights(terrain, self.dem_sigma_m, self.dem_frame_sigma_m or 0.0)


def reach(
    *,
    files: Files,
    site_frame_sigma_m: Annotated[
        str,
        typer.Option(
            help="Common error of all points of one site: HORIZONTAL,UP, one sigma, metres, "
            "such as 0.05,0.05 for GNSS."
        ),
    ],
    models: ModelChoice,
    stated: GroundStatements,
    point_sigma_m: Annotated[
        str | None,
        typer.Option(
            help="Accuracy of known ground if its file states none: HORIZONTAL,UP, one sigma, metres."
        ),
    ] = None,
    tie_heights: TieHeights,
    edge_sigma_m: Annotated[
        list[str] | None,
        typer.Option(
            help="Sigma of drift and skew of a model at the edge of its image, metres; for one "
            "of several images write IMAGE=M, and repeat the option. By default 0.0001 of the "
            "size of the image."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure how far the effect of each known site reaches when it is the only control.

    Each file of marks with known ground is a site. Points without known ground tie the images. The
    images are adjusted with all sites, then with each site alone as control, and the other sites check
    the result.
    """
    of_file = stated_by_caller(
        stated.geoid or stated.vertical, stated.crs, stated.columns, stated.sigma_axes
    )
    frame_m = sigma_pair(site_frame_sigma_m, "--site-frame-sigma-m")
    if frame_m is None:
        raise InputError("--site-frame-sigma-m: HORIZONTAL,UP expected, such as 0.05,0.05")
    reached = reach_of_sites(
        replace(files, models=models, stated=of_file),
        SiteSigmas(frame_m, sigma_pair(point_sigma_m, "--point-sigma-m")),
        tie_heights.heights,
        edge_sigma_m or (),
    )
    if as_json:
        print_json(usable(_document(reached)))
        return
    show_statements(reached.statements)
    show(_checks(reached), as_json=False)
    typer.echo("")
    show(_corners(reached), as_json=False)


def _checks(reached: SitesReached) -> list[dict[str, Any]]:
    return [
        {
            "known": check.active,
            "check": check.check,
            "km": f"{check.distance_km:.0f}",
            "points": check.points,
            "east m": f"{check.error_m[0]:.2f}",
            "north m": f"{check.error_m[1]:.2f}",
            "up m": f"{check.error_m[2]:.2f}",
            "residual m": f"{check.residual_m:.2f}",
            "declared m": f"{np.sqrt(np.trace(check.covariance_m2[:2, :2])):.2f}",
        }
        for check in reached.reach.checks
    ]


def _corners(reached: SitesReached) -> list[dict[str, Any]]:
    return [
        {
            "known": corner.active,
            "image": corner.image,
            "corners move by m": ", ".join(f"{length:.2f}" for length in np.hypot(*corner.moved_m.T)),
        }
        for corner in reached.reach.corners
    ]


def _document(reached: SitesReached) -> dict[str, Any]:
    return {
        "sites": reached.sites,
        "ties": reached.ties,
        "heights": reached.heights,
        "checks": [
            {
                "known": check.active,
                "check": check.check,
                "distance_km": check.distance_km,
                "points": check.points,
                "error_m": check.error_m.tolist(),
                "residual_m": check.residual_m,
                "covariance_m2": check.covariance_m2.tolist(),
            }
            for check in reached.reach.checks
        ],
        "corners": [
            {"known": one.active, "image": one.image, "moved_m": one.moved_m.tolist()}
            for one in reached.reach.corners
        ],
        "statements": [asdict(one) for one in reached.statements],
    }
