// A job: its progress while it runs, its error if it failed, its report if it was successful.

import type { Feature, FeatureCollection, Point, Polygon, Position } from "geojson";
import { blobUrl, call, get } from "./api";
import type { Atlas } from "./atlas";
import { drawBlocks } from "./blocks";
import type { ResultFile, StatusInfo } from "./api_types";
import { accuracy, badge, facts, figure, fill, h, problem, when } from "./elements";
import { announce, markSection, pause } from "./page";
import { ended, find, stateText } from "./processes";
import type { Criterion, Report } from "./report_types";
import { imageOnMap } from "./image_on_map";
import { type PointResultProperties, residualVectors } from "./residuals";
import { surfaceOnMap } from "./surface";
import type { Place, ShowView } from "./view";

const POLL_MS = 1000;

type Results = Record<string, ResultFile>;

/** Shows the progress of a job until it ends, then its results. */
export const showJob: ShowView = async (place, id) => {
  const { panel, signal } = place;
  const heading = h("h1", { tabindex: -1 }, "Job");
  const body = h("div");
  const back = h("a", { href: "#/scenes" }, "← Scenes");
  fill(panel, h("p", {}, back), heading, body);
  let job = await find(id, signal);
  if (job.processID.endsWith("-block")) {
    back.href = "#/blocks";
    back.textContent = "← Blocks";
    markSection("blocks");
  }
  heading.textContent = job.processID.replace("-", " ").replace(/^./, (first) => first.toUpperCase());
  const running = progressOf(job);
  if (!ended(job)) fill(body, running.element);
  while (!ended(job)) {
    running.update(job);
    await pause(POLL_MS, signal);
    job = await find(id, signal);
  }
  announce(`The job is ${job.status}.`);
  if (job.status === "successful") await showResults(place, job, heading, body);
  else fill(body, outcome(job), await failureReport(job, signal));
};

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

/** A link to the report of a registration that failed, where the job has one. */
async function failureReport(job: StatusInfo, signal: AbortSignal): Promise<HTMLElement | null> {
  const page = job.links.find(({ title }) => title === "report.html");
  if (!page) return null;
  const link = h("a", { class: "button strong", target: "_blank", href: await blobUrl(page.href, signal) }, "Open the report");
  return h("p", {}, link, " ", h("span", { class: "quiet" }, "what was tried, and what to try next"));
}

async function showResults(place: Place, job: StatusInfo, heading: HTMLElement, body: HTMLElement): Promise<void> {
  const { atlas, signal } = place;
  const results = await get<Results>(`jobs/${job.jobID}/results`, signal);
  const reportFile = results["report.json"];
  const pointsFile = results["control_points.geojson"];
  if (!reportFile || !pointsFile) {
    fill(body, outcome(job), surfaceOnMap(place, job, results), assessment(results), blockLink(results), await downloads(results, signal));
    if (blockLink(results)) await showIngested(atlas, results, signal);
    return;
  }
  const [report, points] = await Promise.all([
    get<Report>(reportFile.href, signal),
    get<FeatureCollection<Point, PointResultProperties>>(pointsFile.href, signal),
  ]);
  const ring = report.scene.footprint_lon_lat as Position[];
  const footprint: Polygon = { type: "Polygon", coordinates: [[...ring, ring[0]!]] };
  const { features, exaggeration } = residualVectors(points);
  const held: Feature = { type: "Feature", properties: { status: "held" }, geometry: { type: "MultiPolygon", coordinates: (report.coverage.polygons_lon_lat ?? []) as Position[][][] } };
  heading.textContent = report.scene.name;
  fill(body, ...summary(report, exaggeration), drawingLink(job), imageOnMap(place, job, report), ...criteria(report), await downloads(results, signal));
  signal.addEventListener("abort", () => void atlas.show("vectors", []));
  await Promise.all([atlas.show("scenes", [{ type: "Feature", properties: {}, geometry: footprint }]), atlas.show("vectors", [held, ...features])]);
  atlas.fit(footprint, 17);
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

function summary(report: Report, exaggeration: number): (HTMLElement | null)[] {
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
    h("p", { class: "legend-line" }, h("span", { class: "swatch vector", "aria-hidden": "true" }), `Residuals on the map, drawn ${figure(exaggeration)} times longer; grey: not used.`),
    h("p", { class: "quiet" }, `Accuracy is stated for the shaded part of the map, ${figure(report.coverage.percent, "%")} of the image, which the points hold.`),
  ];
}

function criteria({ criteria }: Report): HTMLElement[] {
  return [
    h("h2", {}, "Criteria"),
    h(
      "table",
      {},
      h("thead", {}, h("tr", {}, ...["Criterion", "Value", "Limit", "Met"].map((name) => h("th", { scope: "col" }, name)))),
      h("tbody", {}, ...criteria.map(criterion)),
    ),
  ];
}

function criterion({ label, value, comparison, limit, unit, needed_for, met, calculation }: Criterion): HTMLElement {
  return h(
    "tr",
    { title: calculation },
    h("th", { scope: "row" }, label),
    h("td", {}, figure(value, unit)),
    h("td", {}, `${comparison} ${figure(limit, unit)}`),
    h("td", { class: met ? "" : "missed" }, met ? "yes" : `no, not ${needed_for}`),
  );
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
