// The style of the map in light and dark; the density colours are those of the legend.

import type { ExpressionSpecification, GeoJSONSourceSpecification, LayerSpecification, StyleSpecification } from "maplibre-gl";
import { BASE } from "./api";
import { COUNTRIES } from "./go_to";

const TILES = "tiles/WebMercatorQuad/{z}/{y}/{x}";
/** Densities that the specification of a block requires, points per km². */
export const HALF_PER_KM2 = 0.5;
export const QUARTER_PER_KM2 = 0.25;
/** Lowest zoom whose tiles hold single points. */
export const POINTS_ZOOM = 8;
const TILES_ZOOM = 14;
/** From this zoom a cell fills the view and its colour means nothing: points stand for themselves. */
const LAST_DENSITY_ZOOM = 11;
/** Countries smaller than this, in square degrees, have no name on a map of the world. */
const SMALL_DEG2 = 10;
/** Lowest zoom with names of towns, and the smallest towns, by their inhabitants, that have them from a zoom on. */
export const TOWNS_ZOOM = 4;
const TOWNS_FROM: ExpressionSpecification = ["step", ["zoom"], 1_000_000, 5, 300_000, 6, 100_000, 7, 50_000, 8, 0];
const FONT = ["system-ui", "sans-serif"];

/** What colours the points: classes from the best to the worst, as their tiles have the property. */
export const COLOURINGS = {
  none: { label: "one colour", property: "", limits: [], words: [] },
  // Its limits come from the points in view.
  sigma: { label: "horizontal standard deviation", property: "sigma_horizontal_m", limits: [], words: [] },
  views: { label: "number of views", property: "n_views", limits: [3, 5, 8], words: ["8 or more", "5 to 7", "3 or 4", "1 or 2"] },
  health: {
    label: "health in registrations",
    property: "health",
    limits: [0.5, 0.75, 0.95],
    words: ["0.95 or more", "0.75 to 0.95", "0.5 to 0.75", "less than 0.5: proposed for suspension", "not tried yet"],
  },
} as const;
/** The colours of classes, from the best to the worst, by the number of limits between them. */
export const CLASSES: Record<number, number[]> = { 0: [0], 1: [0, 3], 2: [0, 1, 3], 3: [0, 1, 2, 3] };
/** Properties of which more is better. */
const MORE_IS_BETTER: Colouring[] = ["views", "health"];
export type Colouring = keyof typeof COLOURINGS;

const LIGHT = {
  sea: "#d6e2e7",
  land: "#f5f3ee",
  line: "#b9c3c4",
  text: "#3c474c",
  densities: ["#f0d3a3", "#8fc3bd", "#2f8f8b"],
  classes: ["#0b4f5e", "#2f8fb0", "#c07a00", "#a3195b"],
  block: "#0b6477",
  scene: "#8a4b08",
  point: "#0b4f5e",
  halo: "#ffffff",
  active: "#b3261e",
  quiet: "#6b7478",
};
const DARK: typeof LIGHT = {
  sea: "#0f171c",
  land: "#1d272c",
  line: "#3a474d",
  text: "#b4c0c4",
  densities: ["#6d5630", "#2d6b69", "#3fa9a2"],
  classes: ["#d3f2f8", "#5fb8d6", "#e9a63a", "#ff7fb2"],
  block: "#6cc5d9",
  scene: "#e3a35c",
  point: "#a5e0ee",
  halo: "#0f171c",
  active: "#ff8a80",
  quiet: "#8f9ba0",
};

/** Files of land and borders, each from its zoom: Natural Earth at 1:110 million, 50 million and 10 million. */
const LANDS: [zoom: number, file: string][] = [
  [0, "map/land-110m.json"],
  [3, "map/land-50m.json"],
  [6, "map/land-10m.json"],
];

/** The file of land and borders for a zoom. */
export function landFile(zoom: number): string {
  return LANDS.findLast(([from]) => zoom >= from)?.[1] ?? LANDS[0]![1];
}

export function colours(dark: boolean): typeof LIGHT {
  return dark ? DARK : LIGHT;
}

