// The two places of a mark as text: what their fields show, and what is refused of the places that are typed.

import type { Position } from "geojson";
import type { InImage, OnGround } from "./marks";

/** From the centre of the first pixel to its edge. */
const HALF_PX = 0.5;
const MARGIN_DEG = 1;

interface Size {
  lines: number;
  samples: number;
}

/** A typed place in an image, unless it lies outside. */
export function shown(image: InImage, size: Size): InImage {
  if (beyond(image, size) > 0) throw new Error(`Place in the image: line ${image.line}, sample ${image.sample} found; the image has ${size.lines} lines and ${size.samples} samples.`);
  return image;
}

/** How far a place lies beyond an image, pixels. */
export function beyond({ line, sample }: InImage, { lines, samples }: Size): number {
  return Math.max(-line - HALF_PX, line - lines + HALF_PX, -sample - HALF_PX, sample - samples + HALF_PX, 0);
}

/** A typed place on the ground, unless it lies in an outline with longitude and latitude exchanged alone. */
export function inOrder(ground: OnGround, outline: Position[]): OnGround {
  const [lons, lats] = [outline.map((place) => place[0]!), outline.map((place) => place[1]!)];
  const within = (lon: number, lat: number): boolean =>
    lon > Math.min(...lons) - MARGIN_DEG && lon < Math.max(...lons) + MARGIN_DEG && lat > Math.min(...lats) - MARGIN_DEG && lat < Math.max(...lats) + MARGIN_DEG;
  if (outline.length && !within(ground.lon, ground.lat) && within(ground.lat, ground.lon)) {
    throw new Error("Place on the ground: longitude and latitude are exchanged; longitude comes first.");
  }
  return ground;
}

export function imageText(image: InImage | null): string {
  return image ? `${round(image.line, 3)}, ${round(image.sample, 3)}` : "";
}

export function groundText(ground: OnGround | null): string {
  if (!ground) return "";
  const height = ground.height_m == null ? "" : `, ${round(ground.height_m, 3)}`;
  return `${round(ground.lon, 8)}, ${round(ground.lat, 8)}${height}`;
}

function round(value: number, decimals: number): number {
  return Number(value.toFixed(decimals));
}
