// What every view is given, and where it leads.

import type { Atlas } from "./atlas";

export interface Place {
  panel: HTMLElement;
  atlas: Atlas;
  /** Ends when the reader goes elsewhere. */
  signal: AbortSignal;
  /** The caller's scopes; empty for the public. */
  scopes: string[];
}
/** Fills the panel; the word after the view's name in the address is its argument. */
export type ShowView = (place: Place, argument: string) => Promise<void>;

export function go(address: string): void {
  location.hash = address;
}

/** Tell something in passing, aloud for those who listen. */
export function announce(text: string): void {
  document.getElementById("status")!.textContent = text;
}

/** Wait, or stop waiting at once when the reader goes elsewhere. */
export function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason as Error);
    });
  });
}
