"""Query points of a running service into geopandas and draw them on a map.

    amers serve                                                      # in another shell
    python examples/query_points.py WEST,SOUTH,EAST,NORTH PICTURE [URL]

The token is read from the environment variable AMERS_TOKEN; a service with public points needs none.
"""

import os
import sys

import geopandas
import matplotlib.pyplot as plt

from amers import Client


def query_points(bbox: str, url: str, token: str) -> geopandas.GeoDataFrame:
    """The published points of a box whose chips are easy to locate, as a table.

    Args:
        bbox: west, south, east, north in degrees, separated by commas.
        url: of the service.
        token: secret with the scope `read`; "" for a service with public points.
    """
    west, south, east, north = map(float, bbox.split(","))
    with Client(url, token) as client:
        # The condition is CQL2, on any property of /collections/points/queryables.
        points = list(client.points((west, south, east, north), where="saliency > 0.1"))
    return geopandas.GeoDataFrame.from_features(points, crs="EPSG:4979")


def draw(points: geopandas.GeoDataFrame, picture: str) -> None:
    """Draw the points in metres, coloured by height, the larger the more salient."""
    heights_m = points.geometry.get_coordinates(include_z=True)["z"]
    on_map = points.to_crs(points.estimate_utm_crs())
    axes = on_map.plot(
        column=heights_m.to_numpy(),
        markersize=60.0 * points["saliency"],
        legend=True,
        legend_kwds={"label": "height above the ellipsoid, m"},
        figsize=(7.0, 6.0),
    )
    axes.set(xlabel="east, m", ylabel="north, m", title=f"{len(points)} control points")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.tick_params(axis="x", rotation=45)
    axes.figure.savefig(picture, dpi=120, bbox_inches="tight")
    plt.close(axes.figure)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    box, output = sys.argv[1], sys.argv[2]
    service = sys.argv[3] if len(sys.argv) > 3 else "http://127.0.0.1:8000"
    table = query_points(box, service, os.environ.get("AMERS_TOKEN", ""))
    print(f"{len(table)} control points, columns: {', '.join(table.columns)}")
    draw(table, output)
