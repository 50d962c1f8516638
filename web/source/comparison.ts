// One scene on the map through two models: either of them, or both beside a divider that is moved.

import type { CustomLayerInterface, Map as MapLibre } from "maplibre-gl";
import { h } from "./elements";

export type Bounds = [west: number, south: number, east: number, north: number];
export type Model = "raw" | "registered";
export type Shown = Model | "swipe";

export interface Pyramid {
  /** Template of the addresses of its tiles. */
  tiles: string;
  bounds: Bounds;
  minzoom: number;
  maxzoom: number;
}
export type Pyramids = Record<Model, Pyramid>;

export const TILE_PX = 256;
const STEPS = 1000;
/** Width of the part of the slider that is moved, as in the style sheet. */
const HANDLE_PX = 44;

/** Raster layers below a layer of the map; left of the divider the raw one, right of it the registered one. */
export class Comparison {
  private shown: Shown = "swipe";
  private readonly slider = h("input", {
    type: "range",
    min: 0,
    max: STEPS,
    value: STEPS / 2,
    class: "divider",
    "aria-label": "Divider between the raw image on the left and the registered image on the right",
    oninput: () => this.draw(),
  });
  private readonly line = h("div", { class: "divider-line", "aria-hidden": "true" }, h("span", {}, "Raw"), h("span", {}, "Registered"));
  private readonly layers: string[] = [];
  private readonly resized = new ResizeObserver(() => this.draw());

  constructor(
    private readonly map: MapLibre,
    pyramids: Pyramids,
    below: string,
  ) {
    for (const model of ["registered", "raw"] as const) {
      map.addSource(model, { type: "raster", tileSize: TILE_PX, ...pyramids[model], tiles: [pyramids[model].tiles] });
      this.add(this.clip(model), below);
      this.layers.push(model);
      map.addLayer({ id: model, type: "raster", source: model, paint: { "raster-fade-duration": 0 } }, below);
    }
    this.add(this.clip(null), below);
    map.getContainer().append(this.line, this.slider);
    this.resized.observe(map.getContainer());
    this.show("swipe");
  }

  /** Show one of the models, or both with the divider. */
  show(shown: Shown): void {
    this.shown = shown;
    for (const model of ["raw", "registered"] as const) {
      this.map.setLayoutProperty(model, "visibility", shown === model || shown === "swipe" ? "visible" : "none");
    }
    this.slider.hidden = this.line.hidden = shown !== "swipe";
    this.draw();
  }

  /** Set the opacity of both, 0 to 1. */
  fade(opacity: number): void {
    for (const model of ["raw", "registered"]) this.map.setPaintProperty(model, "raster-opacity", opacity);
  }

  remove(): void {
    this.resized.disconnect();
    this.slider.remove();
    this.line.remove();
    for (const layer of this.layers) this.map.removeLayer(layer);
    for (const model of ["raw", "registered"]) this.map.removeSource(model);
  }

  private draw(): void {
    this.line.style.left = `${this.dividerPx()}px`;
    this.slider.setAttribute("aria-valuetext", `${Math.round((100 * this.slider.valueAsNumber) / STEPS)} % raw`);
    this.map.triggerRepaint();
  }

  /** Where the divider is, from the left of the map. */
  private dividerPx(): number {
    const { clientWidth } = this.map.getContainer();
    return HANDLE_PX / 2 + (this.slider.valueAsNumber / STEPS) * (clientWidth - HANDLE_PX);
  }

  private add(layer: CustomLayerInterface, below: string): void {
    this.layers.push(layer.id);
    this.map.addLayer(layer, below);
  }

  /** A layer that draws nothing: the layers that follow are drawn on one side of the divider only, or everywhere. */
  private clip(model: Model | null): CustomLayerInterface {
    return {
      id: `clip-${model ?? "none"}`,
      type: "custom",
      render: (gl) => {
        if (model === null || this.shown !== "swipe") return gl.disable(gl.SCISSOR_TEST);
        const { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
        const at = Math.round((this.dividerPx() / this.map.getContainer().clientWidth) * width);
        gl.enable(gl.SCISSOR_TEST);
        if (model === "raw") gl.scissor(0, 0, at, height);
        else gl.scissor(at, 0, width - at, height);
      },
    };
  }
}
