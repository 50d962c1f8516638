// The choice of a reference image that the map shows while marks are set.

import type { Position } from "geojson";
import type { Atlas } from "./atlas";
import { BASE, get } from "./api";
import type { Reference, References } from "./api_types";
import type { Bounds } from "./comparison";
import { figure, h } from "./elements";

/** Metres of a pixel of a tile of 256 px at zoom 0 on the equator, and zooms that the service draws below the finest. */
const ZOOM_0_M = 40_075_017 / 256;
const COARSER_ZOOMS = 3;

/** A choice of the references that show some ground, of which the finest is shown at once; null without any. */
export async function referenceChoice(atlas: Atlas, outline: Position[], signal: AbortSignal): Promise<HTMLElement | null> {
  const { references } = await get<References>("references", signal);
  const ground = boundsOf(outline);
  const there = references.filter((one) => meet(boundsOf(corners(one)), ground)).sort((one, other) => one.gsd_m - other.gsd_m);
  if (!there.length) return null;
  const options = there.map(({ name, gsd_m: gsd }) => h("option", { value: name }, `${name}, ${figure(gsd, "m")} pixels`));
  const select = h("select", { id: "reference", onchange: () => show() }, ...options, h("option", { value: "" }, "none"));
  let shown = new AbortController();
  show();
  return h("div", { class: "reference" }, h("label", { for: "reference" }, "Reference image on the map"), select);

  function show(): void {
    shown.abort();
    shown = new AbortController();
    const chosen = there.find(({ name }) => name === select.value);
    if (chosen) void atlas.surface(pyramid(chosen), AbortSignal.any([shown.signal, signal]));
  }
}

function pyramid(reference: Reference): { tiles: string; bounds: Bounds; minzoom: number; maxzoom: number } {
  const bounds = boundsOf(corners(reference));
  const metres = ZOOM_0_M * Math.cos((bounds[1] * Math.PI) / 180);
  const maxzoom = Math.max(Math.ceil(Math.log2(metres / reference.gsd_m)), COARSER_ZOOMS);
  const tiles = `${BASE}references/${encodeURIComponent(reference.name)}/tiles/WebMercatorQuad/{z}/{y}/{x}`;
  // Across the antimeridian MapLibre knows no bounds.
  return { tiles, bounds: bounds[2] - bounds[0] > 180 ? [-180, bounds[1], 180, bounds[3]] : bounds, minzoom: maxzoom - COARSER_ZOOMS, maxzoom };
}

function corners({ footprint }: Reference): Position[] {
  if (footprint?.type === "Polygon") return footprint.coordinates.flat();
  return footprint?.type === "MultiPolygon" ? footprint.coordinates.flat(2) : [];
}

function boundsOf(positions: Position[]): Bounds {
  const [lons, lats] = [positions.map(([lon]) => lon!), positions.map(([, lat]) => lat!)];
  return [Math.min(...lons), Math.min(...lats), Math.max(...lons), Math.max(...lats)];
}

function meet([west, south, east, north]: Bounds, other: Bounds): boolean {
  return west < other[2] && east > other[0] && south < other[3] && north > other[1];
}
