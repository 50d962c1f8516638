// What the page does for all its views: lead to another, announce, wait.

export function go(address: string): void {
  location.hash = address;
}

/** Mark a section of the menu as the one that is shown. */
export function markSection(name: string): void {
  for (const link of document.querySelectorAll("header a")) {
    if (link.getAttribute("href") === `#/${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

/** Show a short message, which screen readers read aloud. */
export function announce(text: string): void {
  document.getElementById("status")!.textContent = text;
}

/** Wait, or stop at once when the signal aborts. */
export function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason as Error);
    });
  });
}
