// The start of the page: the caller, the map, and the view that the address names.

import { type Caller, showAccess, takeToken, whoCalls } from "./access";
import { showAdministration } from "./administration";
import { Refused } from "./api";
import { Atlas } from "./atlas";
import { drawBlocks, showBlock, showBlocks } from "./blocks";
import { showDrawing } from "./draw";
import { h, problem } from "./elements";
import { showJob } from "./job";
import { showMarking } from "./marking";
import { go, markSection } from "./page";
import { showPoint, showPoints } from "./points";
import { showScene, showScenes } from "./scenes";
import type { ShowView } from "./view";

const VIEWS: Record<string, { show: ShowView; section: string }> = {
  points: { show: showPoints, section: "points" },
  point: { show: showPoint, section: "points" },
  scenes: { show: showScenes, section: "scenes" },
  scene: { show: showScene, section: "scenes" },
  draw: { show: showDrawing, section: "scenes" },
  mark: { show: showMarking, section: "scenes" },
  job: { show: showJob, section: "scenes" },
  blocks: { show: showBlocks, section: "blocks" },
  block: { show: showBlock, section: "blocks" },
  admin: { show: showAdministration, section: "admin" },
  access: { show: showAccess, section: "access" },
};

const panel = document.getElementById("panel")!;
const access = document.getElementById("access")!;
let leaving = new AbortController();

async function start(): Promise<void> {
  takeToken();
  const atlas = new Atlas(document.getElementById("map")!, (id) => go(`#/point/${id}`));
  const caller = await whoCalls().catch(() => null);
  if (caller) access.textContent = caller.name;
  document.getElementById("admin")!.hidden = !caller?.scopes.includes("admin");
  addEventListener("hashchange", () => void route(atlas, caller, true));
  await Promise.all([route(atlas, caller, false), opening(atlas)]);
}

/** Show the blocks on the map, and fit it to them. */
async function opening(atlas: Atlas): Promise<void> {
  try {
    const { features } = await drawBlocks(atlas);
    if (!atlas.went && /^#?\/?(points)?$/.test(location.hash)) atlas.fit({ type: "FeatureCollection", features });
  } catch (error) {
    if (error instanceof Refused && error.status === 401) go("#/access");
  }
}

async function route(atlas: Atlas, caller: Caller | null, moved: boolean): Promise<void> {
  leaving.abort(new DOMException("gone elsewhere", "AbortError"));
  leaving = new AbortController();
  const { signal } = leaving;
  const [, name = "points", argument = ""] = location.hash.split("/");
  const view = VIEWS[name] ?? VIEWS["points"]!;
  markSection(view.section);
  document.body.classList.toggle("whole", view.section === "admin");
  panel.scrollTop = 0;
  try {
    await view.show({ panel, atlas, signal, scopes: caller?.scopes ?? [] }, decodeURIComponent(argument));
    if (moved && !signal.aborted) panel.querySelector("h1")?.focus({ preventScroll: true });
  } catch (error) {
    if (!signal.aborted) panel.replaceChildren(h("h1", { tabindex: -1 }, "An error occurred"), problem(error));
  }
  if (!signal.aborted) document.title = [panel.querySelector("h1")?.textContent, "Amers"].filter(Boolean).join(" · ");
}

void start();
