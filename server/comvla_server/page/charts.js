// Five charts over one time axis. Seconds come in, SVG goes out; a cursor shows the numbers of any second.

import { bytes, dB, fixed, known, ms, node, short, span, svg } from "./format.js";

const LEFT = 38, RIGHT = 6, TOP = 8, LANE = 92, BOTTOM = 20;
const BREAK_S = 5; // a line is not drawn across a longer silence

/** Bounds that are round numbers, and a few ticks. */
function scale(low, high) {
  const step0 = Math.max(high - low, 1e-9) / 3, power = 10 ** Math.floor(Math.log10(step0));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= step0 * 0.999);
  const from = Math.floor(low / step + 1e-9) * step, to = Math.ceil(high / step - 1e-9) * step;
  const ticks = [];
  for (let v = from; v <= to + step / 2; v += step) ticks.push(Math.abs(v) < step / 1e6 ? 0 : v);
  return { low: from, high: ticks[ticks.length - 1], ticks };
}

const rest = (s) => (known(s.total_ms) ? Math.max(0, s.total_ms - s.decode_ms - s.queue_ms - s.predict_ms) : null);

const line = (name, cls, of, show) => ({ kind: "line", name, cls, of, show });
const perSecond = (kib) => bytes(kib * 1024) + "/s";
const stack = (name, cls, of, show) => ({ kind: "stack", name, cls, of, show });

const CHARTS = [
  {
    title: "SNR reported", unit: "dB", low: null, least: 6,
    parts: [
      { kind: "band", cls: "c-snr", low: (s) => s.snr_db_low, high: (s) => s.snr_db_high },
      line("mean", "c-snr", (s) => s.snr_db, dB),
    ],
    own: line("", "c-ink", (s) => s.snr_db, dB),
  },
  {
    title: "K*, tokens sent per request", unit: "", low: 0, least: 4,
    parts: [
      { kind: "band", cls: "c-tokens", low: (s) => s.tokens_low, high: (s) => s.tokens_high },
      line("mean", "c-tokens", (s) => s.tokens, short),
    ],
    own: line("", "c-ink", (s) => s.tokens, short),
  },
  {
    title: "Uplink", unit: "KiB/s", low: 0, least: 1, whole: true,
    parts: [
      stack("wire", "c-bytes faint", (s) => s.wire_bytes / 1024, perSecond),
      line("payload", "c-bytes", (s) => s.payload_bytes / 1024, perSecond),
    ],
    own: line("", "c-ink", (s) => s.wire_bytes / 1024, perSecond),
  },
  {
    title: "Answer time by phase", unit: "ms", low: 0, least: 2,
    parts: [
      stack("read", "c-decode", (s) => s.decode_ms, ms),
      stack("queue", "c-queue", (s) => s.queue_ms, ms),
      stack("model", "c-predict", (s) => s.predict_ms, ms),
      stack("rest", "c-rest", rest, ms),
      { kind: "dots", name: "slowest", cls: "c-ink", of: (s) => s.slowest_ms, show: ms },
    ],
    own: null,
  },
  {
    title: "Without an answer", unit: "steps per second", low: 0, least: 2, whole: true,
    parts: [
      stack("refused", "c-bad", (s) => s.refused, (v) => fixed(v)),
      stack("bridged by robots", "c-warn", (s) => s.bridged, (v) => fixed(v)),
    ],
    own: null,
  },
];

