"""Examples of every command, as its help shows them; a test parses each."""

from collections.abc import Mapping

EXAMPLES: Mapping[str, tuple[str, str]] = {
    "block ingest": ("my-block --publish", "my-block --priority 10"),
    "block list": ("", "--json"),
    "block show": ("my-block", "my-block@2 --json"),
    "block publish": ("my-block", "my-block@2"),
    "block restore": ("my-block@1", "2"),
    "block prioritise": ("my-block 10", "my-block@2 0"),
    "block withdraw": ("my-block", "my-block@1"),
    "block delete": ("my-block@1", "my-block@2"),
    "block export": (
        "--bbox 5.3,43.5,5.5,43.7 -o exported",
        "--bbox 5.3,43.5,5.5,43.7 --id coast --title Coast -o exported",
    ),
    "block quality": ("my-block --site ortho.tif -o quality", "my-block --points-per-km2 1 --ce90-m 3"),
    "block renew": (
        "my-block --image first.tif",
        "my-block --image first.tif --image second.tif --version 4",
    ),
    "block frame": (
        "my-block --images a.tif --images b.tif --control marks.csv --control-frame-sigma-m 0.05,0.05 "
        "-o moved",
        "my-block --images a.tif --images b.tif --control marks.csv --control-frame-sigma-m 0.05,0.05 "
        "--check check.csv -o moved",
    ),
    "base make": (
        "--bbox 5.9 43.5 6.1 43.7 --from sentinel-2 --catalogue https://stac.example.org -o base --plan",
        "--area region.geojson --from sentinel-2 --catalogue mirror --work base.work --publish -o base",
    ),
    "base update": ("base.work -o base-2", "base.work -o base-2 --new-dates 4"),
    "points intersect": (
        "marks.csv --images a.tif --images b.tif -o points.csv",
        "marks.csv --images a.tif --images b.tif --registered registered",
    ),
    "points experiment": (
        "marks.csv --images a.tif --images b.tif",
        "marks.csv --images a.tif --images b.tif --control-points 4,8 --draws 10",
    ),
    "points reach": (
        "north.csv south.csv --images a.tif --images b.tif --site-frame-sigma-m 0.5,1",
        "north.csv south.csv --images a.tif --images b.tif --site-frame-sigma-m 0.5,1 --json",
    ),
    "points query": (
        "--bbox 5.3,43.5,5.5,43.7 -o points.gpkg",
        "--bbox 5.3,43.5,5.5,43.7 --server https://gcp.example.org --json",
    ),
    "points suspensions": ("", "--json"),
    "points suspend": ("42 --because 'the house is gone'", "42 --because 'under water' --json"),
    "points reinstate": ("42", "42 --json"),
    "scene register": (
        "scene.tif --block my-block -o registered",
        "scene.tif --reference ortho.tif --dem heights.tif --vertical EGM2008 -o registered",
    ),
    "scene register-many": (
        "first.tif second.tif --block my-block -o registered",
        "third.tif --block my-block --join registered -o joined",
    ),
    "scene ortho": (
        "scene.tif --dem heights.tif --vertical EGM2008 -o ortho.tif",
        "scene.tif --dem surface.tif --vertical ellipsoid --registered registered --hide -o ortho.tif",
    ),
    "scene straighten": (
        "scene.tif --registered registered -o straight.tif",
        "scene.tif --registered registered --model scene.RPB -o straight.tif",
    ),
    "scene mosaic": (
        "a.tif b.tif c.tif --dem heights.tif --vertical EGM2008 -o mosaic.tif",
        "a.tif b.tif --registered registered --height-m 120 --gsd-m 1 -o mosaic.tif",
    ),
    "surface make": (
        "a.tif b.tif c.tif --registered registered -o surface.tif",
        "a.tif b.tif --gsd-m 1 --jobs 4 -o surface.tif",
    ),
    "surface points": ("surface.tif -o surface.laz", "surface.tif -o surface.laz --json"),
    "surface difference": (
        "before.tif after.tif -o change.tif",
        "before.tif after.tif -o change.tif --json",
    ),
    "vectors canvas": ("scene.tif -o canvas.vrt", "other.tif -o other-canvas.vrt"),
    "vectors correct": (
        "roads.gpkg --scene scene.tif --registration registered --dem heights.tif --vertical EGM2008 "
        "-o corrected.gpkg",
        "roads.gpkg --scene scene.tif --dem heights.tif --vertical EGM2008 --to EPSG:32631 -o roads.fgb",
    ),
    "vectors project": (
        "parcels.gpkg --scene scene.tif --dem heights.tif --vertical EGM2008 -o pixels.geojson",
        "parcels.gpkg --scene scene.tif --dem heights.tif --vertical EGM2008 --clip -o pixels.geojson",
    ),
    "reference add": (
        "ortho.tif --name coast --sigma-m 1",
        "ortho.tif --name coast --dem heights.tif --vertical EGM2008",
    ),
    "reference list": ("", "--json"),
    "reference remove": ("coast", "harbour"),
    "production select": (
        "catalogue.json --area region.geojson -o selection",
        "https://stac.example.org --area region.geojson --since 2024-01-01 -o selection",
    ),
    "production plan": ("configuration.json -o plan", "configuration.json -o plan --json"),
    "production run": (
        "a.tif b.tif c.tif -o my-block",
        "a.tif b.tif --sigma-m 5 --control marks.csv --control-frame-sigma-m 0.05,0.05 -o my-block",
    ),
    "production points": (
        "points.csv --images ortho.tif --sigma-m 1 -o my-block",
        "points.csv --chips chips --frame-sigma-m 1 -o my-block",
    ),
    "production ortho": (
        "june.tif may.tif --dem heights.tif --vertical EGM2008 --sigma-m 3 -o my-block",
        "ortho.tif --height-m 50 --height-sigma-m 5 --spacing-m 30 --sigma-m 3 -o my-block",
    ),
    "db upgrade": ("", "--json"),
    "db status": ("", "--json"),
    "db backup": ("backup-monday", "backup-monday --json"),
    "db verify-backup": ("backup-monday", "backup-monday --json"),
    "db restore": ("backup-monday", "backup-monday --json"),
    "store adopt": ("", "--json"),
    "store usage": ("", "--json"),
    "store sweep": ("", "--json"),
    "store verify": ("", "--repair backup-monday --rate 50"),
    "store trash list": ("", "--json"),
    "store trash restore": ("20241103T101500Z", "20241103T101500Z --json"),
    "store trash empty": ("", "--json"),
    "token create": (
        "'survey office' --scope register --days 90",
        "dashboards --scope monitor --json",
    ),
    "token list": ("", "--json"),
    "token revoke": ("'survey office'", "dashboards"),
    "demo": ("", "-o demonstration"),
    "serve": ("", "--data demo-output/store --port 8001"),
    "worker": ("", ""),
    "audit": ("--limit 20", "--kind block --actor operator --json"),
    "doctor": ("", "--json"),
}
"""Words after a command, by the command."""


def epilogue(command: str) -> str | None:
    """The examples of a command, each on a line of the help; None without any."""
    shown = [f"amers {command} {words}".rstrip() for words in dict.fromkeys(EXAMPLES.get(command, ()))]
    return "Examples:\n\n" + "\n\n".join(shown) if shown else None
