// The part of a registration's page that shows the image on the map, before and after.

import { BASE } from "./api";
import type { StatusInfo } from "./api_types";
import type { Bounds, Comparison, Model, Pyramid, Shown } from "./comparison";
import { accuracy, figure, fill, h, problem } from "./elements";
import { announce } from "./page";
import { drawn, stateText } from "./processes";
import type { Report } from "./report_types";
import type { Place } from "./view";

const PROCESS = "map-scene";
const CHOICES: Record<Shown, string> = { swipe: "Both, with a divider", raw: "Raw", registered: "Registered" };
const CLOSEST_ZOOM = 16;

interface Limits {
  zoom: number;
}
interface Mapped {
  /** From the finest zoom to the coarsest. */
  tile_limits: Limits[];
  bounds: Bounds;
  heights: string;
}

/** A button that draws the image of a registered scene on the map, and then the choice of what is seen. */
export function imageOnMap({ atlas, signal }: Place, registration: StatusInfo, report: Report): HTMLElement | null {
  const { scene, model } = registration.inputs;
  if (registration.processID !== "register-scene") return null;
  const state = h("div", { role: "status" });
  const button = h("button", { type: "button", onclick: () => void open() }, "Show the image on the map");
  const section = h("section", { "aria-label": "Image on the map" }, h("h2", {}, "Image on the map"), h("p", {}, button), state);
  // The third word of the address asks for the image at once.
  if (location.hash.endsWith("/map")) void open();
  return section;

  async function open(): Promise<void> {
    button.disabled = true;
    try {
      const inputs = { scene, registration: registration.jobID, model: model ?? null };
      const { job, results } = await drawn(PROCESS, inputs, signal, (job) => fill(state, h("p", { class: "quiet" }, stateText(job))));
      const mapped = results as unknown as Mapped;
      const comparison = await atlas.compare({ raw: pyramid(job, "raw", mapped), registered: pyramid(job, "registered", mapped) }, signal);
      if (signal.aborted) return;
      if (!comparison) throw new Error("The map cannot be shown in this browser.");
      const [west, south, east, north] = mapped.bounds;
      atlas.fit({ type: "MultiPoint", coordinates: [[west, south], [east, north]] }, CLOSEST_ZOOM);
      fill(section, h("h2", {}, "Image on the map"), ...controls(comparison), ...words(report, mapped));
      section.querySelector("input")?.focus();
      announce("The image is on the map.");
    } catch (error) {
      if (signal.aborted) return;
      fill(state, problem(error));
      button.disabled = false;
    }
  }
}

function pyramid({ jobID }: StatusInfo, model: Model, { tile_limits: limits, bounds: [west, south, east, north] }: Mapped): Pyramid {
  return {
    tiles: `${BASE}jobs/${jobID}/map/${model}/tiles/WebMercatorQuad/{z}/{y}/{x}`,
    // Across the antimeridian MapLibre knows no bounds.
    bounds: east > 180 ? [-180, south, 180, north] : [west, south, east, north],
    minzoom: limits.at(-1)!.zoom,
    maxzoom: limits[0]!.zoom,
  };
}

function controls(comparison: Comparison): HTMLElement[] {
  const choices = (Object.keys(CHOICES) as Shown[]).map((shown) => {
    const input = h("input", { type: "radio", name: "shown", id: `shown-${shown}`, checked: shown === "swipe", onchange: () => comparison.show(shown) });
    return h("div", { class: "choice" }, input, h("label", { for: input.id }, CHOICES[shown]));
  });
  const opacity = h("input", { type: "range", id: "opacity", min: 0, max: 100, value: 100, oninput: () => comparison.fade(opacity.valueAsNumber / 100) });
  return [
    h("fieldset", {}, h("legend", {}, "Model"), ...choices),
    h("label", { for: "opacity" }, "Opacity"),
    opacity,
  ];
}

/** What the pictures show: the size of the correction and the accuracy that is left. */
function words({ correction, ...stated }: Report, { heights }: Mapped): (HTMLElement | null)[] {
  return [
    h("p", {}, `The registration moved the middle of the image by ${figure(correction.shift_m, "m")} on the ground. What it predicts of the registered image:`),
    accuracy(stated),
    h("p", { class: "quiet" }, `Heights of the ground: ${heights}.`),
  ];
}
