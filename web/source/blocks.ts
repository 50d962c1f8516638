// Blocks: what there is, how good each is, and its publication by an administrator.

import { type BlockFeature, get, type Job, type Page, post } from "./api";
import { badge, facts, figure, fill, h, plural, problem, when } from "./elements";
import { announce, go, type Place, type ShowView } from "./place";
import { send } from "./upload";

const ARCHIVES = ".zip,.tar,.tar.gz,.tgz";

interface Distribution {
  median: number;
  p90: number;
}
interface Quality {
  area_km2: number;
  points_per_km2: number;
  share_reaching_half: number;
  share_reaching_quarter: number;
  images_per_point: Distribution;
  views_per_point: Distribution;
  sigma_horizontal_m: Distribution;
  sigma_up_m: Distribution;
}

export function blocks(signal?: AbortSignal): Promise<Page<BlockFeature>> {
  return get<Page<BlockFeature>>("collections/blocks/items?limit=1000", signal);
}

/** All blocks that the caller may see; an administrator brings others. */
export const showBlocks: ShowView = async (place) => {
  const { panel, atlas, signal, scopes } = place;
  const { features } = await blocks(signal);
  await atlas.show("blocks", features);
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Blocks"),
    h("p", {}, "A block is one production of points, published and withdrawn as a whole."),
    scopes.includes("admin") ? ingestionForm(place) : null,
    features.length === 0 ? h("p", { class: "quiet" }, "There is none yet.") : null,
    h("ul", { class: "list" }, ...features.map(row)),
  );
};

/** One block with its figures; an administrator publishes and withdraws it here. */
export const showBlock: ShowView = async (place, number) => {
  const { panel, atlas, signal, scopes } = place;
  const at = encodeURIComponent(number);
  const [block, quality] = await Promise.all([
    get<BlockFeature>(`collections/blocks/items/${at}`, signal),
    get<Quality>(`blocks/${at}/quality`, signal),
  ]);
  const { properties } = block;
  const published = properties.state === "published";
  const act = h("button", { type: "button", class: published ? "" : "strong", onclick: () => void change() }, published ? "Withdraw" : "Publish");
  const told = h("div");
  fill(
    panel,
    h("p", {}, h("a", { href: "#/blocks" }, "← Blocks")),
    h("h1", { tabindex: -1 }, properties.title || properties.id),
    h("p", {}, badge(properties.state), " ", h("span", { class: "quiet" }, `since ${when(properties.state_changed_at)}`)),
    scopes.includes("admin") ? h("p", {}, act) : null,
    told,
    facts({
      Name: `${properties.id}, version ${properties.version}`,
      Points: figure(properties.n_points),
      Chips: figure(properties.n_views),
      Area: figure(quality.area_km2, "km²"),
      Density: figure(quality.points_per_km2, "points/km²"),
      "Area with 1 point for 2 km²": figure(100 * quality.share_reaching_half, "%"),
      "Area with 1 point for 4 km²": figure(100 * quality.share_reaching_quarter, "%"),
      "Images a point, median": figure(quality.images_per_point.median),
      "Chips a point, median": figure(quality.views_per_point.median),
      "Stated deviation, horizontal, median": figure(quality.sigma_horizontal_m.median, "m"),
      "Stated deviation, height, median": figure(quality.sigma_up_m.median, "m"),
    }),
  );
  atlas.fit(block.geometry);

  async function change(): Promise<void> {
    act.disabled = true;
    try {
      await post(`blocks/${at}/${published ? "withdraw" : "publish"}`);
      announce(`${properties.id} is ${published ? "withdrawn" : "published"}.`);
      await atlas.show("blocks", (await blocks(signal)).features);
      atlas.refresh();
      await showBlock(place, number);
      panel.querySelector("button")?.focus();
    } catch (error) {
      act.disabled = false;
      if (!signal.aborted) told.replaceChildren(problem(error));
    }
  }
};

function ingestionForm({ signal }: Place): HTMLElement {
  const archive = h("input", { type: "file", id: "archive", accept: ARCHIVES, required: true });
  const publish = h("input", { type: "checkbox", id: "publish" });
  const button = h("button", { type: "submit", class: "strong" }, "Upload and check");
  const state = h("div", { class: "upload" });
  const form = h(
    "form",
    { onsubmit: (event) => void submit(event) },
    h("label", { for: "archive" }, "Block", h("span", { class: "quiet" }, " an archive of its folder: zip or tar")),
    archive,
    h("label", { class: "choice" }, publish, " Publish it at once"),
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
      go(`#/job/${(await post<Job>("processes/ingest-block/execution", { inputs })).jobID}`);
    } catch (error) {
      state.replaceChildren(problem(error));
      button.disabled = false;
    }
  }
}

function row({ id, properties: block }: BlockFeature): HTMLElement {
  return h(
    "li",
    {},
    h("a", { href: `#/block/${id}` }, block.title || block.id),
    badge(block.state),
    h("span", { class: "quiet" }, `${block.id}@${block.version} · ${plural(block.n_points, "point")}`),
  );
}
