// A question before a change that cannot be undone, or that others notice.

import { fill, h } from "./elements";

interface Confirmation {
  title: string;
  /** What will happen. */
  text: string;
  /** The word on the button that does it. */
  act: string;
  /** A field that has to be filled; `mustBe`: with exactly this text. */
  field?: { label: string; value?: string; mustBe?: string };
}

/** Ask in a dialog; the text of its field, "" without a field, or null if the user does not want it.
 *
 * The browser keeps the focus in the dialog and gives it back to where it was.
 */
export function ask({ title, text, act, field }: Confirmation): Promise<string | null> {
  const input = h("input", { id: "answer", value: field?.value, required: true, autocomplete: "off", spellcheck: false, oninput: check });
  const yes = h("button", { type: "submit", class: "strong" }, act);
  const dialog = h("dialog", { "aria-labelledby": "question" });
  const form = h(
    "form",
    { method: "dialog", onsubmit: () => dialog.close("yes") },
    h("h2", { id: "question" }, title),
    h("p", {}, text),
    field ? h("label", { for: "answer" }, field.label) : null,
    field ? input : null,
    h("div", { class: "state" }, yes, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel")),
  );
  fill(dialog, form);
  check();
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes" ? (field ? input.value.trim() : "") : null);
    });
  });

  function check(): void {
    yes.disabled = field?.mustBe !== undefined && input.value.trim() !== field.mustBe;
  }
}