export function mapStyle(dark: boolean, colouring: Colouring, limits: readonly number[] = COLOURINGS[colouring].limits): StyleSpecification {
  const empty = (): GeoJSONSourceSpecification => ({ type: "geojson", data: { type: "FeatureCollection", features: [] } });
  return {
    version: 8,
    transition: { duration: 0, delay: 0 },
    sources: {
      land: { type: "geojson", data: BASE + landFile(0) },
      countries: { type: "geojson", data: BASE + COUNTRIES },
      towns: empty(),
      graticule: empty(),
      target: empty(),
      density: { type: "vector", tiles: [`${BASE}collections/density/${TILES}`], maxzoom: TILES_ZOOM },
      points: {
        type: "vector",
        tiles: [`${BASE}collections/points/${TILES}`],
        minzoom: POINTS_ZOOM,
        maxzoom: TILES_ZOOM,
        promoteId: "id",
      },
      blocks: empty(),
      scenes: empty(),
      vectors: empty(),
      marks: empty(),
    },
    layers: layers(dark, colouring, limits),
  };
}

/** The colour of a point: of its class between limits, or one for all. */
function pointColour(dark: boolean, colouring: Colouring, limits: readonly number[]): string | ExpressionSpecification {
  const { point, classes } = colours(dark);
  const { property } = COLOURINGS[colouring];
  if (!property) return point;
  const bestFirst = CLASSES[limits.length]!.map((at) => classes[at]!);
  const [first, ...rest] = MORE_IS_BETTER.includes(colouring) ? bestFirst.toReversed() : bestFirst;
  const steps = limits.flatMap((limit, at) => [limit, rest[at]!]);
  const classed = (steps.length ? ["step", ["get", property], first!, ...steps] : ["literal", first!]) as ExpressionSpecification;
  return ["case", ["has", property], classed, colours(dark).quiet];
}

