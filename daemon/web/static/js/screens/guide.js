// Guide: the step to do now, the boom and its target, and the gain to expect.

import { get } from "../api.js";
import { Boom } from "../boom.js";
import { alarmItem } from "../alarms.js";
import { bar, fill, h, say, tile } from "../dom.js";
import { startForm } from "../guide_start.js";
import { duration, measured, millimetres, percent, plural, sentence, unitName, words } from "../words.js";

const WHY_SKIP = ["Out of the station's sight", "Not reachable here", "Not safe here"];
const WHY_STOP = ["The station has moved", "The rig is needed for work", "Something is broken"];

export function mount(root, app) {
  const page = h("div");
  root.append(page);
  let shown = null;
  let open = null;

  return {
    update(now) {
      const { guide } = now;
      const which = guide?.state === "open" ? `open ${guide.id}` : "start";
      if (which !== shown) {
        shown = which;
        open = which === "start" ? null : openGuide(app);
        page.replaceChildren(open ? open.element : startPage(app, now));
      }
      open?.update(guide, now.alarms.active.filter((alarm) => alarm.severity === "critical"));
    },
  };
}

function startPage(app, now) {
  const { guide } = now;
  const last = guide && h("section", { class: "card" },
    h("h2", null, guide.state === "finished" ? "The last guide is finished" : "The last guide was abandoned"),
    h("p", null, guide.state === "finished"
      ? guide.model?.id ? `It produced model ${guide.model.id}.` : "Its model is being made; the screen Now shows when it is ready."
      : guide.step?.instruction ?? ""));
  return h("div", { class: "stack" }, last, startForm(app, now));
}

function openGuide(app) {
  const title = h("span", { role: "status", "aria-live": "polite" });
  const instruction = h("p", { class: "instruction", id: "instruction" });
  const why = h("p", { class: "soft" });
  const messages = h("div");
  const alarms = h("ul", { class: "alarms", "aria-label": "Critical alarms" });
  const hold = h("div");
  const main = h("div", { id: "guide-action" });
  const others = h("div", { class: "row" });
  const joints = h("ul", { class: "joints" });
  const views = h("div", { class: "boom" });
  const gain = h("div", { class: "stack" });
  const coverage = h("div", { class: "stack" });
  const steps = h("ol", { class: "steps" });
  const rows = new Map();
  let boom = null;
  get("/api/rig").then((shape) => { boom = new Boom(shape); views.replaceChildren(boom.side.svg, boom.plan.svg); app.update(); },
    (error) => views.replaceChildren(h("p", { class: "bad" }, error.message)));

  const element = h("div", { class: "guide" },
    h("div", { class: "stack" },
      h("section", { class: "card stack", "aria-labelledby": "guide-title" }, h("h2", { id: "guide-title" }, title), instruction, hold, main, alarms, messages, why, others),
      h("section", { class: "card", "aria-labelledby": "joints-title" }, h("h2", { id: "joints-title" }, "Joint by joint"), joints)),
    h("div", { class: "stack" },
      h("section", { class: "card stack", "aria-labelledby": "boom-title" }, h("h2", { id: "boom-title" }, "The boom"),
        h("p", { class: "key" }, h("span", null, "position now"), h("span", null, "target")), views),
      h("section", { class: "card", "aria-labelledby": "gain-title" }, h("h2", { id: "gain-title" }, "Expected gain"), gain),
      h("section", { class: "card", "aria-labelledby": "coverage-title" }, h("h2", { id: "coverage-title" }, "Coverage"), coverage),
      h("section", { class: "card", "aria-labelledby": "steps-title" }, h("h2", { id: "steps-title" }, "The whole job"), steps)));

  return {
    element,
    update(guide, critical) {
      const { step } = guide;
      say(title, step.title);
      say(instruction, step.instruction);
      say(why, step.why ?? "");
      fill(main, [step.id, step.button, step.is_busy, app.me.role], () => mainButton(app, step));
      fill(others, [step.id, step.others, step.can_skip, step.kind, app.me.role], () => otherButtons(app, guide));
      fill(alarms, critical.map((alarm) => [alarm.kind, alarm.subject, alarm.text]), () => critical.map((alarm) => alarmItem(alarm, app)));
      fill(messages, guide.messages, () => guide.messages.map((each) =>
        h("p", { class: each.severity === "warning" ? "alarm" : "soft" }, sentence(each.text))));
      fill(hold, guide.hold, () => holding(guide.hold));
      showJoints(joints, rows, guide.joints, app);
      fill(gain, guide.accuracy, () => gainOf(guide.accuracy));
      fill(coverage, guide.coverage, () => coverageOf(guide.coverage, guide.joints));
      fill(steps, guide.steps, () => guide.steps.map(stepLine));
      if (boom) draw(boom, guide.joints, app);
    },
  };
}

function mainButton(app, step) {
  if (step.is_busy) return h("button", { type: "button", class: "huge", disabled: true, "data-key": "main" }, "Please wait");
  if (!step.button) return null;
  if (!app.may("operate")) return h("p", { class: "soft" }, `The operator's next action: ${step.button}.`);
  const button = app.button(step.button, "operate", () => app.run("guide.done", { step: step.id }), "huge main");
  button.dataset.key = "main";
  return button;
}

