// History: drift over months, check shots compared with the model that was live, control points, changes of models.

import { get } from "../api.js";
import { Chart } from "../chart.js";
import { fill, h, table } from "../dom.js";
import { duration, fixed, utc, words } from "../words.js";

const AGAIN_MS = 15000;

export function mount(root) {
  const drift = new Chart("Error of check shots divided by the error that the live model expects, over time", "", [{ label: "check session", colour: "blue" }, { label: "as expected", colour: "control", line: true, dash: [6, 5] }], "");
  const sums = new Chart("Cumulative sum that shows a lasting drift, over time, with its limit", "", [{ label: "worse than expected", colour: "critical", line: true, dots: true }, { label: "drift", colour: "control", line: true, dash: [6, 5] }], "There is no sum before the first check session against a live model.");
  const closure = new Chart("Misclosure of control points over time", "mm", [{ label: "misclosure", colour: "blue" }], "No known control point was measured again yet.");
  const part = (id, title, about, chart, rest) => h("section", { class: "card stack", "aria-labelledby": id }, h("h2", { id }, title), about ? h("p", { class: "soft" }, about) : null, chart?.element ?? "", rest ?? "");
  const driftTable = h("div"), closureTable = h("div"), changes = h("div"), alarms = h("div"), sentence = h("p");
  const checkByCheck = h("details", { hidden: true }, h("summary", null, "Check by check"), driftTable);
  const shotByShot = h("details", { hidden: true }, h("summary", null, "Shot by shot"), closureTable);
  root.append(
    part("drift-title", "Does the model still hold?", "Each dot is a check session: the error of its fixes, divided by the error that the live model of that time expects. 1 is as expected.", drift, h("div", { class: "stack" }, sentence, checkByCheck)),
    part("sums-title", "Drift over months", "Errors that are repeatedly larger than expected add up; above the dashed line the machine has changed.", sums),
    part("closure-title", "Control points", "Distance of each control point from its known place. 5 mm or more means that the station has moved.", closure, shotByShot),
    part("changes-title", "Model changes", "", null, changes),
    part("past-title", "Past alarms", "", null, alarms));

  let timer = null, closed = false;
  async function read() {
    clearTimeout(timer);
    try {
      const found = await get("/api/history");
      if (!closed) show(found);
    } catch (error) { fill(sentence, error.message, () => h("span", { class: "fault" }, error.message)); }
    if (!closed) timer = setTimeout(read, AGAIN_MS);
  }

  function show({ drift: checks, misclosures, changes: changed, alarms: past, gap }) {
    const rated = checks.filter((check) => check.ratio !== null);
    const at = (list) => list.map((each) => each.utc_ns / 1e9);
    const decision = gap?.drift?.decision ?? null;
    drift.show([at(rated), rated.map((check) => check.ratio), rated.map(() => 1)]);
    sums.show([at(checks), checks.map((check) => check.upper), checks.map(() => decision)]);
    checkByCheck.hidden = !checks.length;
    shotByShot.hidden = !misclosures.length;
    closure.show([at(misclosures), misclosures.map((shot) => shot.misclosure_mm)]);
    const empty = "No check session was compared with a live model yet; a guided session ends with a check session.";
    fill(sentence, gap?.drift ?? empty, () => h("span", null, gap?.drift?.checks ? driftSentence(gap.drift) : empty));
    fill(driftTable, checks, () => table("Check sessions, the newest first", [["when", true], ["session", true], ["model", false], ["fixes", false], ["error / expected", false], ["verdict", true]],
      checks.toReversed().map((check) => [utc(check.utc_ns), check.session, String(check.model), String(check.fixes), fixed(check.ratio, 2), check.reason || { none: "as expected", worse: "worse", better: "better" }[check.alarm]])));
    fill(closureTable, misclosures, () => table("Shots of control points, the newest first", [["when", true], ["point", true], ["set-up", true], ["session", true], ["misclosure, mm", false]],
      misclosures.toReversed().map((shot) => [utc(shot.utc_ns), shot.point, shot.setup, `${shot.session}, ${shot.phase}`, fixed(shot.misclosure_mm, 1)])));
    fill(changes, changed, () => changed.length ? table("Every change of a model's state, the newest first", [["when", true], ["model", false], ["state", true], ["by", true], ["why", true]],
      changed.toReversed().map((change) => [utc(change.utc_ns), String(change.model), change.state, change.operator || change.user || "rigcal", change.reason])) : h("p", { class: "empty" }, "No model was made yet."));
    fill(alarms, past, () => past.length ? table("Past alarms, the newest first", [["from", true], ["for", false], ["alarm", true]],
      past.slice(0, 50).map((alarm) => [utc(alarm.since_utc_ns), duration((alarm.cleared_utc_ns - alarm.since_utc_ns) / 1e9), `${words(alarm.kind)}, ${alarm.subject}: ${alarm.text}`])) : h("p", { class: "empty" }, "None yet."));
  }

  read();
  return { update() {}, close() { closed = true; clearTimeout(timer); for (const chart of [drift, sums, closure]) chart.close(); } };
}

function driftSentence(drift) {
  if (drift.alarm === "worse") return `Check shots drift from model ${drift.model} since session ${drift.drifted_with}: measure again.`;
  return `Model ${drift.model} holds: ${drift.checks} check sessions so far; the error of the last was ${fixed(drift.ratio, 2)} times the expected error.`;
}
