// The choice of a reference image that the map shows while marks are set.

import type { Position } from "geojson";
import type { Atlas } from "./atlas";
import { h } from "./elements";
import { boundsOf, pyramidOf, referencesOf, referenceWords } from "./pictures";

/** A choice of the references that show some ground, of which the finest is shown at once; null without any. */
export async function referenceChoice(atlas: Atlas, outline: Position[], signal: AbortSignal): Promise<HTMLElement | null> {
  const there = await referencesOf(boundsOf(outline), signal);
  if (!there.length) return null;
  const options = there.map((one) => h("option", { value: one.name }, referenceWords(one)));
  const select = h("select", { id: "reference", onchange: () => show() }, ...options, h("option", { value: "" }, "none"));
  let shown = new AbortController();
  show();
  return h("div", { class: "reference" }, h("label", { for: "reference" }, "Reference image on the map"), select);

  function show(): void {
    shown.abort();
    shown = new AbortController();
    const chosen = there.find(({ name }) => name === select.value);
    if (chosen) void atlas.surface(pyramidOf(chosen), AbortSignal.any([shown.signal, signal]));
  }
}
