// The list of marks with their residuals.

import type { AdjustedMark } from "./api_types";
import { badge, fill, h } from "./elements";
import type { Mark } from "./marks";

/** What a row can do. */
export interface RowActions {
  rename(mark: Mark, name: string): void;
  check(mark: Mark, check: boolean): void;
  show(mark: Mark): void;
  change(mark: Mark): void;
  remove(mark: Mark): void;
}

const FIGURES = ["Line", "Sample", "Longitude", "Latitude", "Height, m", "Residual, px", "Residual, m", "Without it, px"];
const HEADS = ["Name", ...FIGURES, "State", "Check", "Change"];

/** A table that is drawn again after each change; the control that had the focus has it again. */
export class MarksTable {
  readonly element: HTMLElement;
  private readonly rows = h("tbody");

  constructor(private readonly actions: RowActions) {
    const table = h(
      "table",
      { class: "marks" },
      h("caption", {}, "Marks"),
      h("thead", {}, h("tr", {}, ...HEADS.map((head) => h("th", { scope: "col" }, head)))),
      this.rows,
    );
    this.element = h("div", { class: "marks-scroll", tabindex: 0, role: "region", "aria-label": "List of marks" }, table);
  }

  show(marks: Mark[], results: Map<string, AdjustedMark>): void {
    const focused = this.rows.contains(document.activeElement) ? document.activeElement?.id : "";
    fill(this.rows, ...marks.map((mark, at) => this.row(mark, at, results.get(mark.name))));
    this.element.hidden = marks.length === 0;
    if (focused) (document.getElementById(focused) ?? this.element).focus({ preventScroll: true });
  }

  private row(mark: Mark, at: number, found: AdjustedMark | undefined): HTMLElement {
    const { name } = mark;
    const input = h("input", { type: "text", id: `name-${at}`, "aria-label": `Name of ${name}`, value: name, spellcheck: false, onchange: () => this.actions.rename(mark, input.value) });
    const check = h("input", { type: "checkbox", id: `check-${at}`, "aria-label": `${name} is a check point`, checked: mark.check, onchange: () => this.actions.check(mark, check.checked) });
    const button = (word: string, act: (mark: Mark) => void): HTMLElement =>
      h("button", { type: "button", id: `${word.toLowerCase()}-${at}`, "aria-label": `${word} ${name}`, onclick: () => act(mark) }, word);
    const cells = [
      mark.line.toFixed(2),
      mark.sample.toFixed(2),
      mark.lon.toFixed(7),
      mark.lat.toFixed(7),
      decimals(mark.height_m ?? found?.height_m, 2),
      pair(found?.residual_px),
      decimals(found?.residual_m, 2),
      pair(found?.left_out_px),
    ];
    return h(
      "tr",
      { class: found?.status === "rejected" && "wrong" },
      h("th", { scope: "row" }, input),
      ...cells.map((text, at) => h("td", { "data-head": FIGURES[at] }, text)),
      h("td", { class: "note", "data-head": "State" }, found ? badge(found.status) : "–", found?.note ? h("span", { class: "quiet" }, ` ${found.note}`) : null),
      h("td", { "data-head": "Check" }, check),
      h("td", { class: "acts" }, button("Show", (one) => this.actions.show(one)), button("Change", (one) => this.actions.change(one)), button("Remove", (one) => this.actions.remove(one))),
    );
  }
}

/** Line and sample with their signs. */
function pair(values: (number | null)[] | undefined): string {
  return values && values.every((value) => value != null) ? values.map((value) => `${value! < 0 ? "−" : "+"}${Math.abs(value!).toFixed(2)}`).join(" ") : "–";
}

function decimals(value: number | null | undefined, count: number): string {
  return value == null ? "–" : value.toFixed(count);
}