function layers(dark: boolean, colouring: Colouring, limits: readonly number[]): LayerSpecification[] {
  const c = colours(dark);
  const [sparse, enough, dense] = c.densities as [string, string, string];
  return [
    { id: "sea", type: "background", paint: { "background-color": c.sea } },
    { id: "land", type: "fill", source: "land", filter: ["==", ["geometry-type"], "Polygon"], paint: { "fill-color": c.land } },
    { id: "lines", type: "line", source: "land", paint: { "line-color": c.line, "line-width": 0.6 } },
    {
      id: "density",
      type: "fill",
      source: "density",
      "source-layer": "density",
      maxzoom: LAST_DENSITY_ZOOM,
      paint: {
        "fill-color": ["step", ["get", "points_per_km2"], sparse, QUARTER_PER_KM2, enough, HALF_PER_KM2, dense],
        "fill-opacity": ["interpolate", ["linear"], ["zoom"], 6, 0.75, 11, 0.25],
        "fill-antialias": false,
      },
    },
    { id: "graticule", type: "line", source: "graticule", paint: { "line-color": c.quiet, "line-opacity": 0.35, "line-width": 0.7 } },
    {
      id: "towns",
      type: "symbol",
      source: "towns",
      filter: [">=", ["get", "population"], TOWNS_FROM],
      layout: {
        "text-field": ["get", "name"],
        "text-font": FONT,
        "text-size": ["step", ["get", "population"], 11, 300_000, 13],
        // Below its place, where a mark of the place leaves it readable.
        "text-anchor": "top",
        "text-offset": [0, 0.8],
        "text-padding": 6,
        "symbol-sort-key": ["-", ["get", "population"]],
      },
      paint: { "text-color": c.text, "text-halo-color": c.land, "text-halo-width": 1.2 },
    },
    {
      id: "countries",
      type: "symbol",
      source: "countries",
      filter: [">=", ["get", "area"], ["step", ["zoom"], SMALL_DEG2, 3, SMALL_DEG2 / 10, 5, 0]],
      layout: {
        "text-field": ["get", "name"],
        "text-font": FONT,
        "text-size": 12,
        "text-padding": 6,
        "symbol-sort-key": ["-", ["get", "area"]],
      },
      paint: { "text-color": c.text, "text-halo-color": c.land, "text-halo-width": 1.2 },
    },
    {
      id: "blocks",
      type: "line",
      source: "blocks",
      paint: {
        "line-color": c.block,
        "line-width": ["case", ["==", ["get", "state"], "published"], 1.6, 1],
        "line-opacity": ["case", ["==", ["get", "state"], "withdrawn"], 0.4, 1],
      },
    },
    { id: "scenes-inside", type: "fill", source: "scenes", paint: { "fill-color": c.scene, "fill-opacity": 0.06 } },
    {
      id: "scenes",
      type: "line",
      source: "scenes",
      paint: { "line-color": c.scene, "line-width": 1.6, "line-dasharray": [3, 2] },
    },
    {
      id: "points",
      type: "circle",
      source: "points",
      "source-layer": "points",
      minzoom: POINTS_ZOOM,
      filter: ["has", "id"],
      paint: {
        "circle-radius": ["interpolate", ["linear"], ["zoom"], 8, 1.2, 12, 3.2, 16, 5.5],
        "circle-color": pointColour(dark, colouring, limits),
        "circle-stroke-color": c.halo,
        "circle-stroke-width": ["interpolate", ["linear"], ["zoom"], 10, 0, 13, 1],
      },
    },
    {
      id: "chosen",
      type: "circle",
      source: "points",
      "source-layer": "points",
      filter: ["==", ["get", "id"], -1],
      paint: { "circle-radius": 11, "circle-color": "transparent", "circle-stroke-color": c.active, "circle-stroke-width": 2.5 },
    },
    {
      id: "vector-areas",
      type: "fill",
      source: "vectors",
      filter: ["in", ["geometry-type"], ["literal", ["Polygon", "MultiPolygon"]]],
      paint: { "fill-color": ["case", ["==", ["get", "status"], "held"], c.scene, c.active], "fill-opacity": 0.12 },
    },
    {
      id: "vectors",
      type: "line",
      source: "vectors",
      filter: ["!", ["in", ["geometry-type"], ["literal", ["Point", "MultiPoint"]]]],
      layout: { "line-cap": "round" },
      paint: { "line-color": ["match", ["get", "status"], "active", c.active, "held", c.scene, c.quiet], "line-width": ["case", ["==", ["get", "status"], "held"], 1, 1.8] },
    },
    {
      id: "vector-points",
      type: "circle",
      source: "vectors",
      filter: ["in", ["geometry-type"], ["literal", ["Point", "MultiPoint"]]],
      paint: {
        "circle-radius": ["case", ["has", "residual_east_m"], 2.2, 3.5],
        "circle-color": ["case", ["==", ["get", "status"], "active"], c.active, c.quiet],
        "circle-stroke-color": c.halo,
        "circle-stroke-width": 1,
      },
    },
    {
      id: "marks",
      type: "circle",
      source: "marks",
      // Hollow, so that what was marked is seen.
      paint: {
        "circle-radius": 7,
        "circle-color": "transparent",
        "circle-stroke-color": ["match", ["get", "colour"], "rejected", c.active, "check", c.block, c.scene],
        "circle-stroke-width": 3,
      },
    },
    {
      id: "mark-names",
      type: "symbol",
      source: "marks",
      layout: { "text-field": ["get", "name"], "text-font": FONT, "text-size": 13, "text-anchor": "bottom-left", "text-offset": [0.5, -0.3], "text-allow-overlap": true },
      paint: { "text-color": c.text, "text-halo-color": c.halo, "text-halo-width": 1.5 },
    },
    {
      id: "target",
      type: "circle",
      source: "target",
      paint: { "circle-radius": 7, "circle-color": "transparent", "circle-stroke-color": c.scene, "circle-stroke-width": 2.5 },
    },
    {
      id: "degrees",
      type: "symbol",
      source: "graticule",
      filter: ["==", ["geometry-type"], "Point"],
      layout: { "text-field": ["get", "label"], "text-font": FONT, "text-size": 11, "text-anchor": ["get", "anchor"] },
      paint: { "text-color": c.text, "text-halo-color": c.halo, "text-halo-width": 1.5 },
    },
  ];
}
