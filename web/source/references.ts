// Reference images: those of the installation, a new one from files of the server, and removal.

import { get, post, remove } from "./api";
import type { Reference, References } from "./api_types";
import { ask } from "./confirmation";
import { day, figure, fill, h } from "./elements";
import type { ShowPart } from "./view";

const FIELDS: [name: string, label: string, hint: string][] = [
  ["name", "Name", "for people"],
  ["image", "Ortho-image", "path below the reference folder of the server"],
  ["dem", "Height model", "path; without it only ortho-images are registered on it"],
  ["vertical", "Vertical datum of the heights", "ellipsoid, EGM96, EPSG:…"],
  ["geoid", "Grid of the geoid", "path, where PROJ has none"],
  ["sigma_m", "Accuracy of the image on the Earth", "metres, one standard deviation"],
  ["sigma_up_m", "Accuracy of the heights on the Earth", "metres, one standard deviation"],
];
const REQUIRED = ["name", "image"];

export const showReferences: ShowPart = async ({ content, signal, change }) => {
  const { references } = await get<References>("references", signal);
  fill(
    content,
    h("p", {}, "Scenes are registered on these images where there are no points."),
    referenceForm(),
    references.length
      ? h("ul", { class: "list story", "aria-label": "References" }, ...references.map(row))
      : h("p", { class: "quiet" }, "No references yet. Add an ortho-image of the server above: scenes are then registered on it where no block has points."),
  );

  function row(reference: Reference): HTMLElement {
    const [horizontal, up] = [reference.sigma_m, reference.sigma_up_m].map((sigma) => (sigma == null ? "unknown" : figure(sigma, "m")));
    const accuracy = `accuracy ${horizontal} horizontal, ${up} up`;
    const files = [reference.image, reference.dem, reference.vertical, reference.geoid].filter(Boolean).join(" · ");
    return h(
      "li",
      {},
      h("strong", {}, reference.name),
      h("button", { type: "button", "aria-label": `Remove ${reference.name}`, onclick: () => void drop(reference) }, "Remove"),
      h("span", { class: "figures" }, `${figure(reference.gsd_m, "m")} pixels · ${accuracy}`),
      h("span", { class: "quiet" }, `${files} · added ${day(reference.created_at)}`),
    );
  }

  async function drop({ name }: Reference): Promise<void> {
    const text = "Scenes are no longer registered on it, and the record of its places is deleted. Its files stay in their folder.";
    if ((await ask({ title: `Remove ${name}?`, text, act: "Remove" })) === null) return;
    await change(async () => {
      await remove(`references/${encodeURIComponent(name)}`);
      return `${name} is removed.`;
    });
  }

  function referenceForm(): HTMLElement {
    const inputs = FIELDS.map(([name]) => {
      const amount = name.startsWith("sigma") ? { type: "number", min: 0, step: "any", inputmode: "decimal" } : {};
      return h("input", { id: `reference-${name}`, name, required: REQUIRED.includes(name), autocomplete: "off", ...amount });
    });
    const labelled = FIELDS.flatMap(([name, label, hint], at) => [
      h("label", { for: `reference-${name}` }, label, h("span", { class: "quiet" }, ` ${hint}`)),
      inputs[at]!,
    ]);
    const button = h("button", { type: "submit", class: "strong" }, "Add");
    return h("details", { class: "card" }, h("summary", {}, "Add a reference"), h("form", { onsubmit: (event) => void submit(event) }, ...labelled, button));

    async function submit(event: Event): Promise<void> {
      event.preventDefault();
      button.disabled = true;
      const filled = inputs.filter((input) => input.value.trim());
      const body = Object.fromEntries(filled.map((input) => [input.name, input.type === "number" ? Number(input.value) : input.value.trim()]));
      await change(async () => `${(await post<Reference>("references", body)).name} is added.`);
      button.disabled = false;
    }
  }
};
