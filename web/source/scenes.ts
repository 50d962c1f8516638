// Scenes: one's own, and the way of a new one from a file to its registration.

import type { Feature } from "geojson";
import { get, type Job, post, type Scene } from "./api";
import { badge, bytes, facts, figure, fill, h, plural, problem, when } from "./elements";
import { go, type Place, type ShowView } from "./place";
import { send, uploadModel } from "./upload";

const IMAGES = ".tif,.tiff,.jp2,.j2k,.ntf,.nitf,.zip,.tar";
const MODELS = ".txt,.xml,.rpb,.rpc";

/** The caller's scenes and jobs, and the form for another scene. */
export const showScenes: ShowView = async (place) => {
  const { panel, atlas, signal, scopes } = place;
  if (!scopes.includes("register")) {
    fill(
    panel,
      h("h1", { tabindex: -1 }, "Scenes"),
      h("p", {}, "Scenes are registered by those who may: ", h("a", { href: "#/access" }, "sign in"), " with a token of scope ", h("code", {}, "register"), "."),
    );
    return;
  }
  const [{ scenes }, { jobs }] = await Promise.all([
    get<{ scenes: Scene[] }>("scenes?limit=200", signal),
    get<{ jobs: Job[] }>("jobs?limit=20", signal),
  ]);
  await atlas.show("scenes", outlines(scenes));
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Scenes"),
    uploadForm(place),
    h("h2", {}, "Jobs"),
    jobs.length ? h("ul", { class: "list" }, ...jobs.map(jobRow)) : h("p", { class: "quiet" }, "None yet."),
    h("h2", {}, "My scenes"),
    scenes.length ? h("ul", { class: "list" }, ...scenes.map(sceneRow)) : h("p", { class: "quiet" }, "None yet."),
  );
};

/** One scene: its files, and its registration once more. */
export const showScene: ShowView = async ({ panel, atlas, signal }, id) => {
  const scene = await get<Scene>(`scenes/${encodeURIComponent(id)}`, signal);
  await atlas.show("scenes", outlines([scene]));
  atlas.fit(scene.footprint);
  const told = h("div");
  const again = h("button", { type: "button", class: "strong", onclick: () => void start() }, "Register");
  fill(
    panel,
    h("p", {}, h("a", { href: "#/scenes" }, "← Scenes")),
    h("h1", { tabindex: -1 }, scene.name),
    facts({
      State: badge(scene.state),
      Image: `${scene.file}, ${bytes(scene.size_bytes)}`,
      Models: scene.models.join(", "),
      "Accuracy of its model": scene.sigma_m == null ? "unknown" : figure(scene.sigma_m, "m"),
      Uploaded: when(scene.created),
    }),
    scene.removed ? h("p", { class: "quiet" }, `Its files were removed on ${when(scene.removed)}.`) : h("p", {}, again),
    told,
  );

  async function start(): Promise<void> {
    again.disabled = true;
    try {
      go(`#/job/${await register(scene.id)}`);
    } catch (error) {
      again.disabled = false;
      told.replaceChildren(problem(error));
    }
  }
};

/** Outlines of scenes for the map. */
export function outlines(scenes: Scene[]): Feature[] {
  return scenes
    .filter(({ footprint, removed }) => footprint && !removed)
    .map(({ id, name, footprint }) => ({ type: "Feature", geometry: footprint!, properties: { id, name } }));
}

function uploadForm({ signal }: Place): HTMLElement {
  const image = h("input", { type: "file", id: "image", accept: IMAGES, required: true });
  const models = h("input", { type: "file", id: "models", accept: MODELS, multiple: true });
  const sigma = h("input", { type: "number", id: "sigma", min: 0.01, step: "any", inputmode: "decimal", placeholder: "unknown" });
  const button = h("button", { type: "submit", class: "strong" }, "Upload and register");
  const state = h("div", { class: "upload" });
  const form = h(
    "form",
    { onsubmit: (event) => void submit(event) },
    h("label", { for: "image" }, "Image", h("span", { class: "quiet" }, " GeoTIFF, JPEG 2000, NITF, or an archive")),
    image,
    h("label", { for: "models" }, "Model files", h("span", { class: "quiet" }, " if not inside: RPC text, RPB, DIMAP")),
    models,
    h("label", { for: "sigma" }, "Accuracy of the model, metres"),
    sigma,
    button,
    state,
  );
  return h("details", { open: true, class: "card" }, h("summary", {}, "Register a scene"), form);

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    const [file] = image.files ?? [];
    if (!file) return;
    button.disabled = true;
    try {
      const { scene } = await send(file, sigma.value ? { sigma_m: sigma.value } : {}, state, signal);
      for (const model of models.files ?? []) await uploadModel(scene, model);
      go(`#/job/${await register(scene)}`);
    } catch (error) {
      state.replaceChildren(problem(error));
      button.disabled = false;
    }
  }
}

/** Ask for the registration of a scene; the id of the job. */
async function register(scene: string): Promise<string> {
  const job = await post<Job>("processes/register-scene/execution", { inputs: { scene } });
  return job.jobID;
}

function sceneRow(scene: Scene): HTMLElement {
  return h(
    "li",
    {},
    h("a", { href: `#/scene/${scene.id}` }, scene.name),
    badge(scene.state),
    h("span", { class: "quiet" }, `${bytes(scene.size_bytes)} · ${plural(scene.models.length, "model file")} · ${when(scene.created)}`),
  );
}

function jobRow(job: Job): HTMLElement {
  return h(
    "li",
    {},
    h("a", { href: `#/job/${job.jobID}` }, job.processID.replace("-", " ")),
    badge(job.status),
    h("span", { class: "quiet" }, when(job.created)),
  );
}
