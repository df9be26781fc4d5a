// Models: the live and the waiting model, errors before and after; accept, reject and roll back after a confirmation with the reasons.

import { command } from "../api.js";
import { fill, h, s, table } from "../dom.js";
import { millimetres, plural, sentence, utc, words } from "../words.js";

const STAGES = { nominal: "drawings", geometric: "geometry", effects: "named effects", hybrid: "learned residual" };

export function mount(root, app) {
  const list = h("div", { class: "stack" });
  root.append(list);
  let models = null, jobs = [], timer = null, closed = false, seen = null;

  async function read() {
    clearTimeout(timer);
    try {
      const [brief, newJobs] = await Promise.all([command("model.list"), command("jobs.list")]);
      const newest = brief.toReversed().slice(0, 12);
      models = await Promise.all(newest.map(async (model) => ({ ...model, ...(await command("model.show", { id: model.id })), brief: model })));
      jobs = newJobs;
    } catch (error) {
      if (models === null) fill(list, error.message, () => h("p", { class: "card fault" }, error.message));
    }
    if (!closed) app.update();
  }

  return {
    update(now) {
      const key = JSON.stringify([now.models, now.jobs.length, now.gap?.verdict?.job]);
      if (key !== seen && app.live.isLive) {
        seen = key;
        clearTimeout(timer);
        timer = setTimeout(read, 50);
      }
      if (models === null) return;
      fill(list, [models, now.models, now.gap?.verdict, app.me.role, jobs.length], () => cards(models, jobs, now, app));
    },
    close() { closed = true; clearTimeout(timer); },
  };
}

function cards(models, jobs, now, app) {
  const verdict = now.gap?.verdict;
  const gap = verdict && h("section", { class: "card stack", "aria-labelledby": "gap-title" },
    h("h2", { id: "gap-title" }, "What the model lacked"), h("p", null, verdict.sentence),
    verdict.experiments.length ? h("ul", null, verdict.experiments.slice(0, 3).map((text) => h("li", null, `Next: ${text}`))) : null,
    h("div", { class: "row" }, h("a", { class: "button", href: `/report/${verdict.job}`, target: "_blank", rel: "noopener" }, "Open the gap report")));
  if (!models.length) {
    return [h("section", { class: "card" }, h("h2", null, "No models yet"), h("p", null, "A guided session with a check produces a first model."), h("a", { class: "button", href: "/guide" }, "Go to the guide")), gap];
  }
  const waiting = now.models?.candidate?.id;
  const order = (model) => (model.id === waiting ? 0 : model.state === "live" ? 1 : 2);
  const sorted = models.toSorted((a, b) => order(a) - order(b) || b.id - a.id);
  const first = sorted.filter((model) => order(model) < 2), rest = sorted.filter((model) => order(model) === 2);
  return [
    first.map((model) => card(model, jobs, now, app)), gap,
    rest.length ? h("details", { class: "card" }, h("summary", null, `Earlier models (${rest.length})`), h("div", { class: "stack" }, rest.map((model) => card(model, jobs, now, app)))) : null,
  ];
}

function card(model, jobs, now, app) {
  const state = { live: ["live", "tag good"], candidate: ["waiting", "tag doubtful"], retired: ["retired", "tag"] }[model.state];
  const compared = model.metrics.comparison;
  const candidate = now.models?.candidate?.id === model.id ? now.models.candidate : null;
  const report = jobs.findLast((job) => job.kind === "report" && job.state === "done" && job.result?.model === model.path);
  return h("section", { class: `card stack model ${model.state}`, "data-model": model.id, "aria-labelledby": `model-${model.id}` },
    h("div", { class: "row" }, h("h2", { id: `model-${model.id}` }, `Model ${model.id}`), h("span", { class: state[1] }, state[0]), h("span", { class: "soft" }, STAGES[model.stage] ?? words(model.stage))),
    compared?.before_mm !== undefined ? h("p", null, h("strong", null, `${millimetres(compared.before_mm)} mm before, ${millimetres(compared.after_mm)} mm after`), ` on ${plural(compared.fixes, "fix", "fixes")} that it was not trained on.`) : null,
    compared ? h("p", { class: compared.is_better ? "good" : "doubtful" }, sentence(compared.sentence)) : h("p", { class: "doubtful" }, "It was not compared with held-out check shots yet."),
    candidate?.refused_because ? h("p", { class: "alarm" }, `It would be refused now: ${candidate.refused_because}`) : null,
    errors(model),
    h("div", { class: "row" },
      candidate?.is_acceptable ? app.button(`Accept model ${model.id}`, "approve", () => accept(model, compared, now, app), "main") : null,
      model.state !== "retired" ? app.button("Reject", "approve", () => reject(model, app), "danger") : null,
      model.state === "retired" && model.history.some((change) => change.state === "live") ? app.button(`Put model ${model.id} back`, "approve", () => putBack(model, now, app)) : null,
      model.state === "live" ? app.button("Roll back", "approve", () => rollBack(model, now, app), "danger") : null,
      model.state === "candidate" ? app.button("Compare again", "operate", () => app.run("model.compare", { id: model.id })) : null,
      report ? h("a", { class: "button", href: `/report/${report.id}`, target: "_blank", rel: "noopener" }, "Open its report") : null),
    !app.may("approve") && candidate?.is_acceptable ? h("p", { class: "soft" }, "Someone with the role approve can accept it.") : null,
    h("details", null, h("summary", null, "Origin"),
      h("p", null, `Made ${utc(model.created_utc_ns)} from ${model.sessions.join(", ") || "no session"}.`),
      table(`Changes of model ${model.id}`, [["when", true], ["state", true], ["by", true], ["why", true]], model.history.map((change) => [utc(change.utc_ns), change.state, change.operator || change.user || "rigcal", change.reason]))));
}

