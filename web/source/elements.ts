// Elements of the page, and figures and dates as text.

type Child = Node | string | number | null | undefined | false;
type Attribute = string | number | boolean | null | undefined | ((event: Event) => void);

/** An element with attributes (functions become listeners: `onclick`) and children; empty children are left out. */
export function h<Name extends keyof HTMLElementTagNameMap>(
  name: Name,
  attributes: Record<string, Attribute> = {},
  ...children: Child[]
): HTMLElementTagNameMap[Name] {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key.slice(2), value);
    else if (value === true) element.setAttribute(key, "");
    else if (value !== false && value != null) element.setAttribute(key, String(value));
  }
  fill(element, ...children);
  return element;
}

/** Replace the children of an element; empty ones are left out. */
export function fill(element: HTMLElement, ...children: Child[]): void {
  element.replaceChildren(...children.filter((child) => child != null && child !== false).map((child) => child as Node));
}

/** A list of names and values; rows without a value are left out. */
export function facts(rows: Record<string, Child>): HTMLElement {
  const shown = Object.entries(rows).filter(([, value]) => value != null && value !== "" && value !== false);
  return h("dl", { class: "facts" }, ...shown.map(([name, value]) => h("div", {}, h("dt", {}, name), h("dd", {}, value))));
}

/** The two accuracies that every place states, in their words and order; earlier reports have none. */
export function accuracy({ relative_to_control_points: relative, on_the_earth: earth }: Stated): HTMLElement | null {
  if (!relative || !earth) return null;
  const assumed = earth.words.includes(": assumed: ");
  return facts({ [relative.label]: relative.words, [earth.label]: h("span", { class: assumed ? "assumed" : null }, earth.words) });
}

interface Stated {
  relative_to_control_points?: { label: string; words: string } | undefined;
  on_the_earth?: { label: string; words: string } | undefined;
}

/** A state as a word, after what it is a state of; its colour repeats the word and adds nothing. */
export function badge(state: string, of = ""): HTMLElement {
  return h("span", { class: `badge ${state.replace(/\W/g, "-")}` }, of + state);
}

export function problem(error: unknown): HTMLElement {
  return h("p", { class: "problem", role: "alert" }, error instanceof Error ? error.message : String(error));
}

/** A number with its unit: three significant digits, counts with separated thousands, a dash for unknown. */
export function figure(value: number | null | undefined, unit = ""): string {
  if (value == null || !Number.isFinite(value)) return "–";
  const whole = Number.isInteger(value) || Math.abs(value) >= 1000;
  const text = whole
    ? Math.round(value).toLocaleString("en-GB").replaceAll(",", "\u202f")
    : String(Number(value.toPrecision(3)));
  return unit ? `${text}\u00a0${unit}` : text;
}

export function bytes(count: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = Math.min(Math.floor(Math.log10(Math.max(count, 1)) / 3), units.length - 1);
  return figure(count / 1000 ** power, units[power]);
}

export function when(date: string | null | undefined): string {
  if (!date) return "";
  return new Date(date).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
}

export function day(date: string): string {
  return new Date(date).toLocaleDateString("en-GB", { dateStyle: "medium" });
}

export function plural(count: number, word: string): string {
  return `${figure(count)} ${word}${count === 1 ? "" : "s"}`;
}
