// Shapes that are drawn on a raw image, in pixels from the upper left corner of its first pixel.

import type { Feature, FeatureCollection, Geometry, Position } from "geojson";

export type Kind = "Point" | "LineString" | "Polygon";
export type Pixel = [x: number, y: number];

export interface Shape {
  kind: Kind;
  name: string;
  vertices: Pixel[];
}

/** Fewest vertices of each kind of shape, and what people call it. */
export const KINDS: Record<Kind, { fewest: number; word: string }> = {
  Point: { fewest: 1, word: "Point" },
  LineString: { fewest: 2, word: "Line" },
  Polygon: { fewest: 3, word: "Polygon" },
};

/** Shapes as GeoJSON in pixels, each with its name. */
export function collection(shapes: Shape[]): FeatureCollection {
  const features = shapes.map(({ kind, name, vertices }): Feature => ({ type: "Feature", properties: { name }, geometry: geometry(kind, vertices) }));
  return { type: "FeatureCollection", features };
}

function geometry(kind: Kind, vertices: Pixel[]): Geometry {
  if (kind === "Point") return { type: kind, coordinates: vertices[0]! };
  if (kind === "LineString") return { type: kind, coordinates: vertices };
  return { type: kind, coordinates: [[...vertices, vertices[0]!]] };
}

/** The paths of a geometry: points have one vertex, rings end where they begin. */
export function paths(geometry: Geometry | null): Position[][] {
  switch (geometry?.type) {
    case "Point":
      return [[geometry.coordinates]];
    case "MultiPoint":
      return geometry.coordinates.map((position) => [position]);
    case "LineString":
      return [geometry.coordinates];
    case "MultiLineString":
    case "Polygon":
      return geometry.coordinates;
    case "MultiPolygon":
      return geometry.coordinates.flat();
    default:
      return [];
  }
}
