// Sign in: a bearer token, kept in this tab until it is closed.

import { get, Refused, setToken, token } from "./api";
import type { Scope, TokenRecord } from "./api_types";
import { fill, h, problem } from "./elements";
import type { ShowView } from "./view";

export type Caller = Pick<TokenRecord, "name" | "scopes">;
const LOOPBACK = /^(localhost|127\.\d+\.\d+\.\d+|\[::1\])$/;
const INCLUDED: Record<Scope, Scope[]> = {
  read: ["read"],
  monitor: ["monitor"],
  register: ["read", "register"],
  admin: ["read", "register", "monitor", "admin"],
};

/** The caller whose token this tab keeps, with all scopes that it includes; null without a token. */
export async function whoCalls(): Promise<Caller | null> {
  if (!token()) return null;
  try {
    const { name, scopes } = await get<TokenRecord>("tokens/self");
    return { name, scopes: [...new Set(scopes.flatMap((scope) => INCLUDED[scope]))] };
  } catch (error) {
    if (error instanceof Refused && error.status === 401) setToken(null);
    throw error;
  }
}

/**
 * Keep the token of the address that `amers serve` prints, and take it out of the address.
 *
 * Only on this machine: elsewhere a link could sign a reader in as somebody else.
 */
export function takeToken(): void {
  const given = new URLSearchParams(location.hash.slice(1));
  const secret = given.get("token");
  if (!secret || token() || !LOOPBACK.test(location.hostname)) return;
  setToken(secret);
  history.replaceState(null, "", `#${given.get("at") ?? "/points"}`);
}

export const showAccess: ShowView = async ({ panel, scopes }) => {
  if (token()) {
    fill(
      panel,
      h("h1", { tabindex: -1 }, "Signed in"),
      h("p", {}, `This token allows: ${scopes.join(", ")}. This tab keeps it until you close it.`),
      h("p", {}, h("button", { type: "button", onclick: () => enter(null) }, "Sign out")),
    );
    return;
  }
  const secret = h("input", { type: "password", id: "secret", autocomplete: "off", spellcheck: false, required: true });
  const message = h("div");
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Sign in"),
    h("p", {}, "Paste a token. An administrator creates one with ", h("code", {}, "amers token create"), ". This tab keeps it until you close it."),
    h(
      "form",
      { onsubmit: (event) => void submit(event) },
      h("label", { for: "secret" }, "Token"),
      secret,
      h("button", { type: "submit", class: "strong" }, "Sign in"),
      message,
    ),
  );

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    setToken(secret.value.trim());
    try {
      await whoCalls();
      enter(secret.value.trim());
    } catch (error) {
      setToken(null);
      message.replaceChildren(problem(error));
    }
  }
};

/** Load the page again for another caller, without anything that the last caller saw. */
function enter(secret: string | null): void {
  setToken(secret);
  history.replaceState(null, "", "#/points");
  location.reload();
}
