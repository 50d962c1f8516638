// Scenes: those of the caller, and the upload and registration of a new one.

import type { Feature } from "geojson";
import { register, registrationForm } from "./again";
import { get } from "./api";
import type { Scene, SceneRegistration, StatedAccuracy, StatusInfo } from "./api_types";
import { accuracy, badge, bytes, day, facts, figure, fill, h, problem, when } from "./elements";
import { type Following, pageOf } from "./following";
import { listing, type Order } from "./listing";
import { go } from "./page";
import { place as placeName } from "./places";
import { outlineOf } from "./pictures";
import { find } from "./processes";
import { send, uploadBeside } from "./upload";
import type { Place, ShowView } from "./view";

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
  const [first, jobs] = await Promise.all([
    pageOf<"scenes", Scene>(`scenes?limit=${SCENES_OF_A_PAGE}`, "scenes", signal),
    pageOf<"jobs", StatusInfo>(`jobs?limit=${JOBS_OF_A_PAGE}`, "jobs", signal),
  ]);
  const scenes = [...first.rows];
  await atlas.show("scenes", outlines(scenes));
  if (!atlas.went) atlas.fit({ type: "FeatureCollection", features: outlines(scenes) });
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Scenes"),
    uploadForm(place),
    h("h2", {}, "Jobs"),
    listing({ what: "job", ...jobs, orders: JOB_ORDERS, element: jobRow, empty: next("No jobs yet. Choose an image above and press Upload and register: the registration is a job.") }),
    h("h2", {}, "My scenes"),
    listing({ what: "scene", rows: first.rows, following: drawn(first.following), orders: SCENE_ORDERS, element: sceneRow, empty: next("No scenes yet. Choose an image above, or send one with amers scene register IMAGE --server.") }),
  );

  /** Reads older scenes, and draws them on the map. */
  function drawn(following: Following<Scene> | null): Following<Scene> | null {
    if (!following) return null;
    return async () => {
      const page = await following();
      scenes.push(...page.rows);
      await atlas.show("scenes", outlines(scenes));
      return { rows: page.rows, following: drawn(page.following) };
    };
  }
};

const SCENES_OF_A_PAGE = 500;
const JOBS_OF_A_PAGE = 200;

const SCENE_ORDERS: Record<string, Order<Scene>> = {
  "newest first": ({ created }) => -Date.parse(created),
  name: ({ name }) => name,
  "acquired, newest first": ({ acquired }) => (acquired ? -Date.parse(acquired) : null),
  "best CE90 on the Earth": ({ registrations: [last] }) => last?.on_the_earth?.ce90_m,
  "state of the registration": ({ registrations: [last] }) => last?.verdict ?? last?.outcome,
};
const JOB_ORDERS: Record<string, Order<StatusInfo>> = {
  "newest first": ({ created }) => -Date.parse(created),
  "name of the scene": (job) => job["amers:sceneNames"]?.[0],
  state: ({ status }) => status,
  process: ({ processID }) => processID,
};

function next(words: string): HTMLElement {
  return h("p", { class: "quiet" }, words);
}

/** Shows one scene: its state, its registrations with their results, and a form to register it again. */
export const showScene: ShowView = async ({ panel, atlas, signal }, id) => {
  const scene = await get<Scene>(`scenes/${encodeURIComponent(id)}`, signal);
  const [last] = scene.registrations;
  const registration = scene.removed ? undefined : scene.registrations.find(({ outcome: word }) => word === "registered");
  const outline = registration ? await find(registration.job, signal).then((job) => outlineOf(job, signal)).catch(() => null) : null;
  signal.throwIfAborted();
  await atlas.show("scenes", outlines([{ ...scene, footprint: outline }]));
  atlas.fit(outline ?? scene.footprint);
  fill(
    panel,
    h("p", {}, h("a", { href: "#/scenes" }, "← Scenes")),
    h("h1", { tabindex: -1 }, scene.name),
    h("p", { class: "state" }, ...states(scene)),
    last ? accuracy(stated(last)) : null,
    last ? h("p", {}, h("a", { class: "button strong", href: `#/job/${last.job}` }, RESULTS[last.outcome])) : null,
    facts({
      Image: `${scene.file}, ${bytes(scene.size_bytes ?? 0)}`,
      Place: placeName(scene.footprint),
      Acquired: when(scene.acquired),
      Sensor: scene.sensor,
      "Ground sampling": scene.gsd_m == null ? null : figure(scene.gsd_m, "m"),
      "Accompanying files": scene.models.join(", "),
      "Accuracy of its model as stated": scene.sigma_m == null ? "unknown" : figure(scene.sigma_m, "m"),
      Uploaded: when(scene.created),
    }),
    scene.removed
      ? h("p", { class: "quiet" }, `The files were removed on ${when(scene.removed)}.`)
      : h("p", {}, h("a", { class: "button", href: `#/mark/${scene.id}` }, "Mark points")),
    scene.removed
      ? null
      : h("details", { class: "card", open: !last }, h("summary", {}, last ? "Register again" : "Register"), registrationForm(scene)),
    scene.registrations.length ? h("h2", {}, "Registrations") : null,
    h("ul", { class: "list story" }, ...scene.registrations.map(registrationRow)),
  );
};

