// The service as the page asks it: a bearer token kept for this tab only, errors in the service's own words.

import type { Feature, FeatureCollection, Geometry, Point, Polygon } from "geojson";

const TOKEN = "amers-token";

/** Where the service is: the page lies at `map` below it. */
export const BASE = new URL(".", location.href.replace(/[?#].*$/, "")).href;

export type Verdict = "good" | "uncertain" | "failed" | (string & {});

export interface BlockProperties {
  id: string;
  version: string;
  title: string;
  state: "staged" | "published" | "withdrawn" | (string & {});
  n_points: number;
  n_views: number;
  created_at: string;
  state_changed_at: string;
}
/** Its id is the number of the version, that of its properties the name of the block. */
export type BlockFeature = Feature<Polygon, BlockProperties>;

export interface View {
  gsd_m: number;
  image_id?: string;
  sensor?: string;
  acquired_at?: string;
  incidence_deg?: number;
}
export interface PointProperties {
  block?: string;
  sigma_east_m?: number;
  sigma_north_m?: number;
  sigma_up_m?: number;
  saliency?: number;
  n_views?: number;
  views?: View[];
}
export type PointFeature = Feature<Point, PointProperties>;
export type Page<Kind extends Feature> = Omit<FeatureCollection, "features"> & { features: Kind[]; numberMatched?: number };

export interface Scene {
  id: string;
  name: string;
  state: string;
  file: string;
  models: string[];
  size_bytes: number;
  sigma_m: number | null;
  footprint: Geometry | null;
  created: string;
  removed: string | null;
}

export interface Job {
  jobID: string;
  processID: string;
  status: "accepted" | "running" | "successful" | "failed" | "dismissed";
  progress: number;
  message: string | null;
  created: string;
  started: string | null;
  finished: string | null;
  error?: { title: string; detail: string };
  inputs?: { scene?: string };
  "amers:queuePosition"?: number;
  "amers:estimatedEnd"?: string;
}

export interface Result {
  href: string;
  type: string;
  title: string;
}

/** A reply that is not what was asked for; the message is the service's. */
export class Refused extends Error {
  constructor(
    readonly status: number,
    message: string,
  ) {
    super(message);
  }
}

export function token(): string | null {
  return sessionStorage.getItem(TOKEN);
}

/** Keep a token until the tab is closed, or forget it. */
export function setToken(secret: string | null): void {
  if (secret) sessionStorage.setItem(TOKEN, secret);
  else sessionStorage.removeItem(TOKEN);
}

export function authorization(): Record<string, string> {
  const secret = token();
  return secret ? { Authorization: `Bearer ${secret}` } : {};
}

/** A path or an address of the service; others are refused, for the token goes with the request. */
export function address(path: string): string {
  const url = new URL(path, BASE);
  if (url.origin !== location.origin) throw new Error(`${url.origin} is not this service`);
  return url.href;
}

export async function call(path: string, request: RequestInit = {}): Promise<Response> {
  const headers = { Accept: "application/json", ...authorization(), ...request.headers };
  let reply: Response;
  try {
    reply = await fetch(address(path), { ...request, headers });
  } catch (error) {
    if (request.signal?.aborted) throw error;
    throw new Refused(0, "The service does not answer.");
  }
  if (!reply.ok) throw new Refused(reply.status, await reason(reply));
  return reply;
}

export async function get<Kind>(path: string, signal?: AbortSignal): Promise<Kind> {
  return (await call(path, signal ? { signal } : {})).json() as Promise<Kind>;
}

export async function post<Kind>(path: string, body?: unknown): Promise<Kind> {
  const content = body === undefined ? {} : { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  return (await call(path, { method: "POST", ...content })).json() as Promise<Kind>;
}

/** A file of the service as an address an image or a link can show; released when the signal says so. */
export async function blobUrl(path: string, signal: AbortSignal): Promise<string> {
  const url = URL.createObjectURL(await (await call(path, { signal, headers: { Accept: "*/*" } })).blob());
  signal.addEventListener("abort", () => URL.revokeObjectURL(url));
  return url;
}

async function reason(reply: Response): Promise<string> {
  try {
    const told = (await reply.json()) as { detail?: string; title?: string };
    return told.detail ?? told.title ?? reply.statusText;
  } catch {
    return `${reply.status} ${reply.statusText}`;
  }
}
