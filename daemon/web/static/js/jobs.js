// Jobs in words: their purpose, progress and result.

import { bar, h } from "./dom.js";
import { JOBS, words } from "./words.js";

export const jobName = (job) => JOBS[job.kind] ?? words(job.kind);

/** One line: name, state, and the error if there is one. */
export function jobLine(job) {
  const state = job.state === "running" ? `running, ${Math.floor(100 * job.progress)} %: ${job.message || "starting"}` : job.state;
  return `${jobName(job)} (job ${job.id}): ${state}${job.error ? `, ${job.error}` : ""}`;
}

/** A job with its progress and its buttons. */
export function jobCard(job, app) {
  const cancel = async () => {
    const go = await app.confirm(`Cancel ${jobName(job).toLowerCase()}?`, ["Jobs that depend on it are cancelled too.", "It can be retried later."], "Cancel the job", { kind: "danger" });
    if (go !== null) await app.run("jobs.cancel", { id: job.id });
  };
  const isOpen = ["running", "queued", "interrupted"].includes(job.state);
  const canRetry = ["failed", "cancelled"].includes(job.state);
  const tag = { done: "tag good", failed: "tag bad", running: "tag" }[job.state] ?? "tag doubtful";
  return h("li", { class: "job stack", "data-job": job.id },
    h("div", { class: "row" }, h("h3", null, `${jobName(job)}, job ${job.id}`), h("span", { class: tag }, job.state)),
    job.session_id ? h("p", { class: "soft small" }, `after session ${job.session_id}`) : null,
    job.state === "running" ? [h("p", null, `${Math.floor(100 * job.progress)} %: ${job.message || "starting"}`), bar(`${jobName(job)}: ${Math.floor(100 * job.progress)} %`, 0, job.progress)] : null,
    job.error ? h("p", { class: job.state === "failed" ? "bad" : "soft" }, job.error) : null,
    h("div", { class: "row" },
      job.result?.report ? h("a", { class: "button", href: `/report/${job.id}`, target: "_blank", rel: "noopener" }, "Open the report") : null,
      isOpen ? app.button("Cancel", "operate", cancel, "danger") : null,
      canRetry ? app.button("Try again", "operate", () => app.run("jobs.retry", { id: job.id })) : null));
}