const RESULTS = { registered: "See the results", failed: "See what was tried", "under way": "See its progress" };

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

function sceneRow(scene: Scene): HTMLElement {
  const [last] = scene.registrations;
  const date = scene.acquired ? `acquired ${day(scene.acquired)}` : `uploaded ${day(scene.created)}`;
  return story(h("a", { href: `#/scene/${scene.id}` }, scene.name), states(scene), last ? stated(last) : {}, date, placeName(scene.footprint));
}

function registrationRow(one: SceneRegistration): HTMLElement {
  const process = one.process === "register-scenes" ? "together with other scenes" : "this scene alone";
  return story(h("a", { href: `#/job/${one.job}` }, when(one.created)), outcome(one), stated(one), process);
}

function jobRow(job: StatusInfo): HTMLElement {
  const process = job.processID.replaceAll("-", " ");
  const names = job["amers:sceneNames"] ?? [];
  const title = names.length > 2 ? `${names[0]} and ${names.length - 1} more scenes` : names.join(", ");
  const figures = { relative_to_control_points: job["amers:relative_to_control_points"], on_the_earth: job["amers:on_the_earth"] };
  const state = [badge(job.status), verdict(job)];
  return story(h("a", { href: `#/job/${job.jobID}` }, title || process), state, figures, `${title ? `${process} · ` : ""}${when(job.created)}`);
}

/** The verdict on the registration of a job: a job that ran to its end may have made a model not to be used. */
export function verdict(job: StatusInfo): HTMLElement | null {
  const word = job["amers:verdict"];
  return word ? badge(word, "verdict ") : null;
}

/** What a scene is: removed or arriving, else how its last registration ended. */
function states(scene: Scene): (HTMLElement | null)[] {
  if (scene.state !== "uploaded") return [badge(scene.state)];
  const [last] = scene.registrations;
  return last ? outcome(last) : [badge("not registered yet")];
}

/** How a registration ended; its verdict where that adds something. */
function outcome({ outcome: word, verdict: judged }: SceneRegistration): (HTMLElement | null)[] {
  return [badge(word), judged && judged !== word ? badge(judged, "verdict ") : null];
}

interface Figures {
  relative_to_control_points?: StatedAccuracy | undefined;
  on_the_earth?: StatedAccuracy | undefined;
}

function stated({ relative_to_control_points: relative, on_the_earth: earth }: SceneRegistration): Figures {
  return { relative_to_control_points: relative ?? undefined, on_the_earth: earth ?? undefined };
}

/** A row of a list: what it is about, its state, its accuracy, its date and its place. */
function story(link: HTMLElement, state: (HTMLElement | null)[], figures: Figures, date: string, place: HTMLElement | null = null): HTMLElement {
  const { relative_to_control_points: relative, on_the_earth: earth } = figures;
  const known = relative?.ce90_m != null || earth?.ce90_m != null;
  const words = known ? `CE90 ${metres(relative)} relative · ${metres(earth)} on the Earth` : null;
  return h("li", {}, link, ...state, words ? h("span", { class: "figures" }, words) : null, h("span", { class: "quiet" }, date, place ? " · " : null, place));
}

/** A CE90 with two significant digits, as the words of the service have it. */
function metres(one: StatedAccuracy | undefined): string {
  return one?.ce90_m == null ? "unknown" : figure(Number(one.ce90_m.toPrecision(2)), "m");
}
