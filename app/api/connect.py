"""How standard clients connect: a page with lines to copy, which carry the address of this service.

The same recipes make `docs/connect.md` (`scripts/make_connect_page.py`), and the tests run them.
"""

from dataclasses import dataclass, field
from textwrap import fill
from typing import Literal

from fastapi import APIRouter, Request, Response

from amers.app.api.deps import CallerDep, DatabaseDep, SettingsDep
from amers.app.api.negotiation import refuse_unknown
from amers.app.api.pages import Page, document_page
from amers.app.api.routes import CallerRoute
from amers.app.auth import Scope, allows
from amers.app.db.features.collection import Viewer
from amers.app.db.points import POINTS
from amers.app.usecases.features.items import extent

router = APIRouter(include_in_schema=False, route_class=CallerRoute)

TITLE = "Connect"
INTRODUCTION = (
    "Lines to copy for clients that people have. The tests of Amers run them against a service, and "
    "fill in the forms of QGIS. Points need a token of scope `read`, scenes one of scope "
    "`register`; an administrator makes one with `amers token create`. Where points are public, leave "
    "the token out."
)
EXAMPLE = "https://gcp.example.org"
"""The address of the service in the documentation."""
Box = tuple[str, str, str, str]
EXAMPLE_BOX: Box = ("5.22", "43.21", "5.27", "43.26")
"""West, south, east, north in the lines, which the page replaces by a box that the service serves."""
_SIDE_DEG = 0.05


@dataclass(frozen=True)
class Lines:
    """Lines to copy.

    Attributes:
        language: that they are written in; `text`: values for a form.
        text: the lines; `BASE` is the address of the service without a slash at its end.
    """

    language: Literal["bash", "python", "text"]
    text: str

    def at(self, base: str, box: Box = EXAMPLE_BOX) -> str:
        """The lines for the service at an address, with a box."""
        text = self.text.strip("\n").replace("BASE", base)
        for between in (",", ", ", " "):
            text = text.replace(between.join(EXAMPLE_BOX), between.join(box))
        return text


@dataclass(frozen=True)
class Recipe:
    """How one client connects.

    Attributes:
        client: its name, with the versions.
        about: what its user has to know; code stands between backticks.
        steps: to copy, in their order.
        after: what can be done then.
    """

    client: str
    about: str
    steps: tuple[Lines, ...]
    after: str = field(default="")


