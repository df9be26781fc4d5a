// The frame of the page: the person, the connection, and the screen.

import { ApiError, command, get, operator } from "./api.js";
import { askName, confirm, signIn } from "./dialogs.js";
import { fill, h, say } from "./dom.js";
import { Live } from "./live.js";
import { duration } from "./words.js";

const SCREENS = { now: "Now", guide: "Guide", session: "Session", models: "Models", health: "Health", history: "History" };
const OLD_S = 2;

const $ = (id) => document.getElementById(id);

class App {
  constructor() {
    this.me = { name: "", role: null };
    this.screen = null;
  }

  async start() {
    this.#listen();
    this.me = await this.#who();
    if (this.me.role === null) this.me = await signIn($("dialog"));
    this.#showPerson();
    this.live = new Live({ onState: () => this.update(), onRefused: () => location.reload() });
    await this.show(location.pathname.slice(1) || "now");
  }

  async #who() {
    for (;;) {
      try {
        return await get("/api/me");
      } catch (error) {
        this.#connection(error.message, false);
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
    }
  }

  // ---- screens -----------------------------------------------------------------------------------------------------

  /** Show a screen by its name. */
  async show(name, { focus = false } = {}) {
    const wanted = name in SCREENS ? name : "now";
    this.screen?.close?.();
    this.screen = null;
    const { mount } = await import(`./screens/${wanted}.js`);
    for (const link of document.querySelectorAll("nav a")) {
      if (link.pathname === `/${wanted}`) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    document.title = `${SCREENS[wanted]} \u00b7 rigcal`;
    say($("title"), SCREENS[wanted]);
    const root = h("div", { class: "stack", id: "screen" });
    $("screen").replaceWith(root);
    this.screen = mount(root, this);
    this.name = wanted;
    this.update();
    if (focus) { $("main").scrollTop = 0; $("main").focus({ preventScroll: true }); }
  }

  /** Go to a screen, as a tap on its name does. */
  go(name) {
    history.pushState(null, "", `/${name}`);
    return this.show(name, { focus: true });
  }

  update() {
    const { live } = this;
    if (!live) return;
    document.body.dataset.live = live.isLive ? "yes" : "no";
    const since = live.state && live.age > OLD_S ? `; the data shown are ${duration(live.age)} old` : "";
    this.#connection(live.isLive ? "live" : `${live.trouble}${since}`, live.isLive);
    if (live.state) {
      say($("rig"), live.state.rig);
      this.screen?.update(live.state);
    }
  }

  #connection(text, isLive) {
    const banner = $("banner");
    banner.hidden = isLive || text === "connecting";
    const first = text.charAt(0).toUpperCase() + text.slice(1);
    say($("connection-text"), isLive ? `Live${this.live.state?.mode === "live" ? "" : `, ${this.live.state?.mode ?? ""}`}` : "Not live");
    if (!banner.hidden) say(banner, `${first}.`);
  }

  // ---- people ------------------------------------------------------------------------------------------------------

  may(role) {
    const order = ["read", "operate", "approve"];
    return order.indexOf(this.me.role) >= order.indexOf(role);
  }

  #showPerson() {
    const name = this.me.by_token ? this.me.name : operator.name || this.me.local_user || "no name";
    say($("person-name"), `${name} (${this.me.role})`);
    $("person").setAttribute("aria-label", `Who you are: ${name}, role ${this.me.role}`);
  }

  // ---- commands ----------------------------------------------------------------------------------------------------

  /** Carry out a command and show its result; null if it failed. */
  async run(name, args, done = "Done") {
    try {
      const result = await command(name, args);
      this.toast(typeof result === "string" ? result : done);
      return result ?? true;
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      this.toast(error.message, true);
      return null;
    }
  }

  /** Ask for confirmation. `about` is a list of sentences: the reasons. */
  confirm(title, about, button, options) { return confirm($("dialog"), title, about, button, options); }

  toast(text, bad = false) {
    const toast = $("toast");
    toast.className = `toast shown${bad ? " bad" : ""}`;
    say(toast, text);
    clearTimeout(this.toasting);
    this.toasting = setTimeout(() => { toast.className = "toast"; toast.textContent = ""; }, bad ? 12000 : 5000);
  }

  /** A button that sends a command; null for a person whose role is too low. */
  button(text, role, act, kind = "") {
    if (!this.may(role)) return null;
    return h("button", { type: "button", class: kind, "data-key": text, onclick: async (event) => {
      const button = event.currentTarget;
      if (button.getAttribute("aria-disabled")) return;
      button.setAttribute("aria-disabled", "true");
      try { await act(); } finally { button.removeAttribute("aria-disabled"); }
    } }, text);
  }

  /** A value with its age: grey and labelled once its data are older than 2 s, or the page is not live. */
  aged(element, text, age) {
    const old = age === null || age > OLD_S || !this.live.isLive;
    element.classList.toggle("old", old);
    fill(element, [text, old && age !== null ? duration(age) : null], () => [
      text, old && age !== null ? h("span", { class: "age" }, ` ${duration(age)} old`) : null,
    ]);
  }

  #listen() {
    addEventListener("popstate", () => {
      const name = location.pathname.slice(1) || "now";
      if (name !== this.name) this.show(name, { focus: true });  // otherwise a link within the screen was followed
    });
    document.addEventListener("click", (event) => {
      const link = event.target.closest("a[href]");
      if (!link || link.target || link.origin !== location.origin || event.ctrlKey || event.metaKey) return;
      const name = link.pathname.slice(1);
      if (link.hash || !(name in SCREENS)) return;
      event.preventDefault();
      this.go(name);
    });
    $("person").addEventListener("click", async () => {
      if (await askName($("dialog"), this.me)) location.reload();
      this.#showPerson();
    });
  }
}

new App().start();
