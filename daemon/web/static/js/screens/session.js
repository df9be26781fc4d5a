// Session: fixes and residuals as they arrive, exclusions with their reasons, control points, jobs.

import { command, get } from "../api.js";
import { Chart } from "../chart.js";
import { fill, h, say, table, tile } from "../dom.js";
import { jobLine } from "../jobs.js";
import { duration, fixed, millimetres, planned, plural, utc, words } from "../words.js";

const POLL_MS = 1000;

export function mount(root, app) {
  const select = h("select", { id: "which" });
  const head = h("section", { class: "card stack", "aria-label": "The session" });
  const chart = new Chart("Distance of each fix from the live model's prediction over time", "mm", [{ label: "used", colour: "blue" }, { label: "excluded", colour: "critical" }], "");
  const note = h("p", { class: "soft" });
  const poses = h("div");
  const poseByPose = h("details", { hidden: true }, h("summary", null, "Pose by pose"), poses);
  const residuals = h("section", { class: "card stack", "aria-labelledby": "residuals-title" },
    h("h2", { id: "residuals-title" }, "Fixes and residuals"), note, chart.element, poseByPose);
  const picker = h("section", { class: "card" }, h("label", { for: "which" }, "Which session", select));
  root.append(head, residuals, picker);

  let chosen = null, open = null, found = null, timer = null, closed = false;
  select.addEventListener("change", () => { chosen = select.value; found = null; read(); });

  async function read() {
    clearTimeout(timer);
    try {
      if (!document.hidden && app.live.isLive) {
        const sessions = await command("session.list");
        const id = chosen ?? open ?? sessions.at(-1)?.id ?? null;
        fill(select, [sessions.map((one) => [one.id, one.state]), id], () => sessions.toReversed().map((one) =>
          h("option", { value: one.id, selected: one.id === id }, `${one.id}, ${one.state}, prism ${one.prism}${one.kind === "check" ? ", a check" : ""}`)));
        const isOver = found && found.session.id === id && found.session.state !== "open";
        if (id !== null) {
          const [session, fixes] = await Promise.all([command("session.show", { id }), isOver ? found.fixes : get(`/api/sessions/${encodeURIComponent(id)}/fixes`)]);
          found = { session, fixes };
        }
        if (!closed) show();
      }
    } catch (error) { say(note, error.message); }
    if (!closed) timer = setTimeout(read, POLL_MS);
  }

  function show() {
    picker.hidden = found === null;
    residuals.hidden = found === null;
    if (found === null) {
      fill(head, "none", () => [h("p", null, "No session was measured yet."), h("a", { class: "button", href: "/guide" }, "Start a guided session")]);
      return;
    }
    const { session, fixes } = found;
    const guide = app.live.state.guide;
    const led = guide?.state === "open" && guide.session === session.id ? guide : null;
    fill(head, [session, led?.poses, app.me.role], () => summary(session, led, app));
    poseByPose.hidden = !fixes.fixes.length;
    const size = (fix) => (fix.residual_mm ? Math.hypot(...fix.residual_mm) : null);
    const spread = spreads(fixes.fixes);
    const isModel = fixes.fixes.some((fix) => fix.residual_mm);
    say(note, !fixes.fixes.length ? (session.state === "open" ? "No fix has arrived yet." : "This session has no fixes.") : [fixes.note, isModel ? `Measured minus predicted by model ${fixes.model}.` : "The chart shows the distance of each fix from the mean of its pose."].filter(Boolean).join(" "));
    const value = (fix) => (isModel ? size(fix) : spread.get(fix.id) ?? null);
    chart.box.setAttribute("aria-label", isModel ? "Distance of each fix from the live model's prediction over time" : "Distance of each fix from the mean of its pose over time");
    chart.show([fixes.fixes.map((fix) => fix.utc_ns / 1e9),
      fixes.fixes.map((fix) => (fix.excluded === null ? value(fix) : null)),
      fixes.fixes.map((fix) => (fix.excluded === null ? null : 0))]);
    fill(poses, fixes.fixes.map((fix) => [fix.id, fix.excluded, fix.residual_mm]), () => poseTable(fixes.fixes, spread, size));
  }

  const tag = h("p", { class: "soft small", role: "status" });
  head.before(tag);
  read();
  return {
    update(now) {
      open = now.session?.id ?? null;
      const age = now.acquisition.stations.map((station) => `${station.name}: ${station.sentence}`).join("; ");
      app.aged(tag, age, app.live.age);
    },
    close() { closed = true; clearTimeout(timer); chart.close(); },
  };
}

/** Distance of each used fix from the mean of its pose, mm; shown as long as no model predicts. */
function spreads(fixes) {
  const byPose = Map.groupBy(fixes.filter((fix) => fix.excluded === null && fix.pose !== null), (fix) => fix.pose);
  const found = new Map();
  for (const pose of byPose.values()) {
    const mean = ["x_mm", "y_mm", "z_mm"].map((axis) => pose.reduce((sum, fix) => sum + fix[axis], 0) / pose.length);
    for (const fix of pose) found.set(fix.id, Math.hypot(fix.x_mm - mean[0], fix.y_mm - mean[1], fix.z_mm - mean[2]));
  }
  return found;
}

