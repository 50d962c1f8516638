// A job: its progress while it runs, its error if it failed, its report if it was successful.

import type { Feature, FeatureCollection, Geometry, Point, Polygon, Position } from "geojson";
import { blobUrl, call, get } from "./api";
import type { Atlas } from "./atlas";
import { drawBlocks } from "./blocks";
import type { ResultFile, Scene, StatusInfo } from "./api_types";
import { accuracy, badge, facts, figure, fill, h, problem, when } from "./elements";
import { announce, markSection, pause } from "./page";
import { outlineOf } from "./pictures";
import { ended, find, stateText } from "./processes";
import type { Criterion, Report } from "./report_types";
import { imageOnMap } from "./image_on_map";
import { type PointResultProperties, residualArrows, showResidualLegend } from "./residuals";
import { outlines } from "./scenes";
import { surfaceOnMap } from "./surface";
import type { Place, ShowView } from "./view";

const POLL_MS = 1000;
/** Scenes of a job that failed whose places are read. */
const MOST_SCENES = 30;

type Results = Record<string, ResultFile>;

/** Shows the progress of a job until it ends, then its results. */
export const showJob: ShowView = async (place, id) => {
  const { panel, signal } = place;
  const heading = h("h1", { tabindex: -1 }, "Job");
  const body = h("div");
  const back = h("a", { href: "#/scenes" }, "← Scenes");
  const about = h("p", { class: "quiet" });
  fill(panel, h("p", { class: "state" }, back), heading, about, body);
  let job = await find(id, signal);
  if (job.processID.endsWith("-block")) {
    back.href = "#/blocks";
    back.textContent = "← Blocks";
    markSection("blocks");
  }
  const process = job.processID.replaceAll("-", " ").replace(/^./, (first) => first.toUpperCase());
  const names = job["amers:sceneNames"] ?? [];
  const scenes = job.links.filter(({ title }) => title === "scene").map(({ href }) => href.split("/").at(-1)!);
  heading.textContent = names.length > 2 ? `${names[0]} and ${names.length - 1} more scenes` : names.join(", ") || process;
  about.textContent = `${process} · ${when(job.created)}`;
  if (names.length === scenes.length) scenes.forEach((scene, at) => back.after(h("a", { href: `#/scene/${scene}` }, `Scene ${names[at]}`)));
  const running = progressOf(job);
  if (!ended(job)) fill(body, running.element);
  while (!ended(job)) {
    running.update(job);
    await pause(POLL_MS, signal);
    job = await find(id, signal);
  }
  announce(`The job is ${job.status}.`);
  if (job.status === "successful") await showResults(place, job, body);
  else {
    fill(body, outcome(job), await failureReport(job, signal), nextStep(scenes));
    place.atlas.fit(await groundOf(job, scenes, signal));
  }
};

/** What is known of the ground of the scenes of a job without a result: by its report, else by earlier registrations. */
async function groundOf(job: StatusInfo, scenes: string[], signal: AbortSignal): Promise<FeatureCollection> {
  const file = job.links.find(({ title }) => title === "report.json");
  // Scenes and files may have been removed meanwhile: the map stays where it is then.
  const report = file ? await get<Partial<Report>>(file.href, signal).catch(() => null) : null;
  const ring = report?.scene?.footprint_lon_lat as Position[] | undefined;
  if (ring?.length) return { type: "FeatureCollection", features: [{ type: "Feature", properties: {}, geometry: { type: "Polygon", coordinates: [ring] } }] };
  const known = await Promise.all(scenes.slice(0, MOST_SCENES).map((id) => get<Scene>(`scenes/${id}`, signal).catch(() => null)));
  return { type: "FeatureCollection", features: outlines(known.filter((scene) => scene !== null)) };
}

function progressOf(first: StatusInfo): { element: HTMLElement; update(job: StatusInfo): void } {
  const bar = h("progress", { max: 100, "aria-label": "Progress of the job" });
  const words = h("p", {});
  const stop = h("button", { type: "button", onclick: () => void dismiss() }, "Stop");
  return {
    element: h("div", { class: "upload" }, words, bar, stop),
    update(job) {
      bar.value = job.progress;
      words.textContent = stateText(job);
    },
  };

  async function dismiss(): Promise<void> {
    stop.disabled = true;
    try {
      await call(`jobs/${first.jobID}`, { method: "DELETE" });
    } catch (error) {
      stop.replaceWith(problem(error));
    }
  }
}

function outcome(job: StatusInfo): HTMLElement {
  return h(
    "div",
    {},
    h("p", {}, badge(job.status), " ", h("span", { class: "quiet" }, when(job.finished))),
    job.error ? problem(`${job.error.title}: ${job.error.detail}`) : h("p", {}, job.message),
  );
}

