// A list that is sorted, filtered and shown page by page.

import { fill, h, plural, problem } from "./elements";
import type { Following } from "./following";

const PAGE = 20;
/** Lists with fewer rows are seen as a whole: they have no controls. */
const FEWEST_WITH_CONTROLS = 5;

/** An order of the rows: by numbers or words, the smallest first; rows without a value come last. */
export type Order<Row> = (row: Row) => number | string | null | undefined;

export interface Listing<Row> {
  /** What the list has, in the singular, such as "scene". */
  what: string;
  rows: Row[];
  /** Reads the rows that follow; null where these are all. */
  following?: Following<Row> | null;
  /** By the words of the choice; the first is that of the list at first. */
  orders: Record<string, Order<Row>>;
  element: (row: Row) => HTMLElement;
  /** What to do where there are no rows. */
  empty: HTMLElement;
}

/** The list with its controls; what it is filtered by are the words of its rows. */
export function listing<Row>({ what, rows, following, orders, element, empty }: Listing<Row>): HTMLElement {
  if (!rows.length) return empty;
  const made = rows.map((row) => ({ row, element: element(row) }));
  const list = h("ul", { class: "list story", "aria-label": `List of ${what}s` });
  const filter = h("input", { type: "search", id: `filter-${what}`, autocomplete: "off", placeholder: "name, state, date …", oninput: () => show(0) });
  const order = h("select", { id: `order-${what}`, onchange: () => show(0) }, ...Object.keys(orders).map((name) => h("option", {}, name)));
  const count = h("p", { class: "count", role: "status" });
  const before = h("button", { type: "button", "aria-label": `Previous ${what}s`, onclick: () => turn(-1) }, "Previous");
  const after = h("button", { type: "button", "aria-label": `Next ${what}s`, onclick: () => turn(1) }, "Next");
  const controls = h(
    "div",
    { class: "listing", hidden: rows.length < FEWEST_WITH_CONTROLS },
    h("label", { for: filter.id }, `Filter ${what}s`),
    filter,
    h("label", { for: order.id }, "Sort by"),
    order,
  );
  const pager = h("p", { class: "state" }, before, after);
  const older = h("button", { type: "button", onclick: () => void load() }, `Load older ${what}s`);
  const rest = h("p", { class: "state", hidden: !following }, older);
  let page = 0;
  show(0);
  return h("div", {}, controls, count, list, pager, rest);

  /** Reads the rows that follow; the view stays where it is. */
  async function load(): Promise<void> {
    if (!following) return;
    older.disabled = true;
    rest.querySelector(".problem")?.remove();
    try {
      const read = await following();
      made.push(...read.rows.map((row) => ({ row, element: element(row) })));
      following = read.following;
      controls.hidden = made.length < FEWEST_WITH_CONTROLS;
      show(page);
      rest.hidden = !following;
      if (rest.hidden && !after.disabled) after.focus();
    } catch (error) {
      rest.append(problem(error));
    } finally {
      older.disabled = false;
    }
  }

  function turn(by: number): void {
    show(page + by);
    // A button that leads no further gives the focus to the other one.
    const other = by > 0 ? before : after;
    if ((by > 0 ? after : before).disabled && !other.disabled) other.focus();
    list.scrollIntoView({ block: "nearest" });
  }

  function show(wanted: number): void {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const matched = made.filter(({ element: { textContent } }) => words.every((word) => textContent.toLowerCase().includes(word)));
    const value = orders[order.value] ?? Object.values(orders)[0]!;
    const sorted = matched.toSorted((one, other) => compare(value(one.row), value(other.row)));
    page = wanted;
    const [from, to] = [page * PAGE, Math.min((page + 1) * PAGE, sorted.length)];
    fill(list, ...sorted.slice(from, to).map((one) => one.element));
    before.disabled = page === 0;
    after.disabled = to === sorted.length;
    pager.hidden = sorted.length <= PAGE;
    count.hidden = controls.hidden;
    const part = sorted.length > PAGE ? `${from + 1} to ${to} of ${plural(sorted.length, what)}` : plural(sorted.length, what);
    const newest = following ? `${part}, the newest of all` : part;
    count.textContent = sorted.length ? newest : `No ${what} has these words. Shorten the filter.`;
  }
}

function compare(one: ReturnType<Order<unknown>>, other: ReturnType<Order<unknown>>): number {
  if (one == null || other == null) return Number(one == null) - Number(other == null);
  if (typeof one === "number" && typeof other === "number") return one - other;
  return String(one).localeCompare(String(other), undefined, { numeric: true });
}
