// Numbers, times and names as people read them.

const MINUS = "\u2212";

/** A length of time: `40 s`, `12 min`, `3.2 h`, `5 days`. */
export function duration(seconds) {
  const t = Math.max(seconds, 0);
  if (t < 10) return `${t.toFixed(1)} s`;
  if (t < 120) return `${t.toFixed(0)} s`;
  if (t < 7200) return `${(t / 60).toFixed(0)} min`;
  if (t < 172800) return `${(t / 3600).toFixed(1)} h`;
  return `${(t / 86400).toFixed(0)} days`;
}

export const fixed = (value, digits) =>
  value === null || value === undefined || !Number.isFinite(value) ? "\u2013" : value.toFixed(digits).replace("-", MINUS);

/** A value of a joint, with decimals that suit its unit. */
export const measured = (value, unit) => fixed(value, unit === "mm" ? 0 : 1);

export const unitName = (unit) => ({ deg: "\u00b0", degC: " \u00b0C" }[unit] ?? ` ${unit}`);

export const percent = (share) => (share === null || share === undefined ? "\u2013" : `${(100 * share).toFixed(0)} %`);

/** An error in mm, with two decimals, fewer from 10 mm on. */
export function millimetres(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "\u2013";
  return value >= 100 ? value.toFixed(0) : value >= 10 ? value.toFixed(1) : value.toFixed(2);
}

/** A UTC timestamp in nanoseconds as text. */
export function utc(ns) {
  if (ns === null || ns === undefined) return "\u2013";
  return `${new Date(ns / 1e6).toISOString().slice(0, 16).replace("T", " ")} UTC`;
}

export const words = (name) => String(name).replaceAll("_", " ").replaceAll("-", " ");

/** The status of a joint or signal in words; one whose readings wait to be decoded is late, not silent. */
export const channelStatus = ({ status, is_silent: isSilent }) => (status === "silent" && !isSilent ? "late, not yet decoded" : words(status));

export const plural = (n, one, more = `${one}s`) => `${n} ${n === 1 ? one : more}`;

/** Poses of a guide's plan as a tile; a session has more poses if the boom also stood elsewhere. */
export const planned = ({ done, planned: all, skipped }) => ["Planned poses", `${done} of ${all}`, "", skipped ? `${skipped} skipped` : "as the guide requests"];

export const JOBS = { gap: "Identification", residual: "Learning what remains", report: "Report", comparison: "Comparison", drift: "Drift of checks" };

/** A clause as a sentence: with a capital, unless it begins with a name, and a full stop. */
export const sentence = (clause) =>
  clause && `${clause.replace(/^[a-z]{2,}(?=[ ,])/, (word) => word[0].toUpperCase() + word.slice(1))}${/[.?!]$/.test(clause) ? "" : "."}`;