class Chart {
  constructor(plan, seek) {
    this.plan = plan;
    this.keys = node("div", { class: "keys" });
    this.root = svg("svg", { role: "img", tabindex: "0" });
    const unit = plan.unit ? `, ${plan.unit}` : "";
    const caption = node("figcaption", {}, node("b", {}, plan.title + unit), this.keys);
    this.figure = node("figure", { class: "card chart" }, caption, this.root);
    this.root.addEventListener("pointermove", (event) => {
      const box = this.root.getBoundingClientRect();
      const share = ((event.clientX - box.left) / box.width * this.width - LEFT) / (this.width - LEFT - RIGHT);
      seek(Math.round((1 - Math.min(1, Math.max(0, share))) * this.kept_s));
    });
    this.root.addEventListener("pointerleave", () => seek(null));
    this.root.addEventListener("blur", () => { this.keys.removeAttribute("aria-live"); seek(null); });
    this.root.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: 1, ArrowRight: -1, PageUp: 15, PageDown: -15 };
      if (event.key === "Escape") seek(null);
      else if (event.key in steps) seek((age) => Math.min(this.kept_s, Math.max(0, (age ?? 1) + steps[event.key])));
      else return;
      this.keys.setAttribute("aria-live", "polite"); // the numbers are spoken while somebody walks over them
      event.preventDefault();
    });
  }

  draw(seconds, own, ownName, now_s, kept_s, age) {
    const plan = this.plan;
    this.kept_s = kept_s;
    this.width = Math.max(240, Math.round(this.figure.clientWidth - 26));
    const height = TOP + LANE + BOTTOM, to = Math.floor(now_s) + 1, from = to - kept_s;
    const over = (s) => s.at_s >= from && (!plan.whole || s.at_s < to - 1);
    const shown = seconds.filter(over), mine = plan.own ? own.filter(over) : [];
    const x = (t) => LEFT + ((t - from) / kept_s) * (this.width - LEFT - RIGHT);
    const values = [...this.#values(shown, plan.parts), ...(plan.own ? this.#values(mine, [plan.own]) : [])];
    const floor = plan.low ?? (values.length ? Math.min(...values) : 0);
    const top = values.length ? Math.max(...values) : floor;
    const { low, high, ticks } = scale(floor, Math.max(top, floor + plan.least));
    const y = (v) => TOP + LANE - ((Math.min(high, Math.max(low, v)) - low) / (high - low)) * LANE;

    const parts = [];
    for (const tick of ticks) {
      parts.push(svg("line", { x1: LEFT, x2: this.width - RIGHT, y1: y(tick), y2: y(tick), class: "axis" }));
      parts.push(svg("text", { x: LEFT - 6, y: y(tick) + 4, "text-anchor": "end" }, tick.toLocaleString("en", { notation: "compact" })));
    }
    const edges = [[from, "start", `${span(kept_s)} ago`], [to, "end", "now"]];
    for (const [t, anchor, text] of edges) parts.push(svg("text", { x: x(t), y: height - 5, "text-anchor": anchor }, text));
    const base = new Map();
    for (const part of plan.parts) parts.push(this.#draw(part, shown, x, y, base));
    if (plan.own && mine.length) parts.push(this.#draw({ ...plan.own, extra: "own" }, mine, x, y, base));
    const at = age === null ? null : Math.min(to - 1, to - age);
    if (at !== null) parts.push(svg("line", { x1: x(at + 0.5), x2: x(at + 0.5), y1: TOP, y2: TOP + LANE, class: "cursor" }));
    this.root.setAttribute("viewBox", `0 0 ${this.width} ${height}`);
    this.root.replaceChildren(...parts);
    this.#label(shown, mine, ownName, at, to - 1);
  }

  #values(seconds, parts) {
    const values = [];
    for (const second of seconds) {
      let stacked = 0;
      for (const part of parts) {
        if (part.kind === "band") values.push(part.low(second), part.high(second));
        else if (part.kind === "stack") values.push(stacked += part.of(second) ?? 0);
        else values.push(part.of(second));
      }
    }
    return values.filter(known);
  }

  #draw(part, seconds, x, y, base) {
    let path = "", last = -Infinity;
    if (part.kind === "line") {
      for (const s of seconds) {
        const v = part.of(s);
        if (!known(v)) continue;
        path += `${s.at_s - last > BREAK_S ? "M" : "L"}${x(s.at_s + 0.5).toFixed(1)} ${y(v).toFixed(1)}`;
        last = s.at_s;
      }
      return svg("path", { d: path, class: `line ${part.cls} ${part.extra ?? ""}` });
    }
    if (part.kind === "dots") {
      for (const s of seconds) {
        const v = part.of(s);
        if (known(v)) path += `M${(x(s.at_s + 0.5) - 1).toFixed(1)} ${(y(v) - 1).toFixed(1)}h2v2h-2z`;
      }
      return svg("path", { d: path, class: `dots ${part.cls}` });
    }
    for (const s of seconds) { // bands and stacks: one column per second
      const from = part.kind === "band" ? part.low(s) : base.get(s.at_s) ?? 0;
      const to = part.kind === "band" ? part.high(s) : from + (part.of(s) ?? NaN);
      if (!known(from) || !known(to) || to === from) continue;
      if (part.kind === "stack") base.set(s.at_s, to);
      path += `M${x(s.at_s).toFixed(1)} ${y(from).toFixed(1)}V${y(to).toFixed(1)}H${x(s.at_s + 1).toFixed(1)}V${y(from).toFixed(1)}z`;
    }
    return svg("path", { d: path, class: `${part.kind === "band" ? "band" : "area"} ${part.cls}` });
  }

  /** Numbers of the second under the cursor, or of now: in the figure's head, and for screen readers. */
  #label(seconds, mine, ownName, at, now) {
    const named = this.plan.parts.filter((part) => part.name);
    if (this.plan.own && ownName) named.push({ ...this.plan.own, name: ownName, mine: true });
    const texts = named.map((part) => {
      const history = part.mine ? mine : seconds;
      const second = at === null ? history.findLast((s) => s.at_s >= now - BREAK_S) : history.find((s) => s.at_s === at);
      const value = second ? part.of(second) : this.plan.whole ? 0 : null;
      return [part, known(value) ? part.show(value) : "–"];
    });
    const when = at === null ? "now" : `${now - at} s ago`;
    const keys = texts.map(([part, text]) => {
      const mark = node("i", { class: `${part.cls} ${part.kind === "dots" ? "round" : ""}`, "aria-hidden": "true" });
      return node("span", {}, mark, `${part.name} `, node("b", {}, text));
    });
    if (at !== null) keys.push(node("span", {}, when));
    this.keys.replaceChildren(...keys);
    const spoken = texts.map(([part, text]) => `${part.name} ${text}`).join(", ");
    this.root.setAttribute("aria-label", `${this.plan.title}, ${when}: ${spoken}`);
  }
}

