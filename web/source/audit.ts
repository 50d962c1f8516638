// The audit trail: every change, newest first, by who made it and what it changed.

import { address, get } from "./api";
import type { ChangeRecord, ChangeRecords } from "./api_types";
import { badge, fill, h, problem, when } from "./elements";
import type { ShowPart } from "./view";

const KINDS = ["token", "block", "scene", "job", "point", "reference_image", "audit"];
const LISTED = 50;
const LONGEST_VALUE = 60;

export const showAudit: ShowPart = async ({ content, signal }) => {
  const kind = h("select", { id: "audit-kind" }, h("option", { value: "" }, "everything"), ...KINDS.map((name) => h("option", { value: name }, name.replace("_", " "))));
  const subject = h("input", { id: "audit-subject", autocomplete: "off", placeholder: "all" });
  const actor = h("input", { id: "audit-actor", autocomplete: "off", placeholder: "everybody" });
  const changes = h("ul", { class: "list story", "aria-label": "Changes" });
  const older = h("button", { type: "button", onclick: () => void (next && show(next)) }, "Older changes");
  const end = h("p", { class: "quiet", tabindex: -1 });
  let next: string | undefined; // the older page, unless it is awaited
  let listing = 0;
  fill(
    content,
    h(
      "form",
      { class: "card", onsubmit: (event) => void filter(event) },
      h("label", { for: "audit-kind" }, "What"),
      kind,
      h("label", { for: "audit-subject" }, "Which", h("span", { class: "quiet" }, " its id; ID@VERSION of a block")),
      subject,
      h("label", { for: "audit-actor" }, "Who", h("span", { class: "quiet" }, " name of a token, or user of the command line")),
      actor,
      h("button", { type: "submit" }, "Show"),
    ),
    changes,
    h("p", {}, older),
    end,
  );
  await list();

  async function filter(event: Event): Promise<void> {
    event.preventDefault();
    await list();
  }

  /** List the changes that are asked for; pages of the list before it that still arrive are dropped. */
  async function list(): Promise<void> {
    listing++;
    changes.replaceChildren();
    older.hidden = true;
    await show(query());
  }

  function query(): string {
    const wanted = Object.entries({ kind: kind.value, subject: subject.value.trim(), actor: actor.value.trim() });
    return `audit?${new URLSearchParams([["limit", String(LISTED)], ...wanted.filter(([, value]) => value)])}`;
  }

  /** Add the changes of a page; where it is the last one, the focus goes from the button to what says so. */
  async function show(page: string): Promise<void> {
    const mine = listing;
    next = undefined;
    end.textContent = "";
    try {
      const { changes: more, links } = await get<ChangeRecords>(address(page), signal);
      if (mine !== listing) return;
      const pressed = document.activeElement === older;
      next = links.find(({ rel }) => rel === "next")?.href;
      changes.append(...more.map(row));
      older.hidden = next === undefined;
      if (!next) end.textContent = changes.children.length ? "These are all changes." : "No changes.";
      if (pressed && !next) end.focus();
    } catch (error) {
      if (signal.aborted || mine !== listing) return;
      next = page;
      older.hidden = false;
      fill(end, problem(error));
    }
  }
};

function row(change: ChangeRecord): HTMLElement {
  const name = (change.after ?? change.before)?.["name"];
  return h(
    "li",
    {},
    h("strong", {}, `${change.kind.replace("_", " ")} ${name ?? change.subject}`),
    badge(change.action),
    h("span", { class: "figures" }, values(change)),
    h("span", { class: "quiet" }, [when(change.at), change.actor_name, name ? change.subject : null].filter(Boolean).join(" · ")),
  );
}

/** The values that a change set or replaced. */
function values({ before, after }: ChangeRecord): string {
  const all = { ...before, ...after };
  const one = before && after ? (name: string) => `${short(before[name])} → ${short(after[name])}` : (name: string) => short(all[name]);
  const changed = (name: string) => (before && after ? short(before[name]) !== short(after[name]) : all[name] != null);
  return Object.keys(all)
    .filter(changed)
    .map((name) => `${name}: ${one(name)}`)
    .join("; ");
}

function short(value: unknown): string {
  const text = value == null ? "–" : typeof value === "string" ? value : JSON.stringify(value);
  return text.length <= LONGEST_VALUE ? text : `${text.slice(0, LONGEST_VALUE)}…`;
}
