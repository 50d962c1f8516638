// The queue and the storage of the installation, and what every owner keeps.

import { get } from "./api";
import type { InstallationStatus, OwnersUsage, OwnerUsage } from "./api_types";
import { bytes, facts, figure, fill, h } from "./elements";
import type { ShowPart } from "./view";

const HOUR_S = 3600;

export const showStatus: ShowPart = async ({ content, signal, change }) => {
  const [now, { owners }] = await Promise.all([get<InstallationStatus>("status", signal), get<OwnersUsage>("tokens/usage", signal)]);
  fill(
    content,
    h("h2", {}, "Queue"),
    facts({
      "Jobs that wait": figure(now.jobs_waiting),
      "Longest wait": now.jobs_waiting ? duration(now.oldest_waiting_s) : null,
      "Jobs that run": figure(now.jobs_running),
      "Workers alive": figure(now.workers),
    }),
    now.workers ? null : h("p", { class: "problem" }, "No worker is alive: jobs wait until ", h("code", {}, "amers worker"), " runs."),
    h("h2", {}, "Storage"),
    facts({
      "Disk of the data folder": `${bytes(now.disk_total_bytes - now.disk_free_bytes)} of ${bytes(now.disk_total_bytes)} used`,
      Database: bytes(now.database_bytes),
      "Chips of all blocks": bytes(now.chip_bytes),
      "Files of all owners": bytes(owners.reduce((sum, owner) => sum + owner.total_bytes, 0)),
      "Points served": figure(now.points_served),
      "Damaged files": figure(now.damaged_files),
    }),
    h("h2", {}, "Owners"),
    owners.length ? h("ul", { class: "list story", "aria-label": "Owners" }, ...owners.map(row)) : h("p", { class: "quiet" }, "No stored data yet: nobody has sent a scene or made a job."),
    h("p", {}, h("button", { type: "button", onclick: () => void change(async () => "The figures are new.") }, "Refresh")),
  );
};

function row(owner: OwnerUsage): HTMLElement {
  const quota = owner.quota_bytes == null ? "no quota" : `of ${bytes(owner.quota_bytes)}`;
  return h(
    "li",
    {},
    h("strong", {}, owner.name),
    h("span", { class: "figures" }, `${bytes(owner.total_bytes)} ${quota}`),
    h("span", { class: "quiet" }, `${figure(owner.scenes)} scenes · ${figure(owner.jobs)} jobs · ${figure(owner.open_uploads)} open uploads`),
  );
}

/** A time in its largest fitting unit. */
function duration(seconds: number): string {
  if (seconds < 100) return figure(Math.round(seconds), "s");
  return seconds < 2 * HOUR_S ? figure(Math.round(seconds / 60), "min") : figure(seconds / HOUR_S, "h");
}
