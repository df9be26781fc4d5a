// Charts over time by uPlot, in the colours of the page, each with a table of the same figures for people who cannot see it.

import { fill, h } from "./dom.js";

let library = null;
const loaded = () => (library ??= import("/static/vendor/uplot/uPlot.esm.js").then((module) => module.default));
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Labels of a time axis in UTC: dates if the ticks are days apart, else times. */
const times = (_plot, ticks, _axis, _space, apart) => ticks.map((tick) => {
  const text = new Date(tick * 1e3).toISOString();
  return apart >= 86400 ? text.slice(0, 10) : text.slice(11, apart >= 60 ? 16 : 19);
});

/**
 * A chart of points over time.
 * @param label description of the chart for people who cannot see it
 * @param unit unit of the values
 * @param series list of {label, colour (name of a page colour), line (bool)}
 * @param empty text in place of a chart without data; "" if the page explains this already
 * @param options log: logarithmic axis; zero: the axis includes zero
 */
export class Chart {
  constructor(label, unit, series, empty, { log = false, zero = true } = {}) {
    this.series = series;
    this.options = { label, unit, log, zero };
    this.box = h("div", { class: "chart", role: "img", "aria-label": label });
    this.empty = h("p", { class: "empty" }, empty);
    this.element = h("figure", null, this.box, this.empty);
    this.themed = () => this.#build();
    addEventListener("theme", this.themed);
    this.sized = new ResizeObserver(() => this.plot?.setSize(this.#size()));
    this.sized.observe(this.box);
    this.show([[], ...series.map(() => [])]);
  }

  /** Show data: [times in s of UTC, values of each series ...]; null for a missing value. */
  show(data) {
    const key = JSON.stringify(data);
    if (key === this.key) return;
    this.key = key;
    this.data = data;
    // A dashed line alone is a limit without values to compare.
    this.isEmpty = !this.series.some((each, i) => !each.dash && data[i + 1].some((value) => value !== null));
    this.box.hidden = this.isEmpty;
    this.empty.hidden = !this.isEmpty;
    this.element.hidden = this.isEmpty && !this.empty.textContent;
    if (this.isEmpty) return;
    if (this.plot) this.plot.setData(data);
    else this.#build();
  }

  close() {
    removeEventListener("theme", this.themed);
    this.sized.disconnect();
    this.plot?.destroy();
  }

  #size() { return { width: Math.max(this.box.clientWidth, 200), height: 240 }; }

  async #build() {
    if (this.isEmpty) return;
    const UPlot = await loaded();
    this.plot?.destroy();
    fill(this.box, [], () => []);
    const axis = { space: 84, stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") }, font: "13px system-ui, sans-serif" };
    this.plot = new UPlot({
      ...this.#size(),
      cursor: { show: false },
      legend: { show: this.series.length > 1, live: false },
      scales: { y: this.options.log ? { distr: 3 } : { range: (_, low, high) => [this.options.zero ? Math.min(0, low) : low, (high || 1) * 1.1] } },
      tzDate: (seconds) => UPlot.tzDate(new Date(seconds * 1e3), "Etc/UTC"),
      axes: [{ ...axis, values: times }, { ...axis, space: 30, size: 76, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : `${tick} ${this.options.unit}`.trim())) }],
      series: [{ label: "time" }, ...this.series.map((each) => ({
        label: each.label,
        stroke: colour(each.colour),
        width: each.line ? 2 : 0,
        paths: each.line ? undefined : () => null,
        dash: each.dash,
        points: { show: !each.line || each.dots, size: 8, fill: colour(each.colour), stroke: colour(each.colour) },
      }))],
    }, this.data, this.box);
  }
}