function otherButtons(app, guide) {
  const { step } = guide;
  if (!app.may("operate")) return [];
  const skip = async (rest) => {
    const reason = await app.confirm(rest ? "Skip all remaining poses?" : `Skip: ${step.title}?`,
      ["The reason is stored with the guide."], "Skip", { kind: "danger", reason: WHY_SKIP });
    if (reason) await app.run("guide.skip", { step: step.id, reason, ...(rest ? { rest: true } : {}) }, "Skipped");
  };
  const stop = async () => {
    const reason = await app.confirm("Stop this guide?", ["All measurements are kept.", "The guide cannot be resumed."],
      "Stop the guide", { kind: "danger", reason: WHY_STOP });
    if (reason) await app.run("guide.stop", { reason }, "The guide is stopped");
  };
  const others = (step.others ?? []).filter((each) => each.command !== "guide.stop" && each.command !== "guide.skip");
  const isPose = step.kind === "go_to_pose" || step.kind === "hold";
  return [
    others.map((each) => app.button(each.button, "operate", () => app.run(each.command, each.arguments ?? {}))),
    step.can_skip ? app.button("Skip this step", "operate", () => skip(false)) : null,
    step.can_skip && isPose ? app.button("Skip the remaining poses", "operate", () => skip(true)) : null,
    app.button("Stop the guide", "operate", stop, "danger"),
  ];
}

function holding(hold) {
  if (!hold) return null;
  const share = hold.needed_fixes ? hold.fixes / hold.needed_fixes : 0;
  const moves = hold.is_known ? "The boom is moving." : "The joints are not read now.";
  const text = hold.since_s === null ? moves : `Standing for ${duration(hold.since_s)}; ${hold.fixes} of ${plural(hold.needed_fixes, "fix", "fixes")}.`;
  return [h("p", null, text), bar(text, 0, share)];
}

function move(joint) {
  if (joint.now === null) return "unknown";
  if (joint.difference === null) return `${measured(joint.now, joint.unit)}${unitName(joint.unit)}`;
  if (joint.is_there) return "there";
  const size = `${measured(Math.abs(joint.difference), joint.unit)}${unitName(joint.unit)}`;
  if (joint.unit === "mm") return `${joint.difference > 0 ? "extend" : "retract"} ${size}`;
  return `${joint.difference > 0 ? "up by" : "down by"} ${size}`;
}

function showJoints(list, rows, joints, app) {
  for (const joint of joints) {
    let row = rows.get(joint.name);
    if (!row) {
      row = { name: h("span", { class: "name" }), move: h("span", { class: "move" }), figures: h("span", { class: "figures" }) };
      row.line = h("li", { "data-joint": joint.name }, row.name, row.move, row.figures);
      rows.set(joint.name, row);
      list.append(row.line);
    }
    say(row.name, joint.label || joint.name);
    app.aged(row.move, move(joint), joint.is_fresh ? Math.min(app.live.ageOf(joint.age_s) ?? 0, Math.max(app.live.age, 0)) : app.live.ageOf(joint.age_s));
    row.line.classList.toggle("there", joint.is_there === true);
    row.line.classList.toggle("to-go", joint.is_there === false);
    const unit = unitName(joint.unit);
    const target = joint.target === null ? "" : `, to ${measured(joint.target, joint.unit)}${unit} \u00b1 ${measured(joint.tolerance, joint.unit)}${unit}`;
    say(row.figures, `reads ${measured(joint.now, joint.unit)}${joint.now === null ? "" : unit}${target}`);
  }
}

function gainOf(accuracy) {
  if (!accuracy) return h("p", { class: "empty" }, "After the first poses this shows the expected accuracy of the model.");
  const of = (label, value) => tile(label, millimetres(value), "mm");
  return [
    h("dl", { class: "tiles" }, of("Expected now", accuracy.now_mm), of("After the next pose", accuracy.after_next_mm), of("After 5 more", accuracy.after_5_mm),
      accuracy.target_mm ? of("Target", accuracy.target_mm) : null),
    h("p", { class: accuracy.is_enough ? "good" : "" }, sentence(accuracy.why)),
    h("p", { class: "soft small" }, sentence(accuracy.basis)),
  ];
}

function coverageOf(coverage, joints) {
  if (!coverage) return h("p", { class: "empty" }, "After the first pose this shows which part of each joint's range was reached.");
  const label = Object.fromEntries(joints.map((joint) => [joint.name, joint.label || joint.name]));
  const line = (joint) => {
    const range = joint.high - joint.low, reached = joint.reached_low !== null;
    const text = `${label[joint.name]}: ${percent(joint.share)} of its range`;
    return h("li", null, h("span", null, label[joint.name]),
      bar(text, reached ? (joint.reached_low - joint.low) / range : 0, reached ? (joint.reached_high - joint.low) / range : 0), h("span", null, percent(joint.share)));
  };
  return [h("p", null, `${percent(coverage.volume_share)} of the work volume lies within the joint ranges reached.`), h("ul", { class: "coverage" }, coverage.joints.map(line))];
}

const MARKS = { done: "\u2713", skipped: "\u2013", now: "\u25b6", "to do": "" };

function stepLine(step) {
  const poses = step.poses ? `: ${step.poses.done} of ${step.poses.planned} planned` : "";
  const reason = step.reason ? ` (skipped: ${step.reason})` : step.state === "skipped" ? " (skipped)" : "";
  return h("li", { class: step.state.replace(" ", "-"), "aria-current": step.state === "now" ? "step" : null },
    h("span", { class: "mark", "aria-hidden": "true" }, MARKS[step.state] ?? ""),
    h("span", null, `${step.title}${poses}${reason}`, h("span", { class: "unseen" }, `, ${words(step.state)}`)));
}

function draw(boom, joints, app) {
  const values = (key) => {
    const byName = Object.fromEntries(joints.map((joint) => [joint.name, joint[key]]));
    const found = boom.shape.joints.map((joint) => byName[joint.name]);
    return found.every((value) => typeof value === "number") ? found : null;
  };
  boom.draw(values("now"), values("target"), !app.live.isLive || joints.some((joint) => !joint.is_fresh));
}