function poseTable(fixes, spread, size) {
  const byPose = [...Map.groupBy(fixes, (fix) => fix.pose ?? "moving")];
  const mean = (values) => { const known = values.filter((value) => value !== null && value !== undefined); return known.length ? known.reduce((a, b) => a + b, 0) / known.length : null; };
  const rows = byPose.toReversed().slice(0, 60).map(([pose, group]) => {
    const used = group.filter((fix) => fix.excluded === null);
    const why = [...new Set(group.map((fix) => fix.excluded).filter(Boolean))].join("; ");
    return [pose === "moving" ? "while moving" : utc(group[0].utc_ns), `${used.length} of ${group.length}`, millimetres(mean(used.map((fix) => spread.get(fix.id)))), millimetres(mean(used.map(size))), why];
  });
  return table("The newest poses first", [["at", true], ["fixes used", false], ["spread, mm", false], ["residual, mm", false], ["excluded because", true]], rows);
}

/** Buttons for a session without a guide. */
function byHand(session, app) {
  const points = [...new Set(session.control_shots.map((shot) => shot.point))];
  const stop = async () => {
    const go = await app.confirm(`End session ${session.id}?`, ["Its jobs then start automatically.", "Shoot the control points first: without them the session is not used."], "End the session");
    if (go !== null) await app.run("session.stop", {}, "The session is ended");
  };
  const abort = async () => {
    const go = await app.confirm(`Abort session ${session.id}?`, ["It is kept, but never used for calibration."], "Abort the session", { kind: "danger" });
    if (go !== null) await app.run("session.abort", {}, "The session is aborted");
  };
  return [
    (points.length ? points : ["cp1"]).map((point) => app.button(`Shoot ${point}`, "operate", () => app.run("session.shoot", { point }, `${point} is shot`))),
    app.button("End the session", "operate", stop, "main"), app.button("Abort", "operate", abort, "danger"),
  ];
}

/** Summary of the session; `led` is the guide that leads it, null without one. */
function summary(session, led, app) {
  const state = session.state === "open" ? ["open", "tag good"] : session.not_used ? ["not used", "tag bad"] : [session.state, "tag"];
  const shots = session.control_shots.map((shot) => `${shot.point} at the ${shot.phase}: ${shot.misclosure_mm === null ? "defined" : `${fixed(shot.misclosure_mm, 1)} mm off`}`);
  const accept = async () => {
    const go = await app.confirm(`Use session ${session.id}?`, [`Calibration does not use it: ${session.not_used}.`, "Accept it only if you know that the station stood still."], "Accept the session");
    if (go !== null) await app.run("session.accept", { id: session.id }, "The session is accepted");
  };
  return [
    h("div", { class: "row" }, h("h2", null, `${session.id}: prism ${session.prism}${session.kind === "check" ? ", a check" : ""}`), h("span", { class: state[1] }, state[0])),
    session.state === "open" && !app.live.state.guide?.session ? h("div", { class: "row" }, byHand(session, app)) : null,
    h("dl", { class: "tiles" },
      tile("Poses measured", String(session.poses), "", "standstills with usable fixes"),
      led?.poses ? tile(...planned(led.poses)) : null,
      tile("Fixes", String(session.observations)), tile("Set-up", session.setup ?? "\u2013"), tile("Started", utc(session.started_utc_ns).slice(11), "", utc(session.started_utc_ns).slice(0, 10))),
    Object.keys(session.excluded).length ? h("div", null, h("h3", null, "Excluded"), h("ul", null, Object.entries(session.excluded).map(([reason, n]) => h("li", null, `${plural(n, "fix", "fixes")}: ${reason}`)))) : null,
    shots.length ? h("div", null, h("h3", null, "Control points"), h("ul", null, shots.map((shot) => h("li", null, shot)))) : h("p", { class: "doubtful" }, "No control point was shot yet."),
    session.clock_steps.map((step) => h("p", { class: "doubtful" }, `The computer's clock was set by ${fixed(step.step_s, 1)} s at ${utc(step.at_utc_ns)}.`)),
    session.setup_moved ? h("p", { class: "bad" }, "The station has moved since this set-up was described.") : null,
    session.not_used ? h("div", { class: "alarm critical" }, h("p", null, `Calibration does not use this session: ${session.not_used}.`), h("div", { class: "row" }, app.button("Use it anyway", "approve", accept))) : null,
    session.accepted ? h("p", { class: "soft" }, `Accepted by ${session.accepted.by || session.accepted.user || "an operator"}, although ${session.accepted.despite}.`) : null,
    session.jobs.length ? h("div", null, h("h3", null, "Jobs"), h("ul", null, session.jobs.map((job) => h("li", null, jobLine(job))))) : null,
    h("p", { class: "soft small" }, [session.operator && `Operator ${session.operator}`, session.ended_utc_ns && `ended ${utc(session.ended_utc_ns)}, after ${duration((session.ended_utc_ns - session.started_utc_ns) / 1e9)}`, words(session.kind)].filter(Boolean).join("; ")),
  ];
}
