// Tokens: those of all callers, a new one whose secret is shown once, and revocation.

import { get, post, remove } from "./api";
import type { NewTokenRecord, Scope, TokenRecord, TokenRecords } from "./api_types";
import { ask } from "./confirmation";
import { badge, bytes, day, fill, h, problem } from "./elements";
import type { ShowPart } from "./view";

const SCOPES: Record<Scope, string> = {
  read: "points, chips, published blocks",
  register: "the same, and scenes and jobs of its own",
  monitor: "figures for Prometheus, nothing else",
  admin: "everything",
};

export const showTokens: ShowPart = async ({ content, signal, change }) => {
  const own = await get<TokenRecord>("tokens/self", signal);
  const lists = h("div");
  const fillLists = async (): Promise<void> => {
    const { tokens } = await get<TokenRecords>("tokens", signal);
    const valid = tokens.filter((token) => state(token) === "valid");
    const ended = tokens.filter((token) => state(token) !== "valid");
    fill(
      lists,
      h("h2", {}, "Valid"),
      h("ul", { class: "list story", "aria-label": "Valid tokens" }, ...valid.map((token) => row(token, revocation(token)))),
      ended.length
        ? h(
            "details",
            {},
            h("summary", {}, `Revoked or expired: ${ended.length}`),
            h("ul", { class: "list story", "aria-label": "Revoked or expired tokens" }, ...ended.map((token) => row(token))),
          )
        : null,
    );
  };
  await fillLists();
  fill(content, h("p", {}, "Callers of the service, each with what it may do."), tokenForm(fillLists), lists);

  function revocation(token: TokenRecord): HTMLElement {
    return h("button", { type: "button", "aria-label": `Revoke ${token.name}`, onclick: () => void revoke(token) }, "Revoke");
  }

  async function revoke(token: TokenRecord): Promise<void> {
    const warning = token.id === own.id ? " This page is signed in with it." : "";
    const text = `Requests with it are refused from now on. This cannot be undone.${warning}`;
    if ((await ask({ title: `Revoke ${token.name}?`, text, act: "Revoke" })) === null) return;
    await change(async () => {
      await remove(`tokens/${token.id}`);
      return `${token.name} is revoked.`;
    });
  }
};

/** A form for a new token; what it made is shown below it until the view is left. */
function tokenForm(made: () => Promise<void>): HTMLElement {
  const name = h("input", { id: "token-name", required: true, maxlength: 200, autocomplete: "off" });
  const days = h("input", { id: "token-days", type: "number", min: 1, max: 36500, inputmode: "numeric", placeholder: "never" });
  const scopes = (Object.keys(SCOPES) as Scope[]).map((scope) => h("input", { type: "checkbox", value: scope, checked: scope === "read" }));
  const button = h("button", { type: "submit", class: "strong" }, "Create");
  const outcome = h("div", { class: "outcome" });
  const choice = (box: HTMLInputElement) =>
    h("label", { class: "choice" }, box, ` ${box.value} `, h("span", { class: "quiet" }, SCOPES[box.value as Scope]));
  const form = h(
    "form",
    { onsubmit: (event) => void submit(event) },
    h("label", { for: "token-name" }, "Name", h("span", { class: "quiet" }, " of the person or program")),
    name,
    h("fieldset", { class: "choices" }, h("legend", {}, "Scopes"), ...scopes.map(choice)),
    h("label", { for: "token-days" }, "Days until it expires"),
    days,
    button,
    outcome,
  );
  return h("details", { class: "card" }, h("summary", {}, "Create a token"), form);

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    button.disabled = true;
    const body = {
      name: name.value,
      scopes: scopes.filter((box) => box.checked).map((box) => box.value),
      days: days.value ? Number(days.value) : null,
    };
    try {
      const token = await post<NewTokenRecord>("tokens", body);
      const secret = h("input", { id: "new-secret", readonly: true, value: token.secret, class: "secret" });
      fill(
        outcome,
        h("p", {}, `${token.name} is created. Copy its secret now: it is not shown again.`),
        h("label", { for: "new-secret" }, "Secret"),
        secret,
      );
      await made();
      secret.focus();
      secret.select();
      name.value = "";
    } catch (error) {
      outcome.replaceChildren(problem(error));
    } finally {
      button.disabled = false;
    }
  }
}

function row(token: TokenRecord, act: HTMLElement | null = null): HTMLElement {
  const quotas = [
    token.storage_quota_bytes == null ? null : `storage ${bytes(token.storage_quota_bytes)}`,
    token.job_quota == null ? null : `${token.job_quota} jobs at once`,
    token.subject == null ? null : "signs in with OpenID Connect",
  ];
  const dates = [`created ${day(token.created_at)}`, end(token)];
  return h(
    "li",
    {},
    h("strong", {}, token.name),
    ...token.scopes.map((scope) => badge(scope)),
    act,
    h("span", { class: "quiet" }, [...dates, ...quotas].filter(Boolean).join(" · ")),
  );
}

function state({ revoked_at: revoked, expires_at: expires }: TokenRecord): "valid" | "revoked" | "expired" {
  if (revoked) return "revoked";
  return expires && new Date(expires) <= new Date() ? "expired" : "valid";
}

function end(token: TokenRecord): string {
  if (token.revoked_at) return `revoked ${day(token.revoked_at)}`;
  if (!token.expires_at) return "never expires";
  return `${state(token) === "expired" ? "expired" : "expires"} ${day(token.expires_at)}`;
}