/** Where a job that made no result is begun again: at its scene. */
function nextStep([scene, more]: string[]): HTMLElement | null {
  if (!scene || more) return null;
  return h("p", {}, h("a", { class: "button", href: `#/scene/${scene}` }, "Go to the scene"), " ", h("span", { class: "quiet" }, "to register it again, with marks or other options"));
}

/** A link to the report of a registration that failed, where the job has one. */
async function failureReport(job: StatusInfo, signal: AbortSignal): Promise<HTMLElement | null> {
  const page = job.links.find(({ title }) => title === "report.html");
  if (!page) return null;
  const link = h("a", { class: "button strong", target: "_blank", href: await blobUrl(page.href, signal) }, "Open the report");
  return h("p", {}, link, " ", h("span", { class: "quiet" }, "what was tried, and what to try next"));
}

async function showResults(place: Place, job: StatusInfo, body: HTMLElement): Promise<void> {
  const { atlas, signal } = place;
  const results = await get<Results>(`jobs/${job.jobID}/results`, signal);
  const reportFile = results["report.json"];
  const pointsFile = results["control_points.geojson"];
  if (!reportFile || !pointsFile) {
    fill(body, outcome(job), surfaceOnMap(place, job, results), assessment(results), blockLink(results), await downloads(results, signal));
    if (blockLink(results)) await showIngested(atlas, results, signal);
    return;
  }
  const [report, points, outline] = await Promise.all([
    get<Report>(reportFile.href, signal),
    get<FeatureCollection<Point, PointResultProperties>>(pointsFile.href, signal),
    outlineOf(job, signal).catch(() => null),
  ]);
  const onMap = await showRegistration(place, report, points, outline);
  fill(
    body,
    ...summary(report),
    drawingLink(job),
    imageOnMap(place, { job, report, points, ...onMap }),
    ...criteria(report),
    await downloads(results, signal),
  );
}

/** Draw the outline if it is known, the points and their residuals; what draws the points over an image, or leaves them out. */
async function showRegistration(
  { atlas, signal }: Place,
  report: Report,
  points: FeatureCollection<Point, PointResultProperties>,
  outline: Polygon | null,
): Promise<{ overImage: (withPoints: boolean) => void }> {
  // Over all heights of the ground: larger than the image where the ground has relief.
  const footprint: Polygon = { type: "Polygon", coordinates: [report.scene.footprint_lon_lat as Position[]] };
  const { features, exaggeration } = residualArrows(points);
  const areas = (report.coverage.polygons_lon_lat ?? []) as Position[][][];
  const held = (geometry: Geometry): Feature => ({ type: "Feature", properties: { status: "held" }, geometry });
  const edges = held({ type: "MultiLineString", coordinates: areas.flat() });
  let legend = new AbortController();
  const showLegend = (): void => showResidualLegend(atlas, exaggeration, AbortSignal.any([legend.signal, signal]));
  signal.addEventListener("abort", () => void atlas.show("vectors", []));
  void atlas.hidePoints(signal);
  showLegend();
  await Promise.all([
    atlas.show("scenes", outline ? [{ type: "Feature", properties: {}, geometry: outline }] : []),
    atlas.show("vectors", [held({ type: "MultiPolygon", coordinates: areas }), ...features]),
  ]);
  atlas.fit(outline ?? footprint);
  return {
    // The image has outlines of its own, and is not shaded.
    overImage(withPoints) {
      legend.abort();
      legend = new AbortController();
      if (withPoints) showLegend();
      void Promise.all([atlas.show("scenes", []), atlas.show("vectors", withPoints ? [edges, ...features] : [])]);
    },
  };
}

/** Draw a block that was ingested, and bring it into view. */
async function showIngested(atlas: Atlas, { number }: Record<string, unknown>, signal: AbortSignal): Promise<void> {
  const { features } = await drawBlocks(atlas, signal);
  atlas.refresh();
  atlas.fit(features.find(({ id }) => id === number)?.geometry);
}

/** What the assessment of a block found, in words. */
function assessment({ specification, words }: Record<string, unknown>): HTMLElement | null {
  if (typeof specification !== "string") return null;
  return h("p", {}, h("b", {}, `Specification: ${specification}. `), String(words));
}

/** A link to the image of a scene that is registered, to draw on it. */
function drawingLink({ jobID, processID }: StatusInfo): HTMLElement | null {
  if (processID !== "register-scene") return null;
  return h("p", {}, h("a", { class: "button", href: `#/draw/${jobID}` }, "Draw on the image"));
}

