// The registration of a scene that is uploaded: its options, as the command `amers scene register` has them.

import { post } from "./api";
import type { Scene, StatusInfo } from "./api_types";
import { fill, h, problem } from "./elements";
import { go } from "./page";
import { uploadBeside } from "./upload";

const METHODS = { auto: "control points, or else a reference image", points: "control points only", reference: "a reference image", marks: "marks only" };
const ORDERS = { "": "chosen by the points", shift: "shift", drift: "shift and drift", affine: "affine" };

/** Of a registration, where a correction is demanded: the service takes the options of the adjustment as a whole. */
const LEAST_POINTS = 6;

/** Start the registration of a scene; returns the id of its job. */
export async function register(scene: string, inputs: Record<string, unknown> = {}): Promise<string> {
  const job = await post<StatusInfo>("processes/register-scene/execution", { inputs: { scene, ...inputs } });
  return job.jobID;
}

/** A form that registers a scene, again or for the first time; what is left empty has the default of the service. */
export function registrationForm(scene: Scene): HTMLElement {
  const sigma = h("input", { type: "number", id: "sigma", min: 0.01, step: "any", inputmode: "decimal", placeholder: scene.sigma_m ?? "unknown" });
  const bands = h("input", { id: "bands", spellcheck: false, autocomplete: "off" });
  const method = choice("method", METHODS);
  const order = choice("order", ORDERS);
  const mask = h("input", { type: "file", id: "mask", accept: ".tif,.tiff" });
  const checks = h("input", { type: "file", id: "check-points" });
  const heights = h("input", { id: "check-heights", spellcheck: false, autocomplete: "off" });
  const marks = h("input", { type: "file", id: "marks" });
  const marksHeights = h("input", { id: "marks-heights", spellcheck: false, autocomplete: "off" });
  const button = h("button", { type: "submit", class: "strong" }, scene.registrations.length ? "Register again" : "Register");
  const message = h("div");
  return h(
    "form",
    { onsubmit: (event) => void submit(event) },
    ...labelled(sigma, "Accuracy of the model, metres", "1 sigma on the ground; raise it when points lie at the edge of the search"),
    ...labelled(method, "Registered on"),
    ...labelled(order, "Correction"),
    ...labelled(marks, "Marks", "ground points that you marked in the image: CSV, QGIS, ENVI, PCI, ASP or another format; one is enough"),
    h(
      "details",
      {},
      h("summary", {}, "Bands, mask, check points, datum of marks"),
      h(
        "div",
        { class: "fields" },
        ...labelled(bands, "Bands", "2, or 1,2,3, or 3:0.3,2:0.7"),
        ...labelled(mask, "Mask", "pixels that are not zero are not used"),
        ...labelled(checks, "Check points", "GeoJSON, CSV or another format of points; held out of the registration"),
        ...labelled(heights, "Vertical datum of their heights", "ellipsoid, EGM96, EPSG:…"),
        ...labelled(marksHeights, "Vertical datum of the marks", "ellipsoid, EGM96, EPSG:…; where their file states none"),
      ),
    ),
    button,
    message,
  );

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    button.disabled = true;
    fill(message);
    try {
      const inputs: Record<string, unknown> = { method: method.value };
      if (sigma.value) inputs["sigma_m"] = Number(sigma.value);
      if (bands.value.trim()) inputs["bands"] = bands.value.trim();
      if (heights.value.trim()) inputs["check_heights"] = heights.value.trim();
      if (order.value) inputs["options"] = { adjustment: { order: order.value, min_points: LEAST_POINTS } };
      const [maskFile] = mask.files ?? [];
      const [checkFile] = checks.files ?? [];
      if (maskFile) inputs["mask"] = await uploadBeside(scene.id, maskFile);
      const [marksFile] = marks.files ?? [];
      if (marksFile) inputs["control"] = await uploadBeside(scene.id, marksFile);
      if (marksFile && marksHeights.value.trim()) inputs["control_heights"] = marksHeights.value.trim();
      if (checkFile) inputs["check_points"] = await uploadBeside(scene.id, checkFile);
      go(`#/job/${await register(scene.id, inputs)}`);
    } catch (error) {
      button.disabled = false;
      fill(message, problem(error));
    }
  }
}

function choice(id: string, words: Record<string, string>): HTMLSelectElement {
  return h("select", { id }, ...Object.entries(words).map(([value, text]) => h("option", { value }, text)));
}

function labelled(input: HTMLElement, label: string, hint = ""): HTMLElement[] {
  return [h("label", { for: input.id }, label, hint ? h("span", { class: "quiet" }, ` ${hint}`) : null), input];
}
