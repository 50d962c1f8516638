// Residuals of a registration as vectors on the map, exaggerated by a round number.

import type { Feature, FeatureCollection, Point } from "geojson";

export interface PointResultProperties {
  status: "active" | "deactivated" | "not matched";
  reason: string;
  residual_east_m: number | null;
  residual_north_m: number | null;
}

const METRES_PER_DEGREE = 111_320;
/** Length of a long residual (the 90 % quantile) on the map, as a part of the extent of the points. */
const LONG_SHARE = 0.08;

/**
 * Points and vectors; a vector leads from the true position to where the refined model puts the point of the scene.
 *
 * @returns the features, and the factor by which the vectors are longer than the residuals.
 */
export function residualVectors(points: FeatureCollection<Point, PointResultProperties>): { features: Feature[]; exaggeration: number } {
  const withResiduals = points.features.filter(({ properties }) => properties.residual_east_m != null && properties.residual_north_m != null);
  const lengths = withResiduals
    .filter(({ properties }) => properties.status === "active")
    .map(({ properties }) => Math.hypot(properties.residual_east_m!, properties.residual_north_m!))
    .sort((one, other) => one - other);
  const long = lengths[Math.floor(0.9 * (lengths.length - 1))] ?? 0;
  const exaggeration = long > 0 ? roundNumber((LONG_SHARE * diagonalM(points)) / long) : 1;
  const lines = withResiduals.map(({ geometry, properties }): Feature => {
    const [lon, lat] = geometry.coordinates as [number, number];
    const north = (exaggeration * properties.residual_north_m!) / METRES_PER_DEGREE;
    const east = (exaggeration * properties.residual_east_m!) / (METRES_PER_DEGREE * Math.cos((lat * Math.PI) / 180));
    return { type: "Feature", geometry: { type: "LineString", coordinates: [[lon, lat], [lon + east, lat + north]] }, properties };
  });
  return { features: [...lines, ...points.features], exaggeration };
}

/** The diagonal of the box around the points, metres. */
function diagonalM(points: FeatureCollection<Point>): number {
  const lons = points.features.map(({ geometry }) => geometry.coordinates[0]!);
  const lats = points.features.map(({ geometry }) => geometry.coordinates[1]!);
  const [south, north] = [Math.min(...lats), Math.max(...lats)];
  const width = (Math.max(...lons) - Math.min(...lons)) * Math.cos((south * Math.PI) / 180);
  return Math.hypot(width, north - south) * METRES_PER_DEGREE;
}

/** 1, 2 or 5 times a power of ten, not above the value. */
function roundNumber(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  const digit = value / power;
  return (digit >= 5 ? 5 : digit >= 2 ? 2 : 1) * power;
}
