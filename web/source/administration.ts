// Administration: its views, each for administrators only, and the links between them.

import { showAudit } from "./audit";
import { fill, h, problem } from "./elements";
import { announce } from "./page";
import { showReferences } from "./references";
import { showStatus } from "./status";
import { showSuspensions } from "./suspensions";
import { showTokens } from "./tokens";
import type { Part, ShowPart, ShowView } from "./view";

const PARTS: Record<string, { title: string; show: ShowPart }> = {
  status: { title: "Queue and storage", show: showStatus },
  tokens: { title: "Tokens", show: showTokens },
  references: { title: "References", show: showReferences },
  suspensions: { title: "Suspensions", show: showSuspensions },
  audit: { title: "Audit trail", show: showAudit },
};

/** Shows the part of the administration that the address names. */
export const showAdministration: ShowView = async ({ panel, signal, scopes }, name) => {
  const { title, show } = PARTS[name] ?? PARTS["status"]!;
  const heading = h("h1", { tabindex: -1 }, title);
  if (!scopes.includes("admin")) {
    fill(panel, heading, h("p", {}, "To administrate, ", h("a", { href: "#/access" }, "sign in"), " with a token of scope ", h("code", {}, "admin"), "."));
    return;
  }
  const message = h("div");
  const content = h("div");
  const part: Part = { content, signal, change };
  fill(panel, links(title), heading, message, content);
  await show(part);

  async function change(act: () => Promise<string>): Promise<void> {
    try {
      const done = await act();
      message.replaceChildren();
      announce(done);
      await show(part);
      if (!signal.aborted) heading.focus();
    } catch (error) {
      if (!signal.aborted) message.replaceChildren(problem(error));
    }
  }
};

/** Links to all parts of the administration. */
function links(shown: string): HTMLElement {
  const link = ([name, { title }]: [string, { title: string }]) =>
    h("a", { href: `#/admin/${name}`, "aria-current": title === shown ? "page" : null }, title);
  return h("nav", { class: "parts", "aria-label": "Administration" }, ...Object.entries(PARTS).map(link));
}
