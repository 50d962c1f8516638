"""Images for a block out of 50,000: enough clear views everywhere, near the lower bound, in minutes.

A catalogue of three satellites over 2,000 x 2,000 km around 15 E, 0 N is simulated: passes of 60 km
scenes over four years, rolled and pitched, with clouds by place and season, masks, and gaps in what is
stated. It is written as lines of STAC items with a GeoJSON mask each. Then `read_catalogue` and
`select_images` run as `amers production select` runs them. Counted again with shapely, at random places
that are not the centres of cells: the views of the chosen images, and those of all usable ones.

Run: python -m benchmarks.image_selection [--images 50000] [--side-km 2000] [--places 2000]
"""

import argparse
import math
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from rich.console import Console
from rich.table import Table

from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.production.image_selection import (
    ImageSelection,
    image_steps,
    select_images,
    with_cloud_from_masks,
)
from amers.services.types import Array, IntArray
from benchmarks._catalogue import (
    CENTRE_LON_LAT,
    KM_PER_DEGREE,
    SCENE_KM,
    simulate_catalogue,
    write_catalogue,
)
from benchmarks._measuring import keep, memory_mib


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=50_000, help="of the catalogue (%(default)s)")
    parser.add_argument("--side-km", type=float, default=2000.0, help="of the ground (%(default)s)")
    parser.add_argument("--places", type=int, default=2000, help="counted again (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (%(default)s)")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    area = ground(arguments.side_km)
    with tempfile.TemporaryDirectory(prefix="amers-selection-") as folder:
        simulated = simulate_catalogue(arguments.images, arguments.side_km, rng)
        path = write_catalogue(simulated, Path(folder) / "catalogue")
        del simulated
        before_mib = memory_mib("VmRSS")
        warm_up(rng)
        seconds: dict[str, float] = {}
        started = time.process_time()
        read = read_catalogue(str(path))
        seconds["read the catalogue"] = time.process_time() - started
        started = time.process_time()
        selection = select_images(read.images, area=area)
        seconds["select"] = time.process_time() - started
        memory = {"before_mib": before_mib, "peak_mib": memory_mib("VmHWM")}
    places = random_places(area, arguments.places, rng)
    again = count_again(read.images, selection, places)
    show(selection, seconds, memory, again)
    keep("image_selection", document(selection, seconds, memory, again))


def ground(side_km: float) -> shapely.Geometry:
    """The square that needs views: inside by a scene, so that its borders are seen as its middle is."""
    half = (side_km / 2.0 - SCENE_KM) / KM_PER_DEGREE
    west, south = CENTRE_LON_LAT - half
    east, north = CENTRE_LON_LAT + half
    return shapely.box(west, south, east, north)


def warm_up(rng: np.random.Generator) -> None:
    """Compile: a small selection."""
    select_images(simulate_catalogue(50, 300.0, rng))


def random_places(area: shapely.Geometry, count: int, rng: np.random.Generator) -> Array:
    """Places (n, 2) in a box, longitude and latitude."""
    west, south, east, north = area.bounds
    return np.column_stack([rng.uniform(west, east, count), rng.uniform(south, north, count)])


def count_again(catalogue: ImageCatalogue, selection: ImageSelection, places: Array) -> dict[str, float]:
    """What the chosen images reach at places, counted from footprints and masks with shapely alone."""
    step = image_steps(with_cloud_from_masks(catalogue), selection.options)
    usable = np.flatnonzero(step >= 0)
    views = clear_views(catalogue, usable, step, places, len(selection.options.cloud_limits_percent))
    available = views.cumsum(axis=1)
    needed = selection.options.min_views
    limit = np.where(
        (available >= needed).any(axis=1), (available >= needed).argmax(axis=1), available.shape[1] - 1
    )
    rows = np.arange(len(places))
    chosen = clear_views(
        catalogue, selection.image, step, places, len(selection.options.cloud_limits_percent)
    ).cumsum(axis=1)[rows, limit]
    wanted = np.minimum(available[rows, limit], needed)
    return {
        "places": len(places),
        "as_many_as_wanted": float((chosen >= wanted).mean()),
        "one_missing": float((chosen == wanted - 1).mean()),
        "more_missing": float((chosen < wanted - 1).mean()),
    }


