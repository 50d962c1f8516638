// Suspensions: the points that their history proposes to suspend, and those that are suspended.

import { type FeaturePage, get, type PointHistory, post } from "./api";
import { ask } from "./confirmation";
import { day, figure, fill, h, plural } from "./elements";
import type { ShowPart } from "./view";

const LISTED = 100;

export const showSuspensions: ShowPart = async ({ content, signal, change }) => {
  const [proposed, suspended] = await Promise.all([inState("proposed"), inState("suspended")]);
  fill(
    content,
    h("p", {}, "A point is proposed when it fails in many scenes where other points succeed. A suspended point is not served."),
    h("h2", {}, "Proposed"),
    list("Proposed points", "None. Points are proposed after registrations of several scenes in which they fail.", proposed, (point) => act("Suspend", point, suspend)),
    h("h2", {}, "Suspended"),
    list("Suspended points", "None. A proposed point that you suspend is listed here.", suspended, (point) => act("Reinstate", point, reinstate)),
  );

  function inState(state: string): Promise<FeaturePage<PointHistory>> {
    const query = new URLSearchParams({ filter: `state='${state}'`, sortby: "health", limit: String(LISTED) });
    return get<FeaturePage<PointHistory>>(`collections/point-history/items?${query}`, signal);
  }

  async function suspend({ id, properties }: PointHistory): Promise<void> {
    const reason = `succeeds in ${properties.successes} of ${plural(properties.attempts, "scene")}, ${figure(properties.expected)} expected`;
    const text = "Registrations and readers no longer get it until it is reinstated.";
    const because = await ask({ title: `Suspend point ${id}?`, text, act: "Suspend", field: { label: "Reason", value: reason } });
    if (because === null) return;
    await change(async () => {
      await post(`points/${id}/suspend`, { because });
      return `Point ${id} is suspended.`;
    });
  }

  async function reinstate({ id }: PointHistory): Promise<void> {
    const text = "It is served again, and its history starts anew.";
    if ((await ask({ title: `Reinstate point ${id}?`, text, act: "Reinstate" })) === null) return;
    await change(async () => {
      await post(`points/${id}/reinstate`);
      return `Point ${id} is served again.`;
    });
  }
};

function act(word: string, point: PointHistory, on: (point: PointHistory) => Promise<void>): HTMLElement {
  return h("button", { type: "button", "aria-label": `${word} point ${point.id}`, onclick: () => void on(point) }, word);
}

function list(name: string, empty: string, { features, numberMatched }: FeaturePage<PointHistory>, button: (point: PointHistory) => HTMLElement): HTMLElement {
  if (!features.length) return h("p", { class: "quiet" }, empty);
  const rows = h("ul", { class: "list story", "aria-label": name }, ...features.map((point) => row(point, button(point))));
  return features.length < numberMatched
    ? h("div", {}, h("p", { class: "count" }, `${plural(numberMatched, "point")}, the worst ${features.length}:`), rows)
    : rows;
}

function row({ id, properties: point }: PointHistory, button: HTMLElement): HTMLElement {
  const served = `succeeded in ${figure(point.successes)} of ${plural(point.attempts, "scene")}, ${figure(point.expected)} expected`;
  const suspended = point.suspended_at ? `suspended ${day(point.suspended_at)}: ${point.suspended_because}` : null;
  const residual = point.mean_residual_px == null ? null : `mean residual ${figure(point.mean_residual_px, "px")}`;
  return h(
    "li",
    {},
    h("strong", {}, `Point ${id}`),
    button,
    h("span", { class: "figures" }, served),
    h("span", { class: "quiet" }, [suspended, residual].filter(Boolean).join(" · ")),
  );
}
