// Blocks: the list, the quality of each, and ingestion and publication by administrators.

import { type Block, type FeaturePage, get, post, remove } from "./api";
import type { BlockQuality, StatusInfo } from "./api_types";
import type { Atlas } from "./atlas";
import { ask } from "./confirmation";
import { accuracy, badge, day, facts, figure, fill, h, plural, problem, when } from "./elements";
import { listing, type Order } from "./listing";
import { announce, go } from "./page";
import { place as placeName } from "./places";
import { send } from "./upload";
import type { Place, ShowView } from "./view";

const ARCHIVES = ".zip,.tar,.tar.gz,.tgz";

/** The blocks that the caller may see. */
function blocks(signal?: AbortSignal): Promise<FeaturePage<Block>> {
  return get<FeaturePage<Block>>("collections/blocks/items?limit=1000", signal);
}

/** Draw the outlines of the blocks on the map as they are now; the page of blocks that was drawn. */
export async function drawBlocks(atlas: Atlas, signal?: AbortSignal): Promise<FeaturePage<Block>> {
  const page = await blocks(signal);
  await atlas.show("blocks", page.features);
  return page;
}

/** Shows the blocks that the caller may see, and administrators a form to add one. */
export const showBlocks: ShowView = async (place) => {
  const { panel, atlas, signal, scopes } = place;
  const { features, numberMatched } = await drawBlocks(atlas, signal);
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Blocks"),
    h("p", {}, "A block is one production of points. It is published and withdrawn as a whole."),
    scopes.includes("admin") ? ingestionForm(place) : null,
    features.length < numberMatched ? h("p", { class: "quiet" }, `The first ${features.length} of ${figure(numberMatched)} blocks.`) : null,
    listing({ what: "block", rows: features, orders: ORDERS, element: row, empty: h("p", { class: "quiet" }, ...emptyWords(scopes)) }),
  );
};

const ORDERS: Record<string, Order<Block>> = {
  "newest first": ({ properties }) => -Date.parse(properties.created_at),
  name: ({ properties }) => properties.title || properties.id,
  "most points": ({ properties }) => -properties.n_points,
  state: ({ properties }) => properties.state,
};

/** What to do where there is no block. */
function emptyWords(scopes: string[]): (string | HTMLElement)[] {
  if (!scopes.includes("admin")) return ["No published blocks yet. An administrator adds one; until then scenes are registered on reference images or on marks."];
  return ["No blocks yet. Add an archive above, or make one for any region: ", h("code", {}, "amers base make"), ", then ", h("code", {}, "amers block ingest FOLDER --publish"), "."];
}

/** Shows one block with its quality; administrators publish and withdraw it here. */
export const showBlock: ShowView = async (place, number) => {
  const { panel, atlas, signal, scopes } = place;
  const at = encodeURIComponent(number);
  const [block, quality] = await Promise.all([
    get<Block>(`collections/blocks/items/${at}`, signal),
    get<BlockQuality>(`blocks/${at}/quality`, signal),
  ]);
  const { properties } = block;
  const published = properties.state === "published";
  const act = h("button", { type: "button", class: published ? "" : "strong", onclick: () => void change() }, published ? "Withdraw" : "Publish");
  const name = `${properties.id}@${properties.version}`;
  const erase = h("button", { type: "button", onclick: () => void removeForGood() }, "Delete");
  const message = h("div");
  fill(
    panel,
    h("p", {}, h("a", { href: "#/blocks" }, "← Blocks")),
    h("h1", { tabindex: -1 }, properties.title || properties.id),
    h("p", {}, badge(properties.state), " ", h("span", { class: "quiet" }, `since ${when(properties.state_changed_at)}`)),
    scopes.includes("admin") ? h("p", { class: "state" }, act, published ? null : erase) : null,
    scopes.includes("admin") ? assessmentForm(number) : null,
    message,
    accuracy(quality),
    facts({
      Name: `${properties.id}, version ${properties.version}`,
      Attribution: properties.attribution,
      Points: figure(properties.n_points),
      Chips: figure(properties.n_views),
      Area: figure(quality.area_km2, "km²"),
      Density: figure(quality.points_per_km2, "points/km²"),
      "Area with at least 1 point for 2 km²": figure(100 * quality.share_reaching_half, "%"),
      "Area with at least 1 point for 4 km²": figure(100 * quality.share_reaching_quarter, "%"),
      "Images per point, median": figure(quality.images_per_point.median),
      "Chips per point, median": figure(quality.views_per_point.median),
      "Standard deviation, horizontal, median": figure(quality.sigma_horizontal_m.median, "m"),
      "Standard deviation, height, median": figure(quality.sigma_up_m.median, "m"),
    }),
  );
  await drawBlocks(atlas, signal);
  atlas.fit(block.geometry);

  async function change(): Promise<void> {
    if (published && !(await withdrawalConfirmed(block))) return;
    act.disabled = true;
    try {
      await post(`blocks/${at}/${published ? "withdraw" : "publish"}`);
      announce(`${properties.id} is ${published ? "withdrawn" : "published"}.`);
      atlas.refresh();
      await showBlock(place, number);
      panel.querySelector("button")?.focus();
    } catch (error) {
      act.disabled = false;
      if (!signal.aborted) message.replaceChildren(problem(error));
    }
  }

  async function removeForGood(): Promise<void> {
    const text = `Its ${plural(properties.n_points, "point")} and their histories are deleted, its chips go into the trash. This cannot be undone.`;
    const field = { label: `To confirm, type ${name}`, mustBe: name };
    if ((await ask({ title: `Delete ${name}?`, text, act: "Delete", field })) === null) return;
    erase.disabled = act.disabled = true;
    try {
      await remove(`blocks/${encodeURIComponent(name)}`);
      announce(`${name} is deleted.`);
      go("#/blocks");
    } catch (error) {
      erase.disabled = act.disabled = false;
      if (!signal.aborted) message.replaceChildren(problem(error));
    }
  }
};

