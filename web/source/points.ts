// Points: those in view of the map, and one point with its chips.

import { blobUrl, type FeaturePage, get, type PointOfPage } from "./api";
import type { PointViewProperties, PointWithViews } from "./api_types";
import { facts, figure, fill, h, plural, problem } from "./elements";
import type { Atlas } from "./atlas";
import { CLASSES, type Colouring, COLOURINGS } from "./style";
import type { ShowView } from "./view";

const LISTED = 50;
const SETTLED_MS = 250;
/** Points in view that classes of their accuracy are made of. */
const SAMPLED = 1000;
/** Accuracies that differ by less are of one class. */
const ALIKE = 1.05;

/** Shows the number of points in view of the map, and a list of the first. */
export const showPoints: ShowView = async ({ panel, atlas, signal }) => {
  const list = h("ul", { class: "list", "aria-label": "Points in view" });
  const count = h("p", { class: "count" }, "…");
  const nothing = h("p", { class: "quiet", hidden: true }, "Move the map to the outline of a block, or choose one of the ", h("a", { href: "#/blocks" }, "blocks"), ".");
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Control points"),
    h("p", {}, "Ground positions in three dimensions, each with image chips. Select one on the map or in the list."),
    h("p", { class: "legend-title" }, "Density of the points, when seen from afar"),
    legend(),
    colouringField(atlas, signal),
    h("h2", {}, "In view"),
    count,
    nothing,
    list,
  );
  let moves = 0;
  atlas.whileMoving(() => {
    const move = ++moves;
    const stays = () => move === moves && !signal.aborted;
    setTimeout(() => stays() && void refresh(stays), move === 1 ? 0 : SETTLED_MS);
  }, signal);

  /** List the points in view, if the map stays there until they arrive. */
  async function refresh(stays: () => boolean): Promise<void> {
    try {
      const page = await get<FeaturePage<PointOfPage>>(`collections/points/items?bbox=${atlas.bounds().join(",")}&limit=${LISTED}`, signal);
      if (!stays()) return;
      const total = page.numberMatched;
      count.textContent = total > page.features.length ? `${plural(total, "point")}, the first ${page.features.length}:` : plural(total, "point");
      replaceRows(list, page.features.map(row));
      nothing.hidden = total > 0;
    } catch (error) {
      if (stays()) count.replaceChildren(problem(error));
    }
  }
};

/** Shows one point: position, accuracy, chips. */
export const showPoint: ShowView = async ({ panel, atlas, signal }, id) => {
  const point = await get<PointWithViews>(`collections/points/items/${encodeURIComponent(id)}`, signal);
  const [lon, lat, height] = point.geometry.coordinates;
  const { properties } = point;
  const { relative_to_control_points: relative, on_the_earth: earth } = properties;
  const chips = h("ul", { class: "chips", "aria-label": "Chips" });
  fill(
    panel,
    h("p", {}, h("a", { href: "#/points" }, "← Points")),
    h("h1", { tabindex: -1 }, `Point ${id}`),
    facts({
      Latitude: `${lat?.toFixed(7)}°`,
      Longitude: `${lon?.toFixed(7)}°`,
      "Height above the ellipsoid": `${height?.toFixed(2)} m`,
      "Height of the surface":
        properties.surface_height_m != null &&
        `${properties.surface_height_m.toFixed(2)} ± ${figure(properties.surface_sigma_m, "m")}`,
      "Standard deviation east, north, up": [properties.sigma_east_m, properties.sigma_north_m, properties.sigma_up_m]
        .map((sigma) => figure(sigma))
        .join(", ")
        .concat("\u00a0m"),
      [relative.label]: relative.words,
      [earth.label]: earth.words,
      Saliency: figure(properties.saliency),
      Block: properties.block,
    }),
    h("h2", {}, plural(properties.views.length, "chip")),
    chips,
  );
  atlas.fit(point.geometry, 13);
  signal.addEventListener("abort", () => void atlas.choose(null));
  await atlas.choose(Number(id));
  await Promise.all(properties.views.map((view, number) => show(chips, id, view, number, signal)));
};

async function show(chips: HTMLElement, id: string, view: PointViewProperties, number: number, signal: AbortSignal): Promise<void> {
  const caption = [view.image_id, figure(view.gsd_m, "m"), view.acquired_at?.slice(0, 10)].filter(Boolean).join(" · ");
  const image = h("img", { alt: `Chip ${number}: ${caption}`, width: 101, height: 101 });
  chips.append(h("li", {}, h("figure", {}, image, h("figcaption", {}, caption))));
  try {
    image.src = await blobUrl(`collections/points/items/${encodeURIComponent(id)}/chips/${number}?f=png`, signal);
  } catch (error) {
    if (!signal.aborted) image.replaceWith(problem(error));
  }
}

