// What a view of the page gets.

import type { Atlas } from "./atlas";

export interface Place {
  panel: HTMLElement;
  atlas: Atlas;
  /** Aborts when another view is shown. */
  signal: AbortSignal;
  /** The caller's scopes; empty for the public. */
  scopes: string[];
}
/** Fills the panel; the word after the view's name in the address is its argument. */
export type ShowView = (place: Place, argument: string) => Promise<void>;

/** A view of the administration, below the links; `h1` has the title. */
export type ShowPart = (part: Part) => Promise<void>;

export interface Part {
  /** The element below the title. */
  content: HTMLElement;
  signal: AbortSignal;
  /** Carry out a change, then show the view again with the focus on its title; an error becomes a sentence. */
  change: (act: () => Promise<string>) => Promise<void>;
}
