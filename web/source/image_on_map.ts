// The part of a registration's page that shows the image on the map, before and after, and what it is compared with.

import type { FeatureCollection, Point } from "geojson";
import type { StatusInfo } from "./api_types";
import type { Comparison, Picture, Shown, Side } from "./comparison";
import { accuracy, figure, fill, h, problem } from "./elements";
import { announce } from "./page";
import { type Choice, drawScene, type Mapped, otherPictures } from "./pictures";
import type { Report } from "./report_types";
import type { PointResultProperties } from "./residuals";
import type { Place } from "./view";

const SIDES: Record<Side, string> = { left: "Left of the divider", right: "Right of the divider" };

/** A registration, and what the map shows of it. */
export interface Registered {
  job: StatusInfo;
  report: Report;
  points: FeatureCollection<Point, PointResultProperties>;
  /** Draw the points and their arrows over an image, or leave them out. */
  overImage: (withPoints: boolean) => void;
}

/** A button that draws the image of a registered scene on the map, and then the choice of what is seen. */
export function imageOnMap({ atlas, signal }: Place, registered: Registered): HTMLElement | null {
  const { job, report } = registered;
  if (job.processID !== "register-scene") return null;
  const state = h("div", { role: "status" });
  const tell = (words: string): void => fill(state, h("p", { class: "quiet" }, words));
  const button = h("button", { type: "button", onclick: () => void open() }, "Show the image on the map");
  const section = h("section", { "aria-label": "Image on the map" }, h("h2", {}, "Image on the map"), h("p", {}, button), state);
  // The third word of the address asks for the image at once.
  if (location.hash.endsWith("/map")) void open();
  return section;

  async function open(): Promise<void> {
    button.disabled = true;
    try {
      const { scene, model } = job.inputs;
      const { mapped, raw, registered: after } = await drawScene({ scene, registration: job.jobID, model: model ?? null }, signal, tell);
      const comparison = await atlas.compare({ left: raw, right: after }, signal);
      if (signal.aborted) return;
      if (!comparison) throw new Error("The map cannot be shown in this browser.");
      registered.overImage(true);
      const [west, south, east, north] = mapped.bounds;
      atlas.fit({ type: "MultiPoint", coordinates: [[west, south], [east, north]] });
      const own = [raw, after].map((picture): Choice => ({ name: `This scene, ${picture.name.toLowerCase()}`, make: async () => picture }));
      const others = await otherPictures(job, registered.points, mapped.bounds, signal, tell);
      fill(state);
      const parts = new Controls(comparison, [...own, ...others], registered, state).parts();
      fill(section, h("h2", {}, "Image on the map"), ...parts, state, ...words(report, mapped));
      section.querySelector("input")?.focus();
      announce("The image is on the map.");
    } catch (error) {
      if (signal.aborted) return;
      fill(state, problem(error));
      button.disabled = false;
    }
  }
}

/** The choice of what is seen: of a side or of both, and of what each side shows. */
class Controls {
  private readonly labels = { left: h("label", { for: "shown-left" }, "Raw"), right: h("label", { for: "shown-right" }, "Registered") };

  constructor(
    private readonly comparison: Comparison,
    private readonly choices: Choice[],
    private readonly registered: Registered,
    private readonly state: HTMLElement,
  ) {}

  parts(): HTMLElement[] {
    const both = h("label", { for: "shown-swipe" }, "Both, with a divider");
    const { left, right } = this.labels;
    const shown = Object.entries({ swipe: both, left, right }).map(([name, label]) => {
      const input = h("input", { type: "radio", name: "shown", id: `shown-${name}`, checked: name === "swipe", onchange: () => this.comparison.show(name as Shown) });
      return h("div", { class: "choice" }, input, label);
    });
    const opacity = h("input", { type: "range", id: "opacity", min: 0, max: 100, value: 100, oninput: () => this.comparison.fade(opacity.valueAsNumber / 100) });
    const points = h("input", { type: "checkbox", id: "points-over", checked: true, onchange: () => this.registered.overImage(points.checked) });
    return [
      h("fieldset", {}, h("legend", {}, "Shown"), ...shown),
      ...this.sideChoice("left", 0),
      ...this.sideChoice("right", 1),
      h("label", { for: "opacity" }, "Opacity"),
      opacity,
      h("div", { class: "choice" }, points, h("label", { for: "points-over" }, "Points and residuals over the image")),
    ];
  }

  private sideChoice(side: Side, first: number): HTMLElement[] {
    const options = this.choices.map(({ name }, at) => h("option", { value: at, selected: at === first }, name));
    const select = h("select", { id: `picture-${side}`, onchange: () => void choose() }, ...options);
    let asked = 0;
    const choose = async (): Promise<void> => {
      const own = ++asked;
      const choice = this.choices[Number(select.value)]!;
      fill(this.state, h("p", { class: "quiet" }, `Loading: ${choice.name}.`));
      try {
        const picture = await choice.make();
        if (own === asked) this.show(side, picture);
        fill(this.state);
      } catch (error) {
        if (own === asked && !(error instanceof DOMException)) fill(this.state, problem(error));
      }
    };
    return [h("label", { for: select.id }, SIDES[side]), select];
  }

  private show(side: Side, picture: Picture): void {
    this.comparison.replace(side, picture);
    this.labels[side].textContent = picture.name;
    announce(`${SIDES[side]}: ${picture.name}.`);
  }
}

/** What the pictures show: the size of the correction and the accuracy that is left. */
function words({ correction, ...stated }: Report, { heights }: Mapped): (HTMLElement | null)[] {
  return [
    h("p", {}, `The registration moved the middle of the image by ${figure(correction.shift_m, "m")} on the ground. What it predicts of the registered image:`),
    accuracy(stated),
    h("p", { class: "quiet" }, `Heights of the ground: ${heights}.`),
  ];
}
