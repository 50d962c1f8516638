// What is stated of all marks, and what the service says of their accuracy.

import type { AdjustedMarks } from "./api_types";
import { accuracy, badge, h, plural } from "./elements";
import type { Stated } from "./marks";

const FIELDS = {
  ground: "Ground, horizontal, m",
  up: "Ground, up, m",
  pick: "Mark in the image, px",
  frame: "Common error, horizontal, m",
  frameUp: "Common error, up, m",
};

/** The fields of the sigmas of all marks. */
export class StatedFields {
  readonly element: HTMLElement;
  private readonly inputs: Record<keyof typeof FIELDS, HTMLInputElement>;

  constructor(changed: () => void) {
    const input = (name: string): HTMLInputElement => h("input", { type: "number", id: `sigma-${name}`, min: 0.001, step: "any", inputmode: "decimal", onchange: changed });
    this.inputs = { ground: input("ground"), up: input("up"), pick: input("pick"), frame: input("frame"), frameUp: input("frame-up") };
    const names = Object.keys(FIELDS) as (keyof typeof FIELDS)[];
    this.element = h(
      "details",
      {},
      h("summary", {}, "Accuracy of the marks"),
      h("p", { class: "quiet" }, "One standard deviation. What is left empty is assumed: 0.5 px of a mark, one pixel of its ground; the common error is then unknown."),
      h("div", { class: "sigmas" }, ...names.map((name) => h("div", {}, h("label", { for: this.inputs[name].id }, FIELDS[name]), this.inputs[name]))),
    );
  }

  /** Fill the fields with what was stated earlier; what is missing stays as it is. */
  set value({ sigma_m, mark_sigma_px, frame_sigma_m }: Stated) {
    const { ground, up, pick, frame, frameUp } = this.inputs;
    const put = (input: HTMLInputElement, value: number | undefined): void => void (value === undefined || (input.value = String(value)));
    put(ground, sigma_m?.[0]);
    put(up, sigma_m?.[1]);
    put(pick, mark_sigma_px);
    put(frame, frame_sigma_m?.[0]);
    put(frameUp, frame_sigma_m?.[1]);
  }

  /** The pairs and values that are complete. */
  get value(): Stated {
    const { ground, up, pick, frame, frameUp } = this.inputs;
    const stated: Stated = {};
    if (ground.value && up.value) stated.sigma_m = [ground.valueAsNumber, up.valueAsNumber];
    if (pick.value) stated.mark_sigma_px = pick.valueAsNumber;
    if (frame.value && frameUp.value) stated.frame_sigma_m = [frame.valueAsNumber, frameUp.valueAsNumber];
    return stated;
  }
}

/** The verdict, and how well the marks agree. */
export function verdictOn({ verdict, marks }: AdjustedMarks): HTMLElement {
  const used = marks.filter(({ status }) => status === "used" || status === "in doubt");
  const rms = Math.sqrt(used.reduce((sum, { residual_px: [line, sample] }) => sum + (line ?? 0) ** 2 + (sample ?? 0) ** 2, 0) / used.length);
  if (!verdict) return h("p", {}, marks.length ? `${plural(marks.length, "check point")}, no mark` : "No mark yet.");
  return h("p", { class: "state" }, badge(verdict, "verdict "), h("span", {}, `${used.length} of ${plural(marks.length, "mark")} used, ${rms.toFixed(2)} px rms`));
}

/** The accuracy that a registration on the marks would state, and what the service notes about them. */
export function notesOn(adjusted: AdjustedMarks, needsHeights: boolean): (HTMLElement | null)[] {
  const { relative_to_control_points: relative, on_the_earth: earth, words, terrain } = adjusted;
  const none = needsHeights ? "No reference of this service has a terrain here: give the heights." : null;
  const heights = terrain ? `Heights that are not given are those of the terrain of ${terrain}.` : none;
  return [
    words.length ? h("ul", { class: "words" }, ...words.map((text) => h("li", {}, text))) : null,
    accuracy({ relative_to_control_points: relative ?? undefined, on_the_earth: earth ?? undefined }),
    heights ? h("p", { class: "quiet" }, heights) : null,
  ];
}
