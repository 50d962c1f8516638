// A control point that is taken as the ground of a mark: its place with sigmas, and its chip.

import { blobUrl, get } from "./api";
import type { PointWithViews } from "./api_types";
import { fill, h, problem } from "./elements";
import type { OnGround } from "./marks";

/** The ground of a control point, with its sigmas. */
export async function pointOnGround(point: number, signal: AbortSignal): Promise<OnGround> {
  const { geometry, properties } = await get<PointWithViews>(`collections/points/items/${point}`, signal);
  const [lon, lat, height_m] = geometry.coordinates as [number, number, number];
  const { sigma_east_m: east, sigma_north_m: north, sigma_up_m: up } = properties;
  return { lon, lat, height_m, sigma_m: [Math.max(east!, north!), up!], point };
}

/** The chip of a control point, as a help to find the same place in the image. */
export class PointChip {
  readonly element = h("div", { class: "chip" });
  private shown: number | undefined;

  constructor(private readonly signal: AbortSignal) {}

  async show(point: number | undefined): Promise<void> {
    if (point === this.shown) return;
    this.shown = point;
    fill(this.element);
    if (point === undefined) return;
    try {
      const src = await blobUrl(`collections/points/items/${point}/chips/0?f=png`, this.signal);
      const image = h("img", { src, alt: `Chip of control point ${point}`, width: 101, height: 101 });
      const caption = h("figcaption", {}, `Control point ${point}: the place is the middle of its chip, north is up.`);
      if (point === this.shown) fill(this.element, h("figure", {}, image, caption));
    } catch (error) {
      if (!this.signal.aborted && point === this.shown) fill(this.element, problem(error));
    }
  }
}