RECIPES = (
    Recipe(
        "The token, once",
        "The other lines read the token from the variable `TOKEN` or from the file `amers-header`, "
        "which only you can read. So the token is on no command line, which other users of a machine "
        "can see. The first line waits for you to paste the token.",
        (
            Lines("bash", "read -rs TOKEN && export TOKEN"),
            Lines("bash", '(umask 077 && echo "Authorization: Bearer $TOKEN" > amers-header)'),
        ),
    ),
    Recipe(
        "curl",
        "Points of a box as GeoJSON and, with a filter in CQL2, as GeoParquet. Other formats: `csv`, "
        "`fgb`, `gpkg`.",
        (
            Lines(
                "bash",
                """
curl -f -H @amers-header "BASE/collections/points/items?bbox=5.22,43.21,5.27,43.26&limit=10"
curl -f -H @amers-header -G BASE/collections/points/items -d f=parquet \\
     --data-urlencode "filter=saliency > 0.3 AND n_views >= 3" -o points.parquet
""",
            ),
        ),
    ),
    Recipe(
        "GDAL 3.6 and 3.12",
        "`ogrinfo` and `ogr2ogr`; the service evaluates the box and the condition. "
        "`GDAL_HTTP_HEADER_FILE` works with both versions.",
        (
            Lines(
                "bash",
                """
export GDAL_HTTP_HEADER_FILE="$PWD/amers-header"
ogrinfo -so OAPIF:BASE points
ogr2ogr -spat 5.22 43.21 5.27 43.26 -where "saliency > 0.3" points.gpkg OAPIF:BASE points
""",
            ),
        ),
    ),
    Recipe(
        "QGIS 3.22 and later",
        "Menu *Layer*, *Add Layer*, *Add WFS / OGC API - Features Layer*, *New*. Create an "
        "authentication configuration of the method *Basic authentication*: any user name, the token "
        "as password. From QGIS 3.24 on, the method *API Header* with the name `Authorization` and "
        "the value `Bearer TOKEN` does the same.",
        (Lines("text", "URL      BASE\nVersion  OGC API - Features"),),
        "*Connect* lists the layers `points`, `blocks` and `density`. *Only request features "
        "overlapping the view extent* keeps requests small. Many points are faster as vector tiles: "
        "*Add Vector Tile Layer*, *New Generic Connection*, with the same authentication and "
        "`BASE/collections/points/tiles/WebMercatorQuad/{z}/{y}/{x}`.",
    ),
    Recipe(
        "QGIS plugin of Amers",
        "Points with their colours, and registration of the active raster. `make plugin` writes "
        "`build/amers-qgis.zip`, which *Plugins*, *Manage and Install Plugins*, *Install from ZIP* "
        "installs. *Raster*, *Amers*, *Service* asks for the address and for the authentication "
        "configuration of above; registrations need scope `register`.",
        (Lines("text", "Address  BASE"),),
        "*Add points* adds the points as a layer. *Register the active raster* sends the file of the "
        "layer with the files of its model, works in the background, and loads the image in its place, "
        "the control points by their status and their residuals. The results are kept in a folder "
        "beside the image.",
    ),
    Recipe(
        "geopandas 1",
        "Reads through the GDAL of pyogrio, box and condition included.",
        (
            Lines(
                "python",
                """
import geopandas
import pyogrio

pyogrio.set_gdal_config_options({"GDAL_HTTP_HEADER_FILE": "amers-header"})
points = geopandas.read_file(
    "OAPIF:BASE",
    layer="points",
    bbox=(5.22, 43.21, 5.27, 43.26),
    where="saliency > 0.3",
)
print(points[["saliency", "n_views", "geometry"]])
""",
            ),
        ),
    ),
    Recipe(
        "Python client of Amers",
        "Points and blocks, uploads, registrations and their results; it asks for page after page by "
        "itself. It comes with Amers. Where Amers is not installed, the package amers-client has it "
        "alone, with httpx: write `from amers_client import Client`.",
        (
            Lines(
                "python",
                """
from os import environ

from amers import Client

with Client("BASE", environ["TOKEN"]) as client:
    points = list(client.points((5.22, 43.21, 5.27, 43.26)))
    blocks = client.blocks()
print(len(points), "points;", *[block["properties"]["title"] for block in blocks])
""",
            ),
        ),
    ),
    Recipe(
        "OWSLib",
        "Collections and features; `owslib.ogcapi.processes` starts registrations the same way.",
        (
            Lines(
                "python",
                """
from os import environ

from owslib.ogcapi.features import Features

service = Features("BASE", headers={"Authorization": f"Bearer {environ['TOKEN']}"})
page = service.collection_items("points", bbox=[5.22, 43.21, 5.27, 43.26], limit=10)
print(page["numberMatched"], [feature["id"] for feature in page["features"]])
""",
            ),
        ),
    ),
    Recipe(
        "pystac-client",
        "Your scenes with their verdicts, as items of a STAC catalogue. The token needs scope "
        "`register`.",
        (
            Lines(
                "python",
                """
from os import environ

from pystac_client import Client

catalog = Client.open("BASE", headers={"Authorization": f"Bearer {environ['TOKEN']}"})
for item in catalog.search(collections=["scenes"], bbox=[5.22, 43.21, 5.27, 43.26]).items():
    print(item.id, item.properties["title"], item.properties.get("amers:verdict"))
""",
            ),
        ),
    ),
)


@router.get("/connect")
def connect(
    request: Request, database: DatabaseDep, settings: SettingsDep, caller: CallerDep
) -> Response:
    """Return the page, with the address at which the request has arrived, and a box with points."""
    refuse_unknown(request, set())
    page = Page(TITLE, INTRODUCTION)
    base = str(request.base_url).rstrip("/")
    box = EXAMPLE_BOX
    if settings.public_points or (caller is not None and allows(caller, Scope.READ)):
        with database.reading() as connection:
            box = _box_within(extent(connection, POINTS, Viewer()))
    return document_page(request, page, "connect.html", recipes=RECIPES, address=base, box=box)


def _box_within(served: tuple[float, ...] | None) -> Box:
    """A small box in the middle of what is served; that of the documentation without any."""
    if served is None:
        return EXAMPLE_BOX
    west, south, east, north = served
    middle, half = ((west + east) / 2.0, (south + north) / 2.0), _SIDE_DEG / 2.0
    sides = (
        max(west, middle[0] - half),
        max(south, middle[1] - half),
        min(east, middle[0] + half),
        min(north, middle[1] + half),
    )
    one, two, three, four = (f"{side:.4f}" for side in sides)
    return one, two, three, four


def as_markdown(base: str) -> str:
    """The page as Markdown, for the service at an address."""

    def paragraph(text: str) -> str:
        return fill(text.replace("BASE", base), 128, break_long_words=False, break_on_hyphens=False)

    parts = [f"# {TITLE}", paragraph(INTRODUCTION)]
    parts.append("The service shows this page with its own address at `/connect`.")
    for recipe in RECIPES:
        parts += [f"## {recipe.client}", paragraph(recipe.about)]
        parts += [f"```{lines.language}\n{lines.at(base)}\n```" for lines in recipe.steps]
        parts += [paragraph(recipe.after)] if recipe.after else []
    return "\n\n".join(parts) + "\n"