def clear_views(
    catalogue: ImageCatalogue, rows: IntArray, step: IntArray, places: Array, steps: int
) -> IntArray:
    """Clear views (n, steps) of places by images, by the step of the images."""
    views = np.zeros((len(places), steps), dtype=np.int64)
    tree = shapely.STRtree(shapely.points(places))
    for row in rows:
        near = tree.query(catalogue.footprint[row], predicate="contains")
        hidden = np.zeros(len(near), dtype=np.bool_)
        for cloud in shapely.get_parts(catalogue.mask[row]) if catalogue.mask[row] is not None else ():
            hidden |= shapely.contains_xy(cloud, *places[near].T)
        views[near[~hidden], step[row]] += 1
    return views


def document(
    selection: ImageSelection,
    seconds: dict[str, float],
    memory: dict[str, float],
    again: dict[str, float],
) -> dict[str, Any]:
    """All figures."""
    cells = selection.cells
    area = cells.grid.area_km2(cells.cell)
    steps = range(len(selection.options.cloud_limits_percent))
    return {
        "use": asdict(selection.use),
        "cells": len(cells.cell),
        "area_km2": float(area.sum()),
        "images_by_limit": [int((selection.step == step).sum()) for step in steps],
        "share_by_limit": [float(area[cells.step == step].sum() / area.sum()) for step in steps],
        "share_short": float(area[selection.missing > 0].sum() / area.sum()),
        "short_where_catalogue_has_enough": int(
            (cells.views < np.minimum(cells.available, selection.options.min_views)).sum()
        ),
        "lower_bound": math.ceil(selection.bound.images - 1e-6),
        "above_bound": selection.above_bound,
        "mean_views": float(cells.views.mean()),
        "views_quantiles": {str(q): float(np.quantile(cells.views, q)) for q in (0.5, 0.9, 0.99, 1.0)},
        "mean_seasons": float(cells.seasons[selection.missing == 0].mean()),
        "mean_directions": float(cells.directions[selection.missing == 0].mean()),
        "cpu_s": seconds,
        "memory": memory,
        "counted_again": again,
    }


def show(
    selection: ImageSelection,
    seconds: dict[str, float],
    memory: dict[str, float],
    again: dict[str, float],
) -> None:
    """Print the figures as tables."""
    console, figures = Console(width=120), document(selection, seconds, memory, again)
    limits = Table("cloud below", "chosen images", "ground with this limit", title="By cloud limit")
    for limit, images, share in zip(
        selection.options.cloud_limits_percent,
        figures["images_by_limit"],
        figures["share_by_limit"],
        strict=True,
    ):
        limits.add_row(f"{limit:g} %", f"{images:,}", f"{share:.1%}")
    console.print(limits)
    table = Table("figure", "value", title="Selection")
    quantiles = ", ".join(f"{q}: {v:g}" for q, v in figures["views_quantiles"].items())
    use = figures["use"]
    for name, value in (
        ("images of the catalogue, usable", f"{use['catalogue']:,}, {use['usable']:,}"),
        ("ground", f"{figures['area_km2']:,.0f} km2 in {figures['cells']:,} cells"),
        ("chosen, lower bound", f"{use['selected']:,}, {figures['lower_bound']:,}"),
        ("above the bound", f"{figures['above_bound']:.1%}"),
        ("ground short of 6 views", f"{figures['share_short']:.1%}"),
        ("of it where the catalogue has enough", f"{figures['short_where_catalogue_has_enough']} cells"),
        ("clear views, mean and quantiles", f"{figures['mean_views']:.2f}; {quantiles}"),
        ("seasons, directions", f"{figures['mean_seasons']:.2f}, {figures['mean_directions']:.2f}"),
        ("read the catalogue", f"{seconds['read the catalogue']:.0f} s of CPU time"),
        ("select", f"{seconds['select']:.0f} s of CPU time"),
        ("memory before, peak", f"{memory['before_mib']:,.0f}, {memory['peak_mib']:,.0f} MiB"),
        ("random places with as many views as wanted", f"{again['as_many_as_wanted']:.2%}"),
        ("with one fewer, with more fewer", f"{again['one_missing']:.2%}, {again['more_missing']:.2%}"),
    ):
        table.add_row(name, value)
    console.print(table)


if __name__ == "__main__":
    main()
