// Alarms, each with its remedy, and with a button if the page can carry it out.

import { h } from "./dom.js";
import { duration, words } from "./words.js";

const ACTIONS = {
  prism_jump: ["It is the right prism", "operate", "session.confirm-prism"],
  zero_lost: ["The zeros are checked", "approve", "model.zeros-checked"],
};

export function alarmList(now, app) {
  const { active, looked_age_s: looked } = now.alarms;
  const late = looked * (now.time.real_s_per_s || 1) > 30;
  return [
    h("h2", { id: "alarms-title" }, active.length ? `Alarms (${active.length})` : "No alarms"),
    late ? h("p", { class: "bad" }, `The daemon is delayed: alarms were last checked ${duration(looked)} ago.`) : null,
    Object.entries(now.unreadable).map(([part, why]) => h("p", { class: "bad" }, `${words(part)} cannot be read from the store: ${why}`)),
    active.length ? h("ul", { class: "alarms" }, active.map((alarm) => alarmItem(alarm, app))) : h("p", { class: "soft" }, "Everything that rigcal monitors is in order."),
  ];
}

/** One alarm, as an entry of a list. */
export function alarmItem(alarm, app) {
  const action = ACTIONS[alarm.kind];
  return h("li", { class: `alarm ${alarm.severity}`, "data-kind": alarm.kind },
    h("h3", null, `${alarm.severity === "critical" ? "Critical" : "Warning"}: ${words(alarm.kind)}, ${alarm.subject}`),
    h("p", null, `${alarm.text} (for ${duration(alarm.age_s)})`),
    h("p", null, h("strong", null, "What to do: "), alarm.remedy),
    action && app.may(action[1]) ? h("div", { class: "row" }, app.button(action[0], action[1], () => app.run(action[2], {}))) : null);
}
