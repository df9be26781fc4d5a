// Health: links, rates, gaps, clock, disk and jobs.

import { command } from "../api.js";
import { alarmList } from "../alarms.js";
import { fill, h, say, tile } from "../dom.js";
import { jobCard } from "../jobs.js";
import { channelStatus, duration, fixed, measured, unitName, utc, words } from "../words.js";

const JOBS_SHOWN = 8;

export function mount(root, app) {
  const part = (id, title, ...content) => h("section", { class: "card stack", "aria-labelledby": id }, h("h2", { id }, title), ...content);
  const alarms = h("section", { class: "card stack", "aria-labelledby": "alarms-title" });
  const tiles = h("dl", { class: "tiles", "aria-label": "The computer" });
  const links = h("tbody"), channels = h("tbody"), gaps = h("div"), jobs = h("ul", { class: "stack" }), events = h("div");
  const head = (names) => h("thead", null, h("tr", null, names.map((name, i) => h("th", { scope: "col", class: i < 2 ? "text" : null }, name))));
  const scroll = (label, body, names) => h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, h("table", null, head(names), body));
  root.append(tiles, alarms,
    part("links-title", "Links and stations", scroll("Links", links, ["link", "state", "per second", "waiting", "lost"])),
    part("jobs-title", "Jobs", jobs),
    h("div", { class: "pair" },
      part("channels-title", "Joints and signals", scroll("Readings of joints and signals", channels, ["channel", "state", "value", "age"])),
      h("div", { class: "stack" }, part("gaps-title", "Gaps", gaps), part("events-title", "Events", events))));

  let all = [], seen = "", closed = false;
  async function readJobs() {
    try { all = await command("jobs.list"); } catch { return; }
    if (!closed) app.update();
  }

  return {
    update(now) {
      const { acquisition } = now;
      fill(alarms, [now.alarms.active.map((a) => [a.kind, a.subject, a.severity, a.text, Math.floor(a.age_s / 60)]), now.unreadable, app.me.role], () => alarmList(now, app));
      const figures = figuresOf(now, app);
      fill(tiles, figures, () => figures.map((each) => tile(...each)));
      rows(links, [...acquisition.links.map((link) => linkRow(link, acquisition.stations))]);
      agedRows(channels, acquisition.channels, app);
      fill(gaps, acquisition.gaps.map((gap) => [gap.channel, gap.reason, Math.floor(gap.age_s)]), () => acquisition.gaps.length
        ? h("ul", null, acquisition.gaps.map((gap) => h("li", null, `${gap.channel}: ${words(gap.reason)} for ${duration(gap.age_s)}, since ${utc(gap.since_utc_ns)}`)))
        : h("p", { class: "empty" }, "No gap is open: all expected data arrive."));
      fill(events, now.events, () => now.events.length
        ? h("ul", { class: "small" }, now.events.map((event) => h("li", null, `${utc(event.utc_ns)} ${event.device}: ${event.text || words(event.kind)}`)))
        : h("p", { class: "empty" }, "No events yet."));
      const key = JSON.stringify(now.jobs.map((job) => [job.id, job.state]));
      if (key !== seen && app.live.isLive) { seen = key; readJobs(); }
      const running = new Map(now.jobs.map((job) => [job.id, job]));
      const shown = all.toReversed().slice(0, JOBS_SHOWN).map((job) => ({ ...job, ...running.get(job.id) }));
      fill(jobs, [shown.map((job) => [job.id, job.state, Math.floor(100 * job.progress), job.message, job.error]), app.me.role], () => shown.length
        ? shown.map((job) => jobCard(job, app)) : h("li", { class: "empty" }, "No jobs yet; the jobs of a session are queued a few seconds after it is closed."));
    },
    close() { closed = true; },
  };
}

function figuresOf(now, app) {
  const health = now.store_health;
  const disk = health.free_bytes === null ? "\u2013" : fixed(health.free_bytes / 2 ** 30, health.free_bytes < 2 ** 33 ? 1 : 0);
  const clock = new Date(now.time.utc_ns / 1e6).toISOString();
  return [
    ["Clock of the rig", clock.slice(11, 16), "UTC", clock.slice(0, 10)],
    ["Free disk", disk, "GiB", health.is_low ? "nearly full" : ""],
    ["Store", words(health.state), "", health.text ? health.text.slice(0, 160) : ""],
    ["Writing is behind by", fixed(now.acquisition.writer_lag_p99_s, 2), "s", now.acquisition.error ?? (now.acquisition.is_behind ? "captures wait to be decoded" : "")],
    ["Version", now.version, "", app.live.state.mode],
  ];
}

function linkRow(link, stations) {
  const station = stations.find((each) => each.name === link.name);
  const state = link.up === null ? ["starting", "doubtful"] : link.up ? ["up", "good"] : ["down", "bad"];
  const detail = station ? station.sentence : link.up ? "" : link.reason;
  return [link.name, [state[0], state[1], detail], fixed(link.captures_per_s, 0), String(link.queued), String(link.dropped)];
}

function rows(body, list) {
  while (body.rows.length < list.length) body.append(h("tr", null, h("th", { scope: "row" }), h("td", { class: "text" }, h("span"), h("span", { class: "soft" })), h("td"), h("td"), h("td")));
  while (body.rows.length > list.length) body.lastChild.remove();
  list.forEach(([name, [state, kind, detail], ...figures], i) => {
    const cells = body.rows[i].cells;
    say(cells[0], name);
    const [word, more] = cells[1].children;
    word.className = kind;
    say(word, state);
    say(more, detail ? ` ${detail}` : "");
    figures.forEach((figure, n) => say(cells[2 + n], figure));
  });
}

function agedRows(body, channels, app) {
  while (body.rows.length < channels.length) body.append(h("tr", null, h("th", { scope: "row" }), h("td", { class: "text" }), h("td"), h("td")));
  channels.forEach((channel, i) => {
    const cells = body.rows[i].cells;
    say(cells[0], channel.name);
    cells[1].className = `text ${channel.status === "ok" ? "good" : "bad"}`;
    say(cells[1], channelStatus(channel));
    const age = app.live.ageOf(channel.age_s);
    cells[2].classList.toggle("old", age === null || age > 2 || !app.live.isLive);
    say(cells[2], channel.value === null ? "\u2013" : `${measured(channel.value, channel.unit)}${unitName(channel.unit)}`);
    say(cells[3], age === null ? "never" : duration(age));
  });
}
