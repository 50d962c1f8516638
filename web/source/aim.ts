// Aiming at places of the map with the keys: a crosshair in its middle, below which the map moves.

import type { Map as MapLibre } from "maplibre-gl";
import { h } from "./elements";

const STEP_PX = 24;
const FINE_STEP_PX = 1;

/** Until the signal aborts, arrows move the map (with Shift by a pixel), plus and minus zoom, Enter and space pick. */
export function aimWithKeys(map: MapLibre, label: string, signal: AbortSignal, pick: () => void): void {
  const canvas = map.getCanvas();
  const former = canvas.getAttribute("aria-label") ?? "";
  const cross = h("div", { class: "aim", "aria-hidden": "true" });
  map.getContainer().append(cross);
  map.keyboard.disable();
  canvas.setAttribute("aria-label", label);
  map.getContainer().classList.add("aiming");
  canvas.addEventListener(
    "keydown",
    (event) => {
      const step = event.shiftKey ? FINE_STEP_PX : STEP_PX;
      const ways: Record<string, [number, number]> = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
      const way = ways[event.key];
      if (way) map.panBy(way, { animate: false });
      else if (["+", "="].includes(event.key)) map.zoomTo(map.getZoom() + 1, { animate: false });
      else if (event.key === "-") map.zoomTo(map.getZoom() - 1, { animate: false });
      else if (["Enter", " "].includes(event.key)) pick();
      else return;
      event.preventDefault();
    },
    { signal },
  );
  signal.addEventListener("abort", () => {
    cross.remove();
    map.keyboard.enable();
    canvas.setAttribute("aria-label", former);
    map.getContainer().classList.remove("aiming");
  });
}