/** A link to the block that a job has ingested. */
function blockLink({ number }: Record<string, unknown>): HTMLElement | null {
  if (typeof number !== "number") return null;
  return h("p", {}, h("a", { class: "button strong", href: `#/block/${number}` }, "See the block"));
}

function summary(report: Report): (HTMLElement | null)[] {
  const { point_counts: counts, image_residuals_px: px, ground_residuals_m: ground, predicted } = report;
  return [
    h("p", {}, badge(report.verdict), ` Verdict: ${[report.verdict, report.verdict_scope].filter(Boolean).join(", ")}`),
    accuracy(report),
    h("p", {}, report.verdict_explanation),
    h("p", { class: "quiet" }, report.correction.words.join("; ")),
    facts({
      "Points visible, matched, active": `${figure(counts.visible)}, ${figure(counts.matched)}, ${figure(counts.active)}`,
      "Residual in the image, rms": `${figure(px.xy.rms, "px")} (x ${figure(px.x.rms)}, y ${figure(px.y.rms)})`,
      "Residual on the ground, rms": figure(ground.horizontal.rms, "m"),
      "Predicted CE90 relative to the control points, worst place": figure(predicted.worst_px, "px"),
    }),
    h("p", { class: "quiet" }, `Accuracy is stated for the shaded part of the map (on the image: inside the thin line), ${figure(report.coverage.percent, "%")} of the image, which the points support.`),
  ];
}

function criteria({ criteria }: Report): HTMLElement[] {
  const names = [...new Set(criteria.map(({ name }) => name))];
  const rows = names.map((name) => criterion(criteria.filter((one) => one.name === name)));
  const heads = ["Criterion", "Value", "Good", "Usable"].map((name) => h("th", { scope: "col" }, name));
  const table = h("table", { class: "criteria" }, h("thead", {}, h("tr", {}, ...heads)), h("tbody", {}, ...rows));
  return [h("h2", {}, "Criteria"), h("div", { class: "wide", role: "region", "aria-label": "Criteria", tabindex: 0 }, table)];
}

/** A criterion with the limits of both verdicts; it is one thing that is measured, for some at two levels. */
function criterion(levels: Criterion[]): HTMLElement {
  const strictest = levels.find(({ needed_for }) => needed_for === "good") ?? levels[0]!;
  const values = [...new Set(levels.map((one) => decimals(one.value, one)))];
  return h(
    "tr",
    { title: strictest.calculation },
    h("th", { scope: "row" }, strictest.label),
    h("td", {}, values.join(" · ")),
    limit(levels.find(({ needed_for }) => needed_for === "good")),
    limit(levels.find(({ needed_for }) => needed_for === "usable")),
  );
}

/** The limit of a level, and whether it is met; a dash where the level has none. */
function limit(level: Criterion | undefined): HTMLElement {
  if (!level) return h("td", { class: "quiet" }, "–");
  const bound = `${level.comparison === "at least" ? "≥" : "≤"} ${decimals(level.limit, level)}`;
  return h("td", { class: level.met ? "met" : "missed" }, `${bound} `, h("span", {}, level.met ? "met" : "missed"));
}

/** A value of a criterion with as many decimals as its unit deserves. */
function decimals(value: number | null, { decimals: digits, unit }: Criterion): string {
  if (value == null) return "–";
  const text = value.toFixed(digits);
  return unit ? `${text}\u00a0${unit}` : text;
}

/** Links to the files of the results. The page fetches them, because a plain link cannot send the token. */
async function downloads(results: Results, signal: AbortSignal): Promise<HTMLElement> {
  const files = Object.values(results).filter((result) => typeof result === "object" && result?.href);
  const page = files.find(({ title }) => title === "report.html" || title === "block_quality.html");
  const open = page ? h("p", {}, h("a", { class: "button strong", target: "_blank", href: await blobUrl(page.href, signal) }, "Open the report")) : null;
  const rows = files.map((file) => {
    const link = h("a", { href: "#", role: "button", onclick: (event) => void save(event, file, link) }, file.title);
    return h("li", {}, link, h("span", { class: "quiet" }, file.type));
  });
  return h("div", {}, open, files.length ? h("h2", {}, "Files") : null, h("ul", { class: "list" }, ...rows));

  async function save(event: Event, file: ResultFile, link: HTMLElement): Promise<void> {
    event.preventDefault();
    try {
      h("a", { href: await blobUrl(file.href, signal), download: file.title }).click();
    } catch (error) {
      link.replaceWith(problem(error));
    }
  }
}
