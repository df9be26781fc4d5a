// Now: the state, the next step, the main figures, and the alarms.

import { fill, h, say, tile } from "../dom.js";
import { alarmList } from "../alarms.js";
import { fixed, millimetres, percent, planned, plural } from "../words.js";

export function mount(root, app) {
  const state = h("span", { role: "status", "aria-live": "polite" });
  const step = h("p", { id: "step" });
  const action = h("div", { id: "action" });
  const card = h("section", { class: "card state", "aria-label": "State and next step" }, h("h2", { id: "state" }, state), step, action);
  const tiles = h("dl", { class: "tiles", "aria-label": "Figures" });
  const alarms = h("section", { class: "card stack", "aria-labelledby": "alarms-title" });
  root.append(card, tiles, alarms);

  return {
    update(now) {
      const { next } = now;
      card.className = `card state tone-${next.tone}`;
      say(state, next.state);
      say(step, next.step);
      fill(action, [next.button, next.command, next.arguments, next.screen, app.me.role], () => button(app, next));
      const figures = figuresOf(now);
      fill(tiles, figures, () => figures.map((each) => tile(...each)));
      fill(alarms, [now.alarms.active.map((a) => [a.kind, a.subject, a.severity, a.text]), minute(now)], () => alarmList(now, app));
    },
  };
}

const minute = (now) => now.alarms.active.map((alarm) => Math.floor(alarm.age_s / 60));

/** The one large button: the next step according to the daemon. */
export function button(app, next) {
  if (!next.button) return null;
  if (next.screen) return h("button", { type: "button", class: "huge main", "data-key": "next", onclick: () => app.go(next.screen) }, next.button);
  if (!app.may("operate")) return h("p", { class: "soft" }, `The operator's next action: ${next.button}.`);
  return app.button(next.button, "operate", () => app.run(next.command, next.arguments), "huge main");
}

function figuresOf({ guide, session, models, control_shots: shots, gap }) {
  const open = guide?.state === "open" ? guide : null;
  const found = [];
  if (open?.prism || session) found.push(["Prism", open?.prism ?? session.prism, "", open?.session_kind === "check" || session?.kind === "check" ? "a check" : ""]);
  if (open?.poses) found.push(planned(open.poses));
  else if (session) found.push(["Poses measured", String(session.poses), "", plural(session.observations, "fix", "fixes")]);
  if (open?.coverage) found.push(["Coverage", percent(open.coverage.prism_volume_share ?? open.coverage.volume_share), "", "of the work volume"]);
  if (open?.accuracy) found.push(["Expected accuracy", millimetres(open.accuracy.now_mm), "mm", open.accuracy.target_mm ? `target ${millimetres(open.accuracy.target_mm)} mm` : `after 5 more ${millimetres(open.accuracy.after_5_mm)} mm`]);
  const worst = Math.max(...shots.map((shot) => shot.misclosure_mm ?? -1));
  const misclosure = open?.misclosure_mm ?? (worst >= 0 ? worst : null);
  if (misclosure !== null) found.push(["Misclosure", fixed(misclosure, 1), "mm", "of the control points"]);
  if (!open && !session) {
    found.push(["Live model", models?.live ? String(models.live.id) : "none", "", models?.live?.stage ?? ""]);
    const drift = gap?.drift;
    if (drift?.checks) found.push(["Last check", fixed(drift.ratio, 2), "", "error divided by the expected error; 1 is as predicted"]);
  }
  return found;
}
