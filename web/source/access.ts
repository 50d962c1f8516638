// Signing in: a bearer token, kept in this tab until it is closed.

import { get, Refused, setToken, token } from "./api";
import { fill, h, problem } from "./elements";
import type { ShowView } from "./place";

export interface Caller {
  name: string;
  scopes: string[];
}
const INCLUDED: Record<string, string[]> = {
  read: ["read"],
  register: ["read", "register"],
  admin: ["read", "register", "admin"],
};

/** Whose token this tab holds, with all scopes it includes; null without one. */
export async function whoCalls(): Promise<Caller | null> {
  if (!token()) return null;
  try {
    const { name, scopes } = await get<Caller>("tokens/self");
    return { name, scopes: [...new Set(scopes.flatMap((scope) => INCLUDED[scope] ?? []))] };
  } catch (error) {
    if (error instanceof Refused && error.status === 401) setToken(null);
    throw error;
  }
}

export const showAccess: ShowView = async ({ panel, scopes }) => {
  if (token()) {
    fill(
    panel,
      h("h1", { tabindex: -1 }, "Signed in"),
      h("p", {}, `This token allows: ${scopes.join(", ")}. It is kept until this tab is closed.`),
      h("p", {}, h("button", { type: "button", onclick: () => enter(null) }, "Sign out")),
    );
    return;
  }
  const secret = h("input", { type: "password", id: "secret", autocomplete: "off", spellcheck: false, required: true });
  const told = h("div");
  fill(
    panel,
    h("h1", { tabindex: -1 }, "Sign in"),
    h("p", {}, "Paste a token. An administrator makes one with ", h("code", {}, "amers token create"), "; it is kept until this tab is closed."),
    h(
      "form",
      { onsubmit: (event) => void submit(event) },
      h("label", { for: "secret" }, "Token"),
      secret,
      h("button", { type: "submit", class: "strong" }, "Sign in"),
      told,
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
      told.replaceChildren(problem(error));
    }
  }
};

/** Start afresh as somebody else; nothing more is shown of what the last caller saw. */
function enter(secret: string | null): void {
  setToken(secret);
  history.replaceState(null, "", "#/points");
  location.reload();
}
