// The style of the map in light and dark; the density colours are those of the legend.

import type { GeoJSONSourceSpecification, LayerSpecification, StyleSpecification } from "maplibre-gl";
import { BASE } from "./api";

const TILES = "tiles/WebMercatorQuad/{z}/{y}/{x}";
/** Densities that the specification of a block requires, points per km². */
export const HALF_PER_KM2 = 0.5;
export const QUARTER_PER_KM2 = 0.25;
/** Lowest zoom whose tiles hold single points. */
export const POINTS_ZOOM = 8;
const TILES_ZOOM = 14;

const LIGHT = {
  sea: "#d6e2e7",
  land: "#f5f3ee",
  line: "#b9c3c4",
  densities: ["#f0d3a3", "#8fc3bd", "#2f8f8b"],
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
  densities: ["#6d5630", "#2d6b69", "#3fa9a2"],
  block: "#6cc5d9",
  scene: "#e3a35c",
  point: "#a5e0ee",
  halo: "#0f171c",
  active: "#ff8a80",
  quiet: "#8f9ba0",
};

export function colours(dark: boolean): typeof LIGHT {
  return dark ? DARK : LIGHT;
}

export function mapStyle(dark: boolean): StyleSpecification {
  const empty = (): GeoJSONSourceSpecification => ({ type: "geojson", data: { type: "FeatureCollection", features: [] } });
  return {
    version: 8,
    sources: {
      land: { type: "geojson", data: `${BASE}map/land.json` },
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
    },
    layers: layers(dark),
  };
}

function layers(dark: boolean): LayerSpecification[] {
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
      paint: {
        "fill-color": ["step", ["get", "points_per_km2"], sparse, QUARTER_PER_KM2, enough, HALF_PER_KM2, dense],
        "fill-opacity": ["interpolate", ["linear"], ["zoom"], 6, 0.75, 11, 0.25],
        "fill-antialias": false,
      },
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
        "circle-color": c.point,
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
      paint: { "fill-color": c.active, "fill-opacity": 0.12 },
    },
    {
      id: "vectors",
      type: "line",
      source: "vectors",
      filter: ["!", ["in", ["geometry-type"], ["literal", ["Point", "MultiPoint"]]]],
      layout: { "line-cap": "round" },
      paint: { "line-color": ["case", ["==", ["get", "status"], "active"], c.active, c.quiet], "line-width": 1.8 },
    },
    {
      id: "vector-points",
      type: "circle",
      source: "vectors",
      filter: ["in", ["geometry-type"], ["literal", ["Point", "MultiPoint"]]],
      paint: {
        "circle-radius": ["case", ["==", ["get", "status"], "active"], 3.5, 2.5],
        "circle-color": ["case", ["==", ["get", "status"], "active"], c.active, c.quiet],
        "circle-stroke-color": c.halo,
        "circle-stroke-width": 1,
      },
    },
  ];
}
