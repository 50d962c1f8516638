// A profile of a surface as a chart: heights along a line, with one standard deviation on both sides.

import type { SurfaceHeight } from "./api_types";
import { facts, figure, h } from "./elements";

const WIDTH = 320;
const HEIGHT = 170;
const LEFT = 44;
const BOTTOM = 22;
const TOP = 8;
const SVG = "http://www.w3.org/2000/svg";

interface Known {
  distance_m: number;
  height_m: number;
  sigma_m: number;
}

/** The chart, its figures below; a sentence where the line has no height. */
export function profileChart(heights: SurfaceHeight[]): HTMLElement {
  const runs = runsOf(heights);
  const known = runs.flat();
  const length = heights.at(-1)!.distance_m;
  if (!known.length || length === 0) return h("p", {}, "No height along this line.");
  const low = Math.min(...known.map(({ height_m, sigma_m }) => height_m - sigma_m));
  const high = Math.max(...known.map(({ height_m, sigma_m }) => height_m + sigma_m));
  const x = (distance: number): number => LEFT + (distance / length) * (WIDTH - LEFT - 4);
  const y = (height: number): number => TOP + ((high - height) / Math.max(high - low, 0.1)) * (HEIGHT - TOP - BOTTOM);
  const lowest = Math.min(...known.map(({ height_m }) => height_m));
  const highest = Math.max(...known.map(({ height_m }) => height_m));
  const chart = svg("svg", {
    viewBox: `0 0 ${WIDTH} ${HEIGHT}`,
    class: "profile",
    role: "img",
    "aria-label": `Profile of ${figure(length, "m")}: heights from ${lowest.toFixed(1)} to ${highest.toFixed(1)} m`,
  });
  for (const height of [low, (low + high) / 2, high]) {
    chart.append(
      svg("line", { class: "axis", x1: LEFT, x2: WIDTH - 4, y1: y(height), y2: y(height) }),
      svg("text", { x: LEFT - 4, y: y(height) + 3, "text-anchor": "end" }, height.toFixed(1)),
    );
  }
  for (const [share, anchor] of [[0, "start"], [0.5, "middle"], [1, "end"]] as const) {
    chart.append(svg("text", { x: x(share * length), y: HEIGHT - 6, "text-anchor": anchor }, figure(share * length, "m")));
  }
  for (const run of runs) {
    const above = run.map(({ distance_m, height_m, sigma_m }) => `${x(distance_m)},${y(height_m + sigma_m)}`);
    const below = run.map(({ distance_m, height_m, sigma_m }) => `${x(distance_m)},${y(height_m - sigma_m)}`).reverse();
    chart.append(
      svg("polygon", { class: "sigma", points: [...above, ...below].join(" ") }),
      svg("polyline", { class: "height", points: run.map(({ distance_m, height_m }) => `${x(distance_m)},${y(height_m)}`).join(" ") }),
    );
  }
  const sigmas = known.map(({ sigma_m }) => sigma_m).sort((one, other) => one - other);
  return h(
    "div",
    {},
    h("p", { class: "quiet" }, "Height above the ellipsoid, m; shaded: one sigma on both sides."),
    chart,
    facts({
      Length: figure(length, "m"),
      "Lowest, highest": `${lowest.toFixed(1)} m, ${highest.toFixed(1)} m`,
      "Sigma, median": figure(sigmas[sigmas.length >> 1], "m"),
      "Places with a height": `${known.length} of ${heights.length}`,
    }),
  );
}

/** The parts of a line that have heights. */
function runsOf(heights: SurfaceHeight[]): Known[][] {
  const runs: Known[][] = [];
  let isOpen = false;
  for (const { distance_m, height_m, sigma_m } of heights) {
    if (height_m == null) {
      isOpen = false;
      continue;
    }
    if (!isOpen) runs.push([]);
    isOpen = true;
    runs.at(-1)!.push({ distance_m, height_m, sigma_m: sigma_m ?? 0 });
  }
  return runs;
}

function svg(name: string, attributes: Record<string, string | number>, text = ""): SVGElement {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.textContent = text;
  return element;
}
