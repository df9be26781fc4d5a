// Dialogs: confirmation with reasons, signing in, and the person's name. A dialog keeps the focus and Escape closes it.

import { operator, post } from "./api.js";
import { h } from "./dom.js";

function opened(dialog, content) {
  dialog.replaceChildren(content);
  if (!dialog.open) dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
}

/**
 * Ask for confirmation of an action.
 * @param reasons sentences for and against it
 * @param options kind of the button; `reason` asks for a text, with choices to tap
 * @returns null if it was not confirmed, else the reason ("" if none is required)
 */
export async function confirm(dialog, title, reasons, button, { kind = "main", reason = null } = {}) {
  let answer = null;
  const text = reason && h("input", { id: "reason", maxlength: "200", required: true, list: "reasons", autocomplete: "off", value: reason[0] });
  const content = h("form", { onsubmit: (event) => { event.preventDefault(); answer = text ? text.value.trim() : ""; dialog.close(); } },
    h("h2", { id: "dialog-title" }, title),
    reasons.length === 1 ? h("p", null, reasons[0]) : h("ul", { class: "reasons" }, reasons.map((each) => h("li", null, each))),
    text && h("label", { for: "reason" }, "Reason", text),
    text && h("div", { class: "choices row" }, reason.map((each) => h("button", { type: "button", onclick: () => { text.value = each; } }, each))),
    h("div", { class: "row" },
      h("button", { type: "button", onclick: () => dialog.close() }, "Back"),
      h("button", { class: kind }, button)));
  await opened(dialog, content);
  return answer;
}

/** Ask for a token until a valid one is entered; the page shows nothing before. */
export async function signIn(dialog) {
  for (;;) {
    let person = null;
    const fault = h("p", { class: "fault", role: "alert" });
    const token = h("input", { id: "token", type: "password", autocomplete: "current-password", required: true });
    await opened(dialog, h("form", { onsubmit: async (event) => {
      event.preventDefault();
      try {
        person = { ...(await post("/api/login", { token: token.value })), by_token: true };
        dialog.close();
      } catch (error) { fault.textContent = error.message; }
    } },
    h("h2", { id: "dialog-title" }, "Sign in to this rig"),
    h("label", { for: "token" }, "Token", h("span", { class: "soft" }, "You get one from the administrator of rigcal."), token),
    fault,
    h("div", { class: "row" }, h("button", { class: "main" }, "Sign in"))));
    if (person !== null) return person;
  }
}

/** Show who the person is: change the name, sign in or out. Returns true if the page must be reloaded. */
export async function askName(dialog, me) {
  let changed = false;
  const name = h("input", { id: "name", maxlength: "60", autocomplete: "name", value: operator.name || me.local_user || "" });
  const token = h("input", { id: "token", type: "password", autocomplete: "current-password" });
  const fault = h("p", { class: "fault", role: "alert" });
  const act = async (path, body) => {
    try {
      await post(path, body);
      changed = true;
      dialog.close();
    } catch (error) { fault.textContent = error.message; }
  };
  const body = me.by_token
    ? h("p", null, `You are ${me.name}, with the role ${me.role}. Your actions are recorded under this name.`)
    : [
      h("p", null, `You opened this page without a token and have the role ${me.role}.`),
      h("label", { for: "name" }, "Your name", h("span", { class: "soft" }, "recorded with your actions"), name),
      h("label", { for: "token" }, "Token", h("span", { class: "soft" }, "only if you want to sign in as someone else"), token),
    ];
  await opened(dialog, h("form", { onsubmit: (event) => {
    event.preventDefault();
    if (!me.by_token) operator.name = name.value.trim();
    if (!me.by_token && token.value) act("/api/login", { token: token.value });
    else dialog.close();
  } },
  h("h2", { id: "dialog-title" }, "Who you are"), body, fault,
  h("div", { class: "row" },
    me.by_token ? h("button", { type: "button", onclick: () => act("/api/logout", {}) }, "Sign out") : null,
    h("button", { class: "main" }, "Close"))));
  return changed;
}
