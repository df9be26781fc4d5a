// The form that starts a guide: all fields are filled in, so that one tap is enough.

import { command, get } from "./api.js";
import { h } from "./dom.js";

export function startForm(app, now) {
  const card = h("section", { class: "card", "aria-labelledby": "start-title" }, h("h2", { id: "start-title" }, "Start a guided session"));
  if (!app.may("operate")) {
    card.append(h("p", { class: "soft" }, "An operator starts it; you can follow its progress here."));
    return card;
  }
  if (now.session) {
    card.append(h("p", null, `Session ${now.session.id} is open; it must be ended before a guide starts.`), h("a", { class: "button", href: "/session" }, "Go to the session"));
    return card;
  }
  const body = h("p", { class: "soft" }, "Reading the data of the rig\u2026");
  card.append(body);
  Promise.all([command("setup.list"), get("/api/rig")])
    .then(([setups, shape]) => body.replaceWith(form(app, setups, shape)), (error) => body.replaceWith(h("p", { class: "fault" }, error.message)));
  return card;
}

function form(app, setups, shape) {
  const current = setups.find((setup) => setup.is_current);
  const stands = current?.state === "ok";
  const taken = new Set(setups.map((setup) => setup.id));
  let free = setups.length + 1;
  while (taken.has(`S${free}`)) free++;
  const radio = (value, checked) => h("input", { type: "radio", name: "setup", value, checked });
  const field = (id, attributes) => h("input", { id, autocomplete: "off", ...attributes });
  const name = field("setup-name", { value: `S${free}`, maxlength: "64", pattern: "[A-Za-z0-9][A-Za-z0-9._\\-]*" });
  const instrument = field("instrument", { value: current?.instrument ?? "", maxlength: "200" });
  const points = field("points", { value: current?.control_points.map((point) => point.name).join(", ") || "cp1", required: true });
  const target = field("target", { type: "number", min: "0.01", step: "any", inputmode: "decimal" });
  const prisms = Object.keys(shape.chains).map((prism) => h("label", { class: "choice" }, h("input", { type: "checkbox", name: "prism", value: prism, checked: true }), `Prism ${prism}`));
  const fault = h("p", { class: "fault", role: "alert" });
  const anew = h("div", { class: "pair" }, h("label", { for: "setup-name" }, "Name of the new set-up", name), h("label", { for: "instrument" }, "Instrument", instrument));
  anew.hidden = stands;
  const choose = (event) => { anew.hidden = event.target.value !== "new"; };
  const where = h("fieldset", { onchange: choose }, h("legend", null, "Where does the station stand?"),
    stands ? h("label", { class: "choice" }, radio("same", true), `As before: set-up ${current.id}`) : null,
    h("label", { class: "choice" }, radio("new", !stands), current ? "It was moved or set up again" : "It was just set up"), anew);

  async function start(event) {
    event.preventDefault();
    const data = new FormData(event.target);
    const args = { prisms: data.getAll("prism"), control_points: points.value.split(/[,\s]+/).filter(Boolean) };
    if (!args.prisms.length) { fault.textContent = "Choose one prism or more."; return; }
    if (target.value) args.target_mm = Number(target.value);
    if (data.get("setup") === "new") args.new_setup = { id: name.value.trim(), instrument: instrument.value.trim() };
    else args.setup = current.id;
    const button = event.submitter;
    button.disabled = true;
    try { await command("guide.start", args); } catch (error) { fault.textContent = error.message; }
    button.disabled = false;
  }

  return h("form", { class: "stack", onsubmit: start },
    h("button", { class: "huge main" }, "Start"), fault, where,
    h("fieldset", null, h("legend", null, "Which prisms?"), h("div", { class: "choices" }, prisms)),
    h("div", { class: "pair" },
      h("label", { for: "points" }, "Control points", h("span", { class: "soft" }, "fixed points near the rig"), points),
      h("label", { for: "target" }, "Target in mm", h("span", { class: "soft" }, "leave empty to continue as long as poses help"), target)));
}
