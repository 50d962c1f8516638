// The graticule: meridians and parallels in view, each with its degrees at the lower or left edge of the map.

import type { Feature, Geometry } from "geojson";

const STEPS_DEG = [30, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001];
const MOST_LINES = 8;
const HIGHEST_DEG = 85;

interface View {
  west: number;
  south: number;
  east: number;
  north: number;
  /** Where the labels are: longitude of those of parallels, which end below `top`, and latitude of those of meridians. */
  labels: { longitude: number; latitude: number; top: number };
}

/** Lines of a view and points with their labels. */
export function graticule({ west, south, east, north, labels }: View): Feature[] {
  const end = Math.min(east, west + 360);
  const step = STEPS_DEG.findLast((step) => (end - west) / step <= MOST_LINES) ?? STEPS_DEG[0]!;
  const decimals = Math.max(0, Math.ceil(-Math.log10(step)));
  const [low, high] = [Math.max(south, -HIGHEST_DEG), Math.min(north, HIGHEST_DEG)];
  const meridians = multiples(west, end, step).flatMap((longitude) => [
    feature({ type: "LineString", coordinates: [[longitude, low], [longitude, high]] }),
    feature({ type: "Point", coordinates: [longitude, labels.latitude] }, degrees(wrapped(longitude), "E", "W", decimals), "bottom"),
  ]);
  const parallels = multiples(low, high, step).flatMap((latitude) => [
    feature({ type: "LineString", coordinates: [[west, latitude], [end, latitude]] }),
    ...(latitude < labels.top
      ? [feature({ type: "Point", coordinates: [labels.longitude, latitude] }, degrees(latitude, "N", "S", decimals), "left")]
      : []),
  ]);
  return [...meridians, ...parallels];
}

/** An angle with the letter of its sign; 0 and 180 degrees have none. */
export function degrees(angle: number, positive: string, negative: string, decimals: number): string {
  const size = Math.abs(angle).toFixed(decimals);
  const letter = Number(size) % 180 === 0 ? "" : ` ${angle < 0 ? negative : positive}`;
  return `${size}°${letter}`;
}

/** A longitude from -180 to 180 degrees. */
export function wrapped(longitude: number): number {
  return ((((longitude + 180) % 360) + 360) % 360) - 180;
}

function multiples(from: number, to: number, step: number): number[] {
  const [first, last] = [Math.ceil(from / step), Math.floor(to / step)];
  return Array.from({ length: Math.max(last - first + 1, 0) }, (_, at) => (first + at) * step);
}

function feature(geometry: Geometry, label?: string, anchor?: string): Feature {
  return { type: "Feature", properties: { label, anchor }, geometry };
}
