// Residuals of a registration as arrows on the map, exaggerated by a round number, and their legend.

import type { Feature, FeatureCollection, Point, Position } from "geojson";
import type { Atlas } from "./atlas";
import { figure, h } from "./elements";
import { metresPerDegree, roundNumber } from "./ground";

export interface PointResultProperties {
  status: "active" | "deactivated" | "not matched";
  reason: string;
  residual_east_m: number | null;
  residual_north_m: number | null;
}

/** Length of a long residual (the 90 % quantile) on the map: part of the extent of the points, and of the distance between two. */
const LONG_SHARE = 0.08;
const LONG_SPACING = 0.8;
/** Arrows of points that are not used end at this multiple of a long one, so that a wrong match does not cover the map. */
const LONGEST_UNUSED = 2;
/** Part of an arrow that its head takes, and the angle of the head's sides to it. */
const HEAD_SHARE = 0.3;
const HEAD_ANGLE = Math.PI / 7;
const SCALE_PX = 70;

export interface ResidualArrows {
  features: Feature[];
  /** How many times longer the arrows are than the residuals. */
  exaggeration: number;
}

/** Points and arrows; an arrow leads from the true position to where the refined model puts the point of the scene. */
export function residualArrows(points: FeatureCollection<Point, PointResultProperties>): ResidualArrows {
  const measured = points.features.filter(({ properties }) => properties.residual_east_m != null && properties.residual_north_m != null);
  const lengths = measured
    .filter(({ properties }) => properties.status === "active")
    .map(({ properties }) => Math.hypot(properties.residual_east_m!, properties.residual_north_m!))
    .sort((one, other) => one - other);
  const long = lengths[Math.floor(0.9 * (lengths.length - 1))] ?? 0;
  const longOnMapM = lengthOnMapM(points);
  const exaggeration = long > 0 ? roundNumber(longOnMapM / long) : 1;
  const arrows = measured.map(({ geometry, properties }): Feature => {
    const east = exaggeration * properties.residual_east_m!;
    const north = exaggeration * properties.residual_north_m!;
    const length = Math.hypot(east, north);
    const kept = properties.status === "active" || length === 0 ? 1 : Math.min(1, (LONGEST_UNUSED * longOnMapM) / length);
    return { type: "Feature", geometry: { type: "LineString", coordinates: arrow(geometry.coordinates, kept * east, kept * north) }, properties };
  });
  return { features: [...arrows, ...points.features], exaggeration };
}

/** The legend of the arrows: what they are, and one of a round length at the present scale; it is shown until the signal aborts. */
export function showResidualLegend(atlas: Atlas, exaggeration: number, signal: AbortSignal): void {
  const bar = h("span", { class: "arrow", "aria-hidden": "true" });
  const scale = h("span");
  const about = `Residuals, ${figure(exaggeration)} times longer; grey: not used`;
  const legend = h("div", { class: "map-legend", role: "note", "aria-label": "Legend of the arrows" }, h("p", {}, bar, scale), h("p", {}, about));
  atlas.overlay(legend, signal);
  atlas.whileMoving(() => {
    const metresOfPixel = atlas.metresOfPixel() / exaggeration;
    const metres = roundNumber(SCALE_PX * metresOfPixel);
    bar.style.width = `${Math.round(metres / metresOfPixel)}px`;
    scale.textContent = metres < 0.01 ? `${Number((metres * 1000).toPrecision(1))} mm` : figure(metres, "m");
  }, signal);
}

/** A line with a head: to the tip, and from there along both sides of the head. */
function arrow([lon, lat]: Position, east: number, north: number): Position[] {
  const metres = metresPerDegree(lat!);
  const at = (x: number, y: number): Position => [lon! + x / metres.east, lat! + y / metres.north];
  const side = (angle: number): Position => {
    const [cos, sin] = [HEAD_SHARE * Math.cos(angle), HEAD_SHARE * Math.sin(angle)];
    return at(east - cos * east + sin * north, north - sin * east - cos * north);
  };
  const tip = at(east, north);
  return [at(0, 0), tip, side(HEAD_ANGLE), tip, side(-HEAD_ANGLE)];
}

/** Length of a long arrow, metres on the ground: arrows of neighbours stay apart. */
function lengthOnMapM(points: FeatureCollection<Point>): number {
  const lons = points.features.map(({ geometry }) => geometry.coordinates[0]!);
  const lats = points.features.map(({ geometry }) => geometry.coordinates[1]!);
  const [south, north] = [Math.min(...lats), Math.max(...lats)];
  const metres = metresPerDegree((south + north) / 2);
  const [width, height] = [(Math.max(...lons) - Math.min(...lons)) * metres.east, (north - south) * metres.north];
  return Math.min(LONG_SHARE * Math.hypot(width, height), LONG_SPACING * Math.sqrt((width * height) / points.features.length) || Infinity);
}
