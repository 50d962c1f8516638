// Requests of the page to the service: a bearer token kept for this tab only, errors in the service's own words.

import type { BlockFeature, PointFeature, PointHistoryFeature, Problem } from "./api_types";

const TOKEN = "amers-token";

/** The address of the service: the page lies at `map` below it. */
export const BASE = new URL(".", location.href.replace(/[?#].*$/, "")).href;

/** A feature with all properties; only requests with the parameter `properties` get fewer. */
type Complete<Kind extends { properties: object }> = Omit<Kind, "properties"> & { properties: Required<Kind["properties"]> };

/** Its `id` is the number of the version, that of its properties the name of the block. */
export type Block = Complete<BlockFeature>;
export type PointOfPage = Complete<PointFeature>;
export type PointHistory = Complete<PointHistoryFeature>;

export interface FeaturePage<Kind> {
  features: Kind[];
  numberMatched: number;
}

/** A reply with an error status; the message is the service's. */
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

/** The address of a path of the service; other services are refused, because the request carries the token. */
export function address(path: string): string {
  const url = new URL(path, BASE);
  if (url.origin !== location.origin) throw new Error(`${url.origin} is not this service`);
  return url.href;
}

/** The reply to a request; an error status is thrown as `Refused`. */
export async function call(path: string, request: RequestInit = {}): Promise<Response> {
  const headers = { Accept: "application/json", ...authorization(), ...request.headers };
  let reply: Response;
  try {
    // Without credentials that the browser keeps: it would ask for a password when it has none.
    reply = await fetch(address(path), { ...request, headers, credentials: "omit" });
  } catch (error) {
    if (request.signal?.aborted) throw error;
    throw new Refused(0, "The service does not answer.");
  }
  if (!reply.ok) throw new Refused(reply.status, await reason(reply));
  return reply;
}

/** The JSON of a path. */
export async function get<Kind>(path: string, signal?: AbortSignal): Promise<Kind> {
  return (await call(path, signal ? { signal } : {})).json() as Promise<Kind>;
}

/** The JSON of the reply to a POST. */
export async function post<Kind>(path: string, body?: unknown): Promise<Kind> {
  const content = body === undefined ? {} : { body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  return (await call(path, { method: "POST", ...content })).json() as Promise<Kind>;
}

/** Remove what a path names. */
export async function remove(path: string): Promise<void> {
  await call(path, { method: "DELETE" });
}

/** A file of the service at an address for an image or a link, valid until the signal aborts. */
export async function blobUrl(path: string, signal: AbortSignal): Promise<string> {
  const url = URL.createObjectURL(await (await call(path, { signal, headers: { Accept: "*/*" } })).blob());
  signal.addEventListener("abort", () => URL.revokeObjectURL(url));
  return url;
}

async function reason(reply: Response): Promise<string> {
  try {
    const { detail, title } = (await reply.json()) as Partial<Problem>;
    return detail ?? title ?? reply.statusText;
  } catch {
    return `${reply.status} ${reply.statusText}`;
  }
}