export class Charts {
  constructor(place) {
    this.age = null;
    const seek = (to) => {
      this.age = typeof to === "function" ? to(this.age) : to;
      this.draw(...this.last);
    };
    this.last = [[], [], "", 0, 180];
    this.charts = CHARTS.map((plan) => new Chart(plan, seek));
    place.replaceChildren(...this.charts.map((chart) => chart.figure));
    new ResizeObserver(() => this.draw(...this.last)).observe(place);
  }

  /** Draws all charts: seconds of the fleet, and of the chosen robot. */
  draw(seconds, own, ownName, now_s, kept_s) {
    this.last = [seconds, own, ownName, now_s, kept_s];
    // A young server fills the width before it fills three minutes.
    const past = Math.floor(now_s) + 1 - (seconds[0]?.at_s ?? now_s);
    kept_s = Math.min(kept_s, Math.max(60, 30 * Math.ceil(past / 30)));
    for (const chart of this.charts) chart.draw(seconds, own, ownName, now_s, kept_s, this.age);
  }
}

/** A small line of a column over the last minute, for a row of the table. */
export function sparkline(root, seconds, now_s, name, high) {
  const from = Math.floor(now_s) - 60;
  let path = "", last = -Infinity;
  for (const s of seconds) {
    if (s.at_s < from || !known(s[name])) continue;
    const x = ((s.at_s - from) / 60) * 120, y = 22 - (Math.min(s[name], high) / Math.max(high, 1)) * 20;
    path += `${s.at_s - last > BREAK_S ? "M" : "L"}${x.toFixed(1)} ${y.toFixed(1)}`;
    last = s.at_s;
  }
  root.setAttribute("d", path);
}
