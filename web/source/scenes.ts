// Scenes: those of the caller, and the upload and registration of a new one.

import type { Feature } from "geojson";
import { get, post } from "./api";
import type { Jobs, Scene, Scenes, StatusInfo } from "./api_types";
import { badge, bytes, facts, figure, fill, h, plural, problem, when } from "./elements";
import { go, type Place, type ShowView } from "./place";
import { send, uploadBeside } from "./upload";

const IMAGES = ".tif,.tiff,.jp2,.j2k,.ntf,.nitf,.zip,.tar";
const MODELS = ".txt,.xml,.rpb,.rpc,.geom";

/** Shows the scenes and jobs of the caller, and the form for a new scene. */
export const showScenes: ShowView = async (place) => {
  const { panel, atlas, signal, scopes } = place;
  if (!scopes.includes("register")) {
    fill(
      panel,
      h("h1", { tabindex: -1 }, "Scenes"),
      h("p", {}, "To register scenes, ", h("a", { href: "#/access" }, "sign in"), " with a token of scope ", h("code", {}, "register"), "."),
    );
    return;
  }
  const [{ scenes }, { jobs }] = await Promise.all([
    get<Scenes>("scenes?limit=200", signal),
    get<Jobs>("jobs?limit=20", signal),
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

/** Shows one scene: its files, and a button to register it again. */
export const showScene: ShowView = async ({ panel, atlas, signal }, id) => {
  const scene = await get<Scene>(`scenes/${encodeURIComponent(id)}`, signal);
  await atlas.show("scenes", outlines([scene]));
  atlas.fit(scene.footprint);
  const message = h("div");
  const again = h("button", { type: "button", class: "strong", onclick: () => void start() }, "Register");
  fill(
    panel,
    h("p", {}, h("a", { href: "#/scenes" }, "← Scenes")),
    h("h1", { tabindex: -1 }, scene.name),
    facts({
      State: badge(scene.state),
      Image: `${scene.file}, ${bytes(scene.size_bytes ?? 0)}`,
      Models: scene.models.join(", "),
      "Accuracy of its model": scene.sigma_m == null ? "unknown" : figure(scene.sigma_m, "m"),
      Uploaded: when(scene.created),
    }),
    scene.removed ? h("p", { class: "quiet" }, `The files were removed on ${when(scene.removed)}.`) : h("p", {}, again),
    message,
  );

  async function start(): Promise<void> {
    again.disabled = true;
    try {
      go(`#/job/${await register(scene.id)}`);
    } catch (error) {
      again.disabled = false;
      message.replaceChildren(problem(error));
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
    h("label", { for: "models" }, "Model files", h("span", { class: "quiet" }, " if not in the image: RPC text, RPB, DIMAP, .geom")),
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
      for (const model of models.files ?? []) await uploadBeside(scene, model);
      go(`#/job/${await register(scene)}`);
    } catch (error) {
      state.replaceChildren(problem(error));
      button.disabled = false;
    }
  }
}

/** Start the registration of a scene; returns the id of its job. */
async function register(scene: string): Promise<string> {
  const job = await post<StatusInfo>("processes/register-scene/execution", { inputs: { scene } });
  return job.jobID;
}

function sceneRow(scene: Scene): HTMLElement {
  return h(
    "li",
    {},
    h("a", { href: `#/scene/${scene.id}` }, scene.name),
    badge(scene.state),
    h("span", { class: "quiet" }, `${bytes(scene.size_bytes ?? 0)} · ${plural(scene.models.length, "model file")} · ${when(scene.created)}`),
  );
}

/** The verdict on the registration of a job: a job that ran to its end may have made a model not to be used. */
export function verdict(job: StatusInfo): HTMLElement | null {
  const word = job["amers:verdict"];
  return word ? badge(word, "verdict ") : null;
}

function jobRow(job: StatusInfo): HTMLElement {
  return h(
    "li",
    {},
    h("a", { href: `#/job/${job.jobID}` }, job.processID.replace("-", " ")),
    badge(job.status),
    verdict(job),
    h("span", { class: "quiet" }, when(job.created)),
  );
}
