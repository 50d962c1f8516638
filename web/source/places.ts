// Where something lies, in words: the nearest town that the map names.

import type { Feature, FeatureCollection, Geometry, Point, Position } from "geojson";
import { get } from "./api";
import { h } from "./elements";
import { degrees } from "./graticule";
import { TOWNS } from "./go_to";
import { metresPerDegree } from "./ground";
import { boundsOf, positionsIn } from "./pictures";

type Town = Feature<Point, { name: string; population: number }>;

/** Towns farther away say nothing about a place. */
const NEAR_M = 60_000;
let towns: Promise<Town[]> | undefined;

/** An element that names the place of an outline: its coordinates, and the nearest town once the towns have arrived. */
export function place(footprint: Geometry | null): HTMLElement | null {
  const positions = positionsIn(footprint);
  if (!positions.length) return null;
  const [west, south, east, north] = boundsOf(positions);
  const middle: Position = [(west + east) / 2, (south + north) / 2];
  const element = h("span", {}, `${degrees(middle[1]!, "N", "S", 2)} ${degrees(middle[0]!, "E", "W", 2)}`);
  towns ??= get<FeatureCollection & { features: Town[] }>(TOWNS).then(({ features }) => features, () => []);
  void towns.then((all) => {
    const name = nearest(all, middle);
    if (name) element.textContent = `near ${name}`;
  });
  return element;
}

function nearest(all: Town[], [lon, lat]: Position): string | undefined {
  const metres = metresPerDegree(lat!);
  let [name, least]: [string | undefined, number] = [undefined, NEAR_M];
  for (const { geometry, properties } of all) {
    const [x, y] = geometry.coordinates as [number, number];
    const away = Math.hypot(((((x - lon!) % 360) + 540) % 360 - 180) * metres.east, (y - lat!) * metres.north);
    if (away < least) [name, least] = [properties.name, away];
  }
  return name;
}
