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
    "This page contains copy-and-paste examples for common clients of an Amers service. Requests for "
    "points need a token of scope `read`; requests for scenes need a token of scope `register`. Ask "
    "the administrator of the service for a token: the command `amers token create` makes one. If the "
    "points of the service are public, leave the token out. The examples are tested: the tests of "
    "Amers run them against a service and fill in the forms of QGIS. If such a test needs software "
    "that Amers does not install, the example names this software."
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

    language: Literal["bash", "python", "r", "javascript", "text"]
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
        needs: software without which the tests skip the lines; "" if the tests always run them.
    """

    client: str
    about: str
    steps: tuple[Lines, ...]
    after: str = field(default="")
    needs: str = field(default="")

    @property
    def introduction(self) -> str:
        """What stands before the lines: what the reader does, and where the tests run the lines."""
        if not self.needs:
            return self.about
        return f"{self.about} The tests of Amers run this example only on machines with {self.needs}."


RECIPES = (
    Recipe(
        "The token, once",
        "Run these two commands first. The first command waits until you paste the token, and stores it "
        "in the variable `TOKEN`. The second command writes the token into the file `amers-header`, "
        "which only you can read. The other examples read the token from the variable or from the file. "
        "Therefore the token never appears on a command line, where other users of the machine could "
        "see it.",
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
        "`ogrinfo` describes the layer of points. `ogr2ogr` writes points into a GeoPackage: the points "
        "inside the box of `-spat` for which the condition of `-where` is true. The service selects the "
        "points, so only these points are transferred. The option `GDAL_HTTP_HEADER_FILE`, which names "
        "the file with the token, works in both versions of GDAL.",
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
        needs="gdal-bin of Debian",
    ),
    Recipe(
        "QGIS 3.22 and later",
        "Choose *Layer*, *Add Layer*, *Add WFS / OGC API - Features Layer*, *New*, and enter the values "
        "below. Create an authentication configuration with the method *Basic authentication*: enter "
        "any user name, and the token as password. From QGIS 3.24 on, you can instead use the method "
        "*API Header* with the name `Authorization` and the value `Bearer TOKEN`.",
        (Lines("text", "URL      BASE\nVersion  OGC API - Features"),),
        "The button *Connect* lists the layers `points`, `blocks` and `density`. Switch on the option "
        "*Only request features overlapping the view extent*, so that QGIS requests only the visible "
        "points. To display very many points, vector tiles are faster. To use vector tiles, choose "
        "*Add Vector Tile Layer*, *New Generic Connection*, with the same authentication and the "
        "address `BASE/collections/points/tiles/WebMercatorQuad/{z}/{y}/{x}`.",
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
        "geopandas reads the points with the GDAL library of pyogrio. The service selects the points "
        "that are inside the box `bbox` and for which the condition `where` is true.",
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
        "R with sf and httr2",
        "The first example reads the points of a box with the GDAL library of sf. GDAL requests all "
        "pages of the reply. The second example uses httr2 to request the points that match a CQL2 "
        "filter, and converts the reply into a table of sf. This reply contains at most 10,000 points."
        " The pipe `|>` needs R 4.1 or later.",
        (
            Lines(
                "r",
                """
library(sf)
Sys.setenv(GDAL_HTTP_HEADER_FILE = "amers-header")
box <- setNames(c(5.22, 43.21, 5.27, 43.26), c("xmin", "ymin", "xmax", "ymax"))
outline <- st_as_text(st_as_sfc(st_bbox(box)))
points <- st_read("OAPIF:BASE", layer = "points", wkt_filter = outline)
print(points[c("saliency", "n_views")])
""",
            ),
            Lines(
                "r",
                """
library(httr2)
reply <- request("BASE/collections/points/items") |>
  req_url_query(bbox = "5.22,43.21,5.27,43.26", filter = "saliency > 0.3", limit = 10000) |>
  req_headers(Authorization = paste("Bearer", Sys.getenv("TOKEN")), Accept = "application/geo+json") |>
  req_perform()
salient <- st_read(resp_body_string(reply), quiet = TRUE)
print(nrow(salient))
""",
            ),
        ),
        needs="R, sf and httr2",
    ),
    Recipe(
        "Python client of Amers",
        "The class `Client` reads points and blocks, uploads scenes, starts registrations and downloads "
        "the results of registrations. If a reply has several pages, the client requests all of them. "
        "The client is part of Amers. On a machine without Amers, install the package amers-client, "
        "which needs only httpx, and write `from amers_client import Client`.",
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
        "The example reads ten points of a box. To start registrations with OWSLib, use the class "
        "`Processes` of the module `owslib.ogcapi.processes` with the same address and header.",
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
        "pystac-client reads the scenes that you uploaded as items of a STAC catalogue. The example "
        "prints the verdict of the registration of each scene. The token needs scope `register`.",
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
    Recipe(
        "JavaScript with fetch",
        "The script requests the points of a bounding box as GeoJSON. A reply contains one page of at "
        "most 1,000 points. The link `next` of a page is the address of the next page. The last page "
        "has no such link. Save the lines as `points.mjs` and run them with `node points.mjs`, in "
        "Node.js 18 or later.",
        (
            Lines(
                "javascript",
                """
const headers = { Authorization: `Bearer ${process.env.TOKEN}`, Accept: "application/geo+json" };
const points = [];
let url = "BASE/collections/points/items?bbox=5.22,43.21,5.27,43.26&limit=1000";
while (url) {
  const reply = await fetch(url, { headers });
  if (!reply.ok) throw new Error(`${reply.status}: ${await reply.text()}`);
  const page = await reply.json();
  points.push(...page.features);
  url = page.links.find((link) => link.rel === "next")?.href;
}
console.log(points.length, "points");
for (const { id, geometry, properties } of points.slice(0, 3)) {
  console.log(id, geometry.coordinates, properties.saliency);
}
""",
            ),
        ),
        "The same code works in a script of type `module` on a web page. There, replace "
        "`process.env.TOKEN` by a token that the user enters. Do not write a token into the page, "
        "because every visitor could read it. A page of another site can call the service only if the "
        "setting `AMERS_CORS_ORIGINS` of the service names this site.",
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
        parts += [f"## {recipe.client}", paragraph(recipe.introduction)]
        parts += [f"```{lines.language}\n{lines.at(base)}\n```" for lines in recipe.steps]
        parts += [paragraph(recipe.after)] if recipe.after else []
    return "\n\n".join(parts) + "\n"