/** Whether an administrator really wants points not to be served any more. */
async function withdrawalConfirmed({ properties: { id, version, n_points, n_unserved } }: Block): Promise<boolean> {
  const served = plural(n_points - n_unserved, "point");
  const text = `Registrations and readers will no longer find its ${served}. The block can be published again.`;
  return (await ask({ title: `Withdraw ${id}@${version}?`, text, act: "Withdraw the block" })) !== null;
}

function ingestionForm({ signal }: Place): HTMLElement {
  const archive = h("input", { type: "file", id: "archive", accept: ARCHIVES, required: true });
  const publish = h("input", { type: "checkbox", id: "publish" });
  const button = h("button", { type: "submit", class: "strong" }, "Upload and ingest");
  const state = h("div", { class: "upload" });
  const form = h(
    "form",
    { onsubmit: (event) => void submit(event) },
    h("label", { for: "archive" }, "Block", h("span", { class: "quiet" }, " an archive of its folder, zip or tar")),
    archive,
    h("label", { class: "choice" }, publish, " Publish it after ingestion"),
    button,
    state,
  );
  return h("details", { class: "card" }, h("summary", {}, "Add a block"), form);

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    const [file] = archive.files ?? [];
    if (!file) return;
    button.disabled = true;
    try {
      const { upload } = await send(file, { purpose: "block" }, state, signal);
      const inputs = { upload, publish: publish.checked };
      go(`#/job/${(await post<StatusInfo>("processes/ingest-block/execution", { inputs })).jobID}`);
    } catch (error) {
      state.replaceChildren(problem(error));
      button.disabled = false;
    }
  }
}

/** A form that starts a job: the quality of a block against files on the server. */
function assessmentForm(number: string): HTMLElement {
  const field = (id: string, type = "text") => h("input", { id, type, ...(type === "number" ? { min: "0", step: "any" } : {}) });
  const sites = field("sites");
  const controlSites = field("control-sites");
  const dem = field("dem");
  const vertical = field("vertical");
  const density = field("density", "number");
  const ce90 = field("ce90", "number");
  const le90 = field("le90", "number");
  const button = h("button", { type: "submit", class: "strong" }, "Assess");
  const state = h("div");
  const form = h(
    "form",
    { onsubmit: (event) => void submit(event) },
    h("p", { class: "quiet" }, "Files lie below the reference folder of the server. No file is required; figures without their file are left out."),
    ...labelled(sites, "Reference ortho-images", "for checks only; names, separated by commas"),
    ...labelled(controlSites, "Ortho-images used as control", "reported separately"),
    ...labelled(dem, "Height model", "GeoTIFF"),
    ...labelled(vertical, "Its vertical datum", "ellipsoid, EGM96, EPSG:…"),
    ...labelled(density, "Required density", "points per km²; by default that of the block"),
    ...labelled(ce90, "Required CE90", "metres, on the Earth"),
    ...labelled(le90, "Required LE90", "metres, on the Earth"),
    button,
    state,
  );
  return h("details", { class: "card" }, h("summary", {}, "Assess its quality"), form);

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    button.disabled = true;
    const amount = (input: HTMLInputElement) => (input.value ? Number(input.value) : null);
    const inputs = {
      block: number,
      sites: names(sites.value),
      control_sites: names(controlSites.value),
      dem: dem.value.trim() || null,
      vertical: vertical.value.trim() || null,
      required: { points_per_km2: amount(density), ce90_m: amount(ce90), le90_m: amount(le90) },
    };
    try {
      go(`#/job/${(await post<StatusInfo>("processes/assess-block/execution", { inputs })).jobID}`);
    } catch (error) {
      state.replaceChildren(problem(error));
      button.disabled = false;
    }
  }
}

function labelled(input: HTMLInputElement, label: string, hint: string): HTMLElement[] {
  return [h("label", { for: input.id }, label, h("span", { class: "quiet" }, ` ${hint}`)), input];
}

function names(text: string): string[] {
  return text.split(",").map((name) => name.trim()).filter(Boolean);
}

function row({ id, geometry, properties: block }: Block): HTMLElement {
  const area = placeName(geometry);
  return h(
    "li",
    {},
    h("a", { href: `#/block/${id}` }, block.title || block.id),
    badge(block.state),
    h("span", { class: "quiet" }, `${block.id}@${block.version} · ${plural(block.n_points, "point")} · ${day(block.created_at)}`, area ? " · " : null, area),
  );
}