/** Replace the rows of a list; the link that has the focus keeps it, or the first has it where that one is gone. */
function replaceRows(list: HTMLElement, rows: HTMLElement[]): void {
  const focused = list.contains(document.activeElement) && document.activeElement?.getAttribute("href");
  list.replaceChildren(...rows);
  if (!focused) return;
  const links = [...list.querySelectorAll("a")];
  (links.find((link) => link.getAttribute("href") === focused) ?? links[0])?.focus({ preventScroll: true });
}

function row(point: PointOfPage): HTMLElement {
  const [lon, lat] = point.geometry?.type === "Point" ? point.geometry.coordinates : [];
  return h(
    "li",
    {},
    h("a", { href: `#/point/${point.id}` }, String(point.id)),
    h("span", { class: "quiet" }, `${lat?.toFixed(4)}°, ${lon?.toFixed(4)}°`),
  );
}

function legend(): HTMLElement {
  const names = ["fewer than 1 for 4 km²", "1 for 4 km² or more", "1 for 2 km² or more"];
  const row = (name: string, step: number) => h("li", {}, h("span", { class: `swatch density-${step}`, "aria-hidden": "true" }), name);
  return h("ul", { class: "legend", "aria-label": "Colours of the density" }, ...names.map(row));
}

/** The choice of what colours the points, with the legend of the classes. */
function colouringField(atlas: Atlas, signal: AbortSignal): HTMLElement {
  const classes = h("ul", { class: "legend", "aria-label": "Colours of the points" });
  const select = h(
    "select",
    { id: "colouring", onchange: () => void choose(select.value as Colouring) },
    ...Object.entries(COLOURINGS).map(([name, { label }]) => h("option", { value: name, selected: name === atlas.pointColouring }, label)),
  );
  const choose = async (colouring: Colouring): Promise<void> => {
    try {
      if (colouring === "sigma") atlas.colourPoints(colouring, limitsOf(await sigmas(atlas, signal)));
      else atlas.colourPoints(colouring);
      explain(colouring);
    } catch (error) {
      if (!signal.aborted) fill(classes, h("li", {}, problem(error)));
    }
  };
  const explain = (colouring: Colouring): void => {
    const words = colouring === "sigma" ? sigmaWords(atlas.pointLimits) : COLOURINGS[colouring].words;
    const colours = words.length > 4 ? [0, 1, 2, 3, 4] : CLASSES[words.length - 1];
    classes.hidden = words.length === 0;
    fill(classes, ...words.map((name, at) => h("li", {}, h("span", { class: `swatch class-${colours![at]}`, "aria-hidden": "true" }), name)));
  };
  explain(atlas.pointColouring);
  return h("div", { class: "colouring" }, h("label", { for: "colouring" }, "Points coloured by"), select, classes);
}

/** Horizontal standard deviations of points in view, metres, in ascending order. */
async function sigmas(atlas: Atlas, signal: AbortSignal): Promise<number[]> {
  const query = new URLSearchParams({ bbox: atlas.bounds().join(","), limit: String(SAMPLED), properties: "sigma_east_m,sigma_north_m" });
  const { features } = await get<FeaturePage<PointOfPage>>(`collections/points/items?${query}`, signal);
  return features.map(({ properties }) => Math.hypot(properties.sigma_east_m, properties.sigma_north_m) / Math.SQRT2).sort((one, other) => one - other);
}

/** Limits between quarters of some values in ascending order, with two digits; fewer where quarters are equal. */
function limitsOf(values: number[]): number[] {
  if (!values.length || values.at(-1)! < ALIKE * values[0]!) return [];
  const quarters = [0.25, 0.5, 0.75].map((share) => Number((values[Math.floor(share * values.length)] ?? 0).toPrecision(2)));
  return [...new Set(quarters)].filter((limit) => limit > values[0]! && limit <= values.at(-1)!);
}

function sigmaWords(limits: readonly number[]): string[] {
  const words = limits.map((limit) => figure(limit, "m"));
  if (!words.length) return ["all points in view have about the same"];
  return [`less than ${words[0]}`, ...words.slice(1).map((word, at) => `${words[at]} to ${word}`), `${words.at(-1)} or more`];
}
