// Lists of the service that come in pages: each page has a link `next` to the one that follows it.

import { get } from "./api";
import type { Link } from "./api_types";

export interface RowsOfPage<Row> {
  rows: Row[];
  /** Reads the page that follows; null on the last one. */
  following: Following<Row> | null;
}

export type Following<Row> = () => Promise<RowsOfPage<Row>>;

/** A page of a list, such as `scenes?limit=1000`; `name` is the member of the reply that has the rows. */
export async function pageOf<Name extends string, Row>(path: string, name: Name, signal: AbortSignal): Promise<RowsOfPage<Row>> {
  const reply = await get<Record<Name, Row[]> & { links: Link[] }>(path, signal);
  const next = reply.links.find(({ rel }) => rel === "next");
  const list = path.split("?")[0]!;
  return { rows: reply[name], following: next ? () => pageOf(list + new URL(next.href).search, name, signal) : null };
}

/** The rows of all pages of a list. */
export async function everyRow<Name extends string, Row>(path: string, name: Name, signal: AbortSignal): Promise<Row[]> {
  let page = await pageOf<Name, Row>(path, name, signal);
  const rows = [...page.rows];
  while (page.following) {
    page = await page.following();
    rows.push(...page.rows);
  }
  return rows;
}
