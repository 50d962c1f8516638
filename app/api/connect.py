"""How standard clients connect: a page of copy-and-paste examples with the address of this service.

`scripts/make_connect_page.py` writes `docs/connect.md` from the same recipes, and the tests run them.
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
    "Copy-and-paste examples for common clients of an Amers service. Requests for points need a token "
    "of scope `read`, requests for scenes a token of scope `register`. An administrator creates tokens "
    "with `amers token create`. If the points of the service are public, leave the token out. The tests "
    "of Amers run these examples against a service and fill in the forms of QGIS."
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
        language: of the lines; `text` means values for a form.
        text: the lines; `BASE` stands for the address of the service without a slash at its end.
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
        client: name and versions of the client.
        about: what the reader does before copying; code is between backticks.
        steps: lines to copy, in their order.
        after: what the reader can do afterwards.
    """

    client: str
    about: str
    steps: tuple[Lines, ...]
    after: str = field(default="")


RECIPES = (
    Recipe(
        "The token, once",
        "Run these two commands first. The first command waits until you paste the token, and stores it "
        "in the variable `TOKEN`. The second command writes the token into the file `amers-header`, "
        "which only you can read. The other examples use the variable or the file. So the token never "
        "appears on a command line, where other users of the machine could see it.",
        (
            Lines("bash", "read -rs TOKEN && export TOKEN"),
            Lines("bash", '(umask 077 && echo "Authorization: Bearer $TOKEN" > amers-header)'),
        ),
    ),
    Recipe(
        "curl",
        "The first command requests the points of a bounding box as GeoJSON. The second command "
        "requests points that match a CQL2 filter and writes them as GeoParquet. A reply contains at "
        "most 100 points unless `limit` states another number, up to 10,000. For CSV, FlatGeobuf or "
        "GeoPackage, write `f=csv`, `f=fgb` or `f=gpkg`.",
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
        "`ogrinfo` describes the layer of points, and `ogr2ogr` writes selected points into a "
        "GeoPackage. The service evaluates the box and the condition, so only the selected points are "
        "transferred. `GDAL_HTTP_HEADER_FILE` works with both versions of GDAL.",
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
        "Choose *Layer*, *Add Layer*, *Add WFS / OGC API - Features Layer*, *New*, and enter the values "
        "below. Create an authentication configuration with the method *Basic authentication*: enter "
        "any user name, and the token as password. From QGIS 3.24 on, you can instead use the method "
        "*API Header* with the name `Authorization` and the value `Bearer TOKEN`.",
        (Lines("text", "URL      BASE\nVersion  OGC API - Features"),),
        "*Connect* lists the layers `points`, `blocks` and `density`. The option *Only request features "
        "overlapping the view extent* keeps requests small. Vector tiles display many points faster. To "
        "use them, choose *Add Vector Tile Layer*, *New Generic Connection*, with the same "
        "authentication and the address `BASE/collections/points/tiles/WebMercatorQuad/{z}/{y}/{x}`.",
    ),
    Recipe(
        "QGIS plugin of Amers",
        "The plugin displays the points coloured by their horizontal sigma, and registers the active "
        "raster layer. `make plugin` writes `build/amers-qgis.zip`. Install this file with *Plugins*, "
        "*Manage and Install Plugins*, *Install from ZIP*. Then choose *Raster*, *Amers*, *Service*, "
        "and enter the address below and the authentication configuration of the section on QGIS. A "
        "registration needs a token of scope `register`.",
        (Lines("text", "Address  BASE"),),
        "*Add points* adds the points as a layer. *Register the active raster* uploads the image of the "
        "layer with the files of its sensor model, and waits for the result in the background. It then "
        "adds the registered image, the control points by their status, and their residuals as layers. "
        "The results are stored in a folder next to the image.",
    ),
    Recipe(
        "geopandas 1",
        "geopandas reads the points with the GDAL library of pyogrio. The service evaluates the box and "
        "the condition.",
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
        "The client reads points and blocks, uploads scenes, starts registrations and downloads their "
        "results. It requests all pages of a reply by itself. The client is part of Amers. Without "
        "Amers, install the package amers-client, which needs only httpx, and write `from amers_client "
        "import Client`.",
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
        "OWSLib lists collections and reads features. Its module `owslib.ogcapi.processes` starts "
        "registrations; the address and the header are the same.",
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
        "pystac-client reads your scenes, with their verdicts, as items of a STAC catalogue. The token "
        "needs scope `register`.",
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
    """Return the page with the address at which the request arrived, and a box that contains points."""
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
    parts.append(
        "A running service shows this page at `/connect`, with its own address in the examples."
    )
    for recipe in RECIPES:
        parts += [f"## {recipe.client}", paragraph(recipe.about)]
        parts += [f"```{lines.language}\n{lines.at(base)}\n```" for lines in recipe.steps]
        parts += [paragraph(recipe.after)] if recipe.after else []
    return "\n\n".join(parts) + "\n"