async function accept(model, compared, now, app) {
  const live = now.models.live;
  const reasons = [
    sentence(compared.sentence),
    live ? `Model ${live.id} is live now; it is retired, and can be put back at any time.` : "No model is live now; this is the first.",
    "From then on every corrected position comes from this model.",
  ];
  if (await app.confirm(`Accept model ${model.id}?`, reasons, `Accept model ${model.id}`) !== null) {
    await app.run("model.accept", { id: model.id }, `Model ${model.id} is live`);
  }
}

async function reject(model, app) {
  const effects = model.state === "live"
    ? ["No other model takes its place: there is no corrected position from then on.", "It stays in the store and can be put back."]
    : ["It stays in the store and never goes live.", "The live model stays as it is."];
  const reason = await app.confirm(`Reject model ${model.id}?`, effects, "Reject", { kind: "danger", reason: ["Measured wrongly", "Not plausible", "A new model follows"] });
  if (reason) await app.run("model.reject", { id: model.id, reason }, `Model ${model.id} is rejected`);
}

async function rollBack(model, now, app) {
  const change = model.history.findLast((each) => each.state === "live" && each.replaced_id !== null);
  const before = change?.replaced_id;
  if (before === undefined || before === null) { app.toast(`Model ${model.id} is the first live model: there is no earlier model to put back.`, true); return; }
  const drift = now.gap?.drift;
  const reasons = [
    `Model ${before} takes the place of model ${model.id}.`,
    `Model ${model.id} went live ${utc(change.utc_ns)}: ${change.reason}.`,
    drift?.ratio ? `The error of the last check shots was ${drift.ratio.toFixed(2)} times what model ${drift.model} expects.` : "No check shots were compared with the live model yet.",
  ];
  if (await app.confirm(`Roll back to model ${before}?`, reasons, `Put model ${before} back`, { kind: "danger" }) !== null) {
    await app.run("model.rollback", {}, `Model ${before} is live again`);
  }
}

async function putBack(model, now, app) {
  const live = now.models.live;
  const left = model.history.findLast((change) => change.state === "retired");
  const reasons = [
    live ? `It takes the place of model ${live.id}, which is retired and can be put back too.` : "No model is live now.",
    `Model ${model.id} was retired ${utc(left.utc_ns)}: ${left.reason}.`,
    model.metrics.comparison ? `When it was compared: ${model.metrics.comparison.sentence}.` : "It was never compared with held-out check shots.",
  ];
  if (await app.confirm(`Put model ${model.id} back?`, reasons, `Put model ${model.id} back`, { kind: "danger" }) !== null) {
    await app.run("model.rollback", { id: model.id }, `Model ${model.id} is live again`);
  }
}

/** Errors of the stages on a logarithmic axis, as dots, with the noise floor. */
function errors(model) {
  const stages = model.metrics.training ?? [];
  const compared = model.metrics.comparison;
  const rows = stages.map((stage) => [STAGES[stage.stage] ?? stage.stage, stage.rms_mm]);
  if (!rows.length) return null;
  const noise = model.metrics.noise_mm;
  const held = compared?.before_mm !== undefined ? [compared.before_mm, compared.after_mm] : [];
  const values = [...rows.map((row) => row[1]), ...held, noise].filter((value) => value > 0);
  const low = Math.floor(Math.log10(Math.min(...values)) * 2) / 2, high = Math.ceil(Math.log10(Math.max(...values)) * 2 + 0.01) / 2;
  const lines = [...rows.map(([name, value]) => [name, [value]]), ...(held.length ? [["held-out checks", held]] : [])];
  // As wide as the screen allows, so that its text has the usual size; on a phone, names stand above their lines.
  const width = Math.min(Math.max(innerWidth - 90, 260), 760), isNarrow = width < 560;
  const left = isNarrow ? 24 : 150, right = width - 140, step = isNarrow ? 48 : 30, bottom = 24 + step * lines.length;
  const x = (value) => left + ((right - left) * (Math.log10(value) - low)) / (high - low || 1);
  const ticks = [];
  for (let k = Math.ceil(low); k <= high; k++) ticks.push(10 ** k);
  const label = lines.map(([name, each]) => `${name} ${each.map(millimetres).join(" to ")} mm`).join(", ");
  return h("figure", null, s("svg", { class: "errors", viewBox: `0 0 ${width} ${bottom + 30}`, role: "img", "aria-label": `RMS error: ${label}; noise ${millimetres(noise)} mm` },
    ticks.map((tick) => [s("line", { class: "axis", x1: x(tick), x2: x(tick), y1: 6, y2: bottom }), s("text", { class: "soft", x: x(tick), y: bottom + 20, "text-anchor": "middle" }, `${tick} mm`)]),
    noise > 0 ? [s("line", { class: "noise", x1: x(noise), x2: x(noise), y1: 6, y2: bottom }), s("text", { class: "soft", x: x(noise) + 5, y: 14 }, "noise")] : null,
    lines.map(([name, each], i) => {
      const y = 34 + step * i + (isNarrow ? 16 : 0);
      return [s("text", { x: 0, y: y + (isNarrow ? -14 : 5) }, name), s("line", { class: "axis", x1: left, x2: right, y1: y, y2: y }),
        each.length === 2 ? [s("circle", { class: "before", cx: x(each[0]), cy: y, r: 6 }), s("circle", { class: "dot", cx: x(each[1]), cy: y, r: 7 })] : s("circle", { class: "dot", cx: x(each[0]), cy: y, r: 7 }),
        s("text", { x: right + 10, y: y + 5 }, `${each.map(millimetres).join(" \u2192 ")} mm`)];
    })));
}
