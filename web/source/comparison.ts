// Two pictures of the same ground on the map: either of them, or both beside a divider that is moved.

import type { Position } from "geojson";
import type { CustomLayerInterface, Map as MapLibre } from "maplibre-gl";
import { h } from "./elements";
import { colours } from "./style";

export type Bounds = [west: number, south: number, east: number, north: number];
export type Side = "left" | "right";
export type Shown = Side | "swipe";

export interface Pyramid {
  /** Template of the addresses of its tiles. */
  tiles: string;
  bounds: Bounds;
  minzoom: number;
  maxzoom: number;
}

/** A small picture at its place on the ground: its corners from the upper left, clockwise. */
export interface Patch {
  url: string;
  corners: [Position, Position, Position, Position];
}

/** What one side shows: tiles with the edge of their pixels, or patches. */
export interface Picture {
  name: string;
  pyramid?: Pyramid;
  outline?: Position[];
  patches?: Patch[];
}

export const TILE_PX = 256;
const SIDES: Side[] = ["right", "left"];
const STEPS = 1000;
/** Width of the part of the slider that is moved, as in the style sheet. */
const HANDLE_PX = 44;

/** Layers below a layer of the map; left of the divider those of one side, right of it those of the other. */
export class Comparison {
  private shown: Shown = "swipe";
  private opacity = 1;
  private readonly names = { left: h("span"), right: h("span") };
  private readonly slider = h("input", { type: "range", min: 0, max: STEPS, value: STEPS / 2, class: "divider", oninput: () => this.draw() });
  private readonly line = h("div", { class: "divider-line", "aria-hidden": "true" }, this.names.left, this.names.right);
  private readonly layers: Record<Side, string[]> = { left: [], right: [] };
  private readonly resized = new ResizeObserver(() => this.draw());

  constructor(
    private readonly map: MapLibre,
    pictures: Record<Side, Picture>,
    below: string,
  ) {
    for (const side of SIDES) map.addLayer(this.clip(side), below);
    map.addLayer(this.clip(null), below);
    for (const side of SIDES) this.replace(side, pictures[side]);
    map.getContainer().append(this.line, this.slider);
    this.resized.observe(map.getContainer());
  }

  /** Show another picture on one side. */
  replace(side: Side, picture: Picture): void {
    this.clear(side);
    const { name, pyramid, outline, patches = [] } = picture;
    this.names[side].textContent = name;
    this.slider.setAttribute("aria-label", `Divider between ${this.names.left.textContent} on the left and ${this.names.right.textContent} on the right`);
    if (pyramid) {
      this.map.addSource(side, { type: "raster", tileSize: TILE_PX, ...pyramid, tiles: [pyramid.tiles] });
      this.add(side, { id: side, type: "raster", source: side, paint: { "raster-fade-duration": 0 } });
    }
    patches.forEach(({ url, corners }, at) => {
      const id = `${side}-${at}`;
      this.map.addSource(id, { type: "image", url, coordinates: corners as [[number, number], [number, number], [number, number], [number, number]] });
      this.add(side, { id, type: "raster", source: id, paint: { "raster-fade-duration": 0, "raster-resampling": "nearest" } });
    });
    if (outline?.length) {
      const id = `${side}-outline`;
      const coordinates = [...outline, outline[0]!];
      this.map.addSource(id, { type: "geojson", data: { type: "Feature", properties: {}, geometry: { type: "LineString", coordinates } } });
      const colour = colours(matchMedia("(prefers-color-scheme: dark)").matches).scene;
      this.add(side, { id, type: "line", source: id, paint: { "line-color": colour, "line-width": 1.6, "line-dasharray": [3, 2] } });
    }
    this.show(this.shown);
    this.fade(this.opacity);
  }

  /** Show one of the sides, or both with the divider. */
  show(shown: Shown): void {
    this.shown = shown;
    for (const side of SIDES) {
      const visibility = shown === side || shown === "swipe" ? "visible" : "none";
      for (const layer of this.layers[side]) this.map.setLayoutProperty(layer, "visibility", visibility);
    }
    this.slider.hidden = this.line.hidden = shown !== "swipe";
    this.draw();
  }

  /** Set the opacity of both, 0 to 1. */
  fade(opacity: number): void {
    this.opacity = opacity;
    const pictures = SIDES.flatMap((side) => this.layers[side]).filter((layer) => this.map.getLayer(layer)?.type === "raster");
    for (const layer of pictures) this.map.setPaintProperty(layer, "raster-opacity", opacity);
  }

  remove(): void {
    this.resized.disconnect();
    this.slider.remove();
    this.line.remove();
    for (const side of SIDES) this.clear(side);
    for (const side of [...SIDES, null]) this.map.removeLayer(clipName(side));
  }

  private clear(side: Side): void {
    for (const layer of this.layers[side].splice(0)) {
      this.map.removeLayer(layer);
      this.map.removeSource(layer);
    }
  }

  private add(side: Side, layer: Parameters<MapLibre["addLayer"]>[0]): void {
    this.map.addLayer(layer, clipName(side === "right" ? "left" : null));
    this.layers[side].push(layer.id);
  }

  private draw(): void {
    this.line.style.left = `${this.dividerPx()}px`;
    const share = Math.round((100 * this.slider.valueAsNumber) / STEPS);
    this.slider.setAttribute("aria-valuetext", `${share} % ${this.names.left.textContent}`);
    this.map.triggerRepaint();
  }

  /** Where the divider is, from the left of the map. */
  private dividerPx(): number {
    const { clientWidth } = this.map.getContainer();
    return HANDLE_PX / 2 + (this.slider.valueAsNumber / STEPS) * (clientWidth - HANDLE_PX);
  }

  /** A layer that draws nothing: the layers that follow are drawn on one side of the divider only, or everywhere. */
  private clip(side: Side | null): CustomLayerInterface {
    return {
      id: clipName(side),
      type: "custom",
      render: (gl) => {
        if (side === null || this.shown !== "swipe") return gl.disable(gl.SCISSOR_TEST);
        const { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
        const at = Math.round((this.dividerPx() / this.map.getContainer().clientWidth) * width);
        gl.enable(gl.SCISSOR_TEST);
        if (side === "left") gl.scissor(0, 0, at, height);
        else gl.scissor(at, 0, width - at, height);
      },
    };
  }
}

function clipName(side: Side | null): string {
  return `clip-${side ?? "none"}`;
}
