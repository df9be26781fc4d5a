// The boom as a drawing: side view and plan view, from the elementary transforms of the rig file.

import { s } from "./dom.js";

const WIDTH = 560, HEIGHT = 330, MARGIN = 34;
const SAMPLES = 240;

/** Points of a chain at given joint values, mm: the origin, the place after each translation, and finally the prism. */
export function walk(chain, values) {
  let rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  let place = [0, 0, 0];
  const points = [place];
  for (const [rotates, axis, constant, drive] of chain) {
    const size = drive.reduce((sum, [joint, coefficient]) => sum + coefficient * values[joint], constant);
    if (rotates) {
      rotation = turned(rotation, axis, size);
    } else if (size !== 0) {
      place = place.map((at, row) => at + rotation[row][axis] * size);
      points.push(place);
    }
  }
  return points;
}

function turned(rotation, axis, angle) {
  const [i, j] = [[1, 2], [2, 0], [0, 1]][axis];
  const [c, sn] = [Math.cos(angle), Math.sin(angle)];
  return rotation.map((row) => {
    const next = [...row];
    next[i] = c * row[i] + sn * row[j];
    next[j] = -sn * row[i] + c * row[j];
    return next;
  });
}

/** Two views of a rig, which `draw` updates. */
export class Boom {
  constructor(shape) {
    this.shape = shape;
    this.#choosePlane();
    this.side = this.#view("Side view", (p) => [this.#out(p), this.#up(p)]);
    this.plan = this.#view("Plan view", (p) => [p[0], p[1]]);
  }

  /** Draw the boom now and its target, if there is one: joint values in the rig's order. */
  draw(now, target, isOld) {
    for (const view of [this.side, this.plan]) {
      view.svg.classList.toggle("old", isOld);
      this.#chains(view, view.now, now, "now");
      this.#chains(view, view.there, target, "there");
    }
    const words = [now && `the boom reaches ${this.#where(now)}`, target && `its target ${this.#where(target)}`].filter(Boolean).join("; ");
    this.side.svg.setAttribute("aria-label", `Side view: ${words || "the joint readings are unknown"}`);
    this.plan.svg.setAttribute("aria-label", `Plan view: ${words || "the joint readings are unknown"}`);
  }

  // ---- geometry ----------------------------------------------------------------------------------------------------

  #choosePlane() {
    const { joints, chains } = this.shape;
    const down = this.shape.down, size = Math.hypot(...down);
    this.down = down.map((x) => x / size);
    const middle = joints.map((joint) => (joint.low + joint.high) / 2);
    const tips = Object.values(chains).map((chain) => walk(chain, middle).at(-1));
    const far = tips.reduce((a, b) => (Math.hypot(a[0], a[1]) > Math.hypot(b[0], b[1]) ? a : b));
    const reach = Math.hypot(far[0], far[1]) || 1;
    this.ahead = [far[0] / reach, far[1] / reach];
    this.tip = Object.keys(chains)[tips.indexOf(far)];
    let seed = 1;
    const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
    this.cloud = [];
    for (let n = 0; n < SAMPLES; n++) {
      const values = joints.map((joint) => joint.low + random() * (joint.high - joint.low));
      for (const chain of Object.values(chains)) this.cloud.push(...walk(chain, values));
    }
  }

  #out(p) { return p[0] * this.ahead[0] + p[1] * this.ahead[1]; }

  #up(p) { return -(p[0] * this.down[0] + p[1] * this.down[1] + p[2] * this.down[2]); }

  #where(values) {
    const p = walk(this.shape.chains[this.tip], values).at(-1);
    return `${(this.#out(p) / 1000).toFixed(1)} m out and ${(this.#up(p) / 1000).toFixed(1)} m high`;
  }

  // ---- drawing -----------------------------------------------------------------------------------------------------

  #view(title, project) {
    const flat = this.cloud.map(project);
    const [x0, x1] = extent(flat, 0), [y0, y1] = extent(flat, 1);
    const scale = Math.min((WIDTH - 2 * MARGIN) / (x1 - x0), (HEIGHT - 2 * MARGIN) / (y1 - y0));
    const left = (WIDTH - scale * (x1 - x0)) / 2, low = (HEIGHT - scale * (y1 - y0)) / 2;
    const at = (p) => { const [x, y] = project(p); return [left + scale * (x - x0), HEIGHT - low - scale * (y - y0)]; };
    const now = s("g"), there = s("g");
    const metre = 1000 * scale, [bx, by] = at([0, 0, 0]);
    const lines = [];
    for (let x = bx % (2 * metre); x < WIDTH; x += 2 * metre) lines.push(s("line", { class: "grid", x1: x, x2: x, y1: 0, y2: HEIGHT }));
    for (let y = by % (2 * metre); y < HEIGHT; y += 2 * metre) lines.push(s("line", { class: "grid", x1: 0, x2: WIDTH, y1: y, y2: y }));
    const svg = s("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": title },
      lines, title === "Side view" ? s("line", { class: "ground", x1: 0, x2: WIDTH, y1: by, y2: by }) : null,
      s("rect", { class: "base", x: bx - 9, y: by - 9, width: 18, height: 18 }),
      there, now, s("text", { x: 10, y: 20 }, `${title}; squares of 2 m`));
    return { svg, at, now, there };
  }

  #chains(view, group, values, kind) {
    if (!values) { group.replaceChildren(); return; }
    const dots = [];
    const lines = Object.entries(this.shape.chains).map(([name, chain]) => {
      const points = walk(chain, values).map(view.at);
      const [x, y] = points.at(-1);
      dots.push(s("circle", { class: `prism ${kind === "there" ? kind : ""}`, cx: x.toFixed(1), cy: y.toFixed(1), r: kind === "now" ? 6 : 4.5 }));
      if (kind === "now") dots.push(s("text", { x: (x + 9).toFixed(1), y: (y - 7).toFixed(1) }, name));
      return s("polyline", { class: kind, points: points.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" ") });
    });
    group.replaceChildren(...lines, ...dots);
  }
}

/** Range of a coordinate that contains the base and nearly all places that the boom reaches. */
function extent(points, coordinate) {
  const sorted = points.map((p) => p[coordinate]).toSorted((a, b) => a - b);
  const at = (share) => sorted[Math.round(share * (sorted.length - 1))];
  return [Math.min(at(0.01), 0), Math.max(at(0.99), 0)];
}
