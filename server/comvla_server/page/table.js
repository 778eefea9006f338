// The robots: a table that is sorted by its headings and walked through with the arrow keys.

import { answered, fixed, known, node, say, short, span, split, svg, words } from "./format.js";
import { mean, sums } from "./history.js";
import { sparkline } from "./charts.js";

const QUIET_S = 5;
const WINDOW_S = 10;
const SETTLE_MS = 3000; // rows change places this seldom by themselves

const COLUMNS = [
  { key: "name", title: "Robot" },
  { key: "state", title: "State", cls: "state wide-2" },
  { key: "snr", title: "SNR", unit: "dB", show: (v) => fixed(v.snr, 1) },
  { key: "kept", title: "K*", unit: "tokens", show: (v) => short(v.kept) },
  { key: "trend", title: "K*", unit: "last minute", cls: "wide-1", still: true },
  { key: "wire", title: "Uplink", unit: "KiB/s", cls: "wide-3", show: (v) => short(v.wire) },
  { key: "time", title: "Answer", unit: "ms", show: (v) => short(v.time) },
  { key: "refused", title: "Refused", unit: "calls", cls: "wide-2", show: (v) => fixed(v.refused) },
  { key: "bridged", title: "Bridged", unit: "steps", cls: "wide-2", show: (v) => fixed(v.bridged) },
  { key: "step", title: "Episode", unit: "and step", cls: "wide-1", show: (v) => v.place },
  { key: "age", title: "Seen", unit: "ago", cls: "wide-3", show: (v) => span(v.age) },
];

const collator = new Intl.Collator("en", { numeric: true });

/** Where a robot stands, in words and in a colour that only repeats them. */
export function standing(robot, now_s) {
  const age = now_s - robot.seen_s;
  if (age > QUIET_S) return ["idle", `quiet for ${span(age)}`];
  return answered(robot.outcome) ? ["good", "answering"] : ["bad", words(robot.outcome)];
}

function values(robot, now_s) {
  const rates = sums(robot.seconds, now_s, WINDOW_S, ["wire_bytes"]);
  return {
    name: robot.name, state: standing(robot, now_s)[1], snr: robot.snr_db,
    kept: mean(robot.seconds, now_s, WINDOW_S, "tokens") ?? robot.kept,
    wire: rates.wire_bytes / 1024 / WINDOW_S, time: mean(robot.seconds, now_s, WINDOW_S, "total_ms"),
    refused: robot.total.refused, bridged: robot.total.bridged,
    step: Math.max(0, robot.episode) * 1e6 + robot.step,
    place: robot.episode < 0 ? `– · ${robot.step}` : `${robot.episode} · ${robot.step}`,
    age: Math.max(0, now_s - robot.seen_s),
  };
}

class Row {
  constructor(robot, choose) {
    const [main, nonce] = split(robot.name);
    const under = [nonce, robot.owner].filter(Boolean).join(" · ");
    this.pick = node("button", { type: "button", class: "pick", "aria-pressed": "false", title: robot.name }, main);
    if (under) this.pick.append(node("small", {}, under));
    this.pick.addEventListener("click", () => choose(robot.number));
    this.root = node("tr", { "data-robot": robot.name }, node("th", { scope: "row" }, this.pick));
    this.cells = {};
    for (const column of COLUMNS.slice(1))
      this.root.append(this.cells[column.key] = node("td", { class: column.cls ?? "" }));
    this.word = node("span", {});
    this.badge = node("span", { class: "badge" }, node("span", { class: "dot", "aria-hidden": "true" }), this.word);
    this.cells.state.append(this.badge);
    this.path = svg("path", { class: "line" });
    this.cells.trend.append(svg("svg", { viewBox: "0 0 120 24", class: "c-tokens", "aria-hidden": "true", preserveAspectRatio: "none" }, this.path));
  }

  update(robot, now_s, chosen) {
    this.values = values(robot, now_s);
    const [cls, word] = standing(robot, now_s);
    this.badge.className = `badge ${cls}`;
    say(this.word, word);
    for (const column of COLUMNS) if (column.show) say(this.cells[column.key], column.show(this.values));
    const high = Math.max(4, ...robot.seconds.map((s) => s.tokens ?? 0));
    sparkline(this.path, robot.seconds, now_s, "tokens", high);
    this.root.dataset.step = robot.step;
    this.root.classList.toggle("on", chosen);
    this.pick.setAttribute("aria-pressed", String(chosen));
  }
}

export class Table {
  constructor(heads, body, choose) {
    this.body = body;
    this.choose = choose;
    this.rows = new Map();
    this.key = "name";
    this.down = false;
    this.sorted_ms = -Infinity;
    this.heads = COLUMNS.map((column) => {
      const head = node("th", { scope: "col", class: column.cls ?? "" });
      const unit = node("small", {}, column.unit ?? "");
      if (column.still) head.append(node("span", { class: "still" }, column.title, unit));
      else {
        const way = node("span", { class: "way", "aria-hidden": "true" });
        const button = node("button", { type: "button" }, column.title, way, unit);
        button.addEventListener("click", () => this.#sortBy(column.key));
        head.append(button);
      }
      return head;
    });
    heads.replaceChildren(...this.heads);
    this.#mark();
    body.addEventListener("keydown", (event) => this.#walk(event));
  }

  update(robots, now_s, chosen) {
    for (const [number, row] of this.rows)
      if (!robots.has(number)) { row.root.remove(); this.rows.delete(number); }
    for (const [number, robot] of robots) {
      let row = this.rows.get(number);
      if (!row) {
        this.rows.set(number, row = new Row(robot, this.choose));
        this.body.append(row.root);
        this.sorted_ms = -Infinity;
      }
      row.update(robot, now_s, number === chosen);
    }
    // Not under the hands of somebody who walks through the rows.
    const busy = this.body.contains(document.activeElement) && Number.isFinite(this.sorted_ms);
    if (!busy && performance.now() - this.sorted_ms > SETTLE_MS) this.#sort();
  }

  #sortBy(key) {
    this.down = this.key === key ? !this.down : key !== "name";
    this.key = key;
    this.#mark();
    this.#sort();
  }

  #mark() {
    this.heads.forEach((head, i) => {
      if (COLUMNS[i].key === this.key) head.setAttribute("aria-sort", this.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
  }

  #sort() {
    this.sorted_ms = performance.now();
    const of = (row) => row.values[this.key], sign = this.down ? -1 : 1;
    const order = [...this.rows.values()].sort((a, b) => {
      const [u, v] = [of(a), of(b)];
      if (typeof u === "string") return sign * collator.compare(u, v);
      if (!known(u) || !known(v)) return known(v) - known(u); // unknown ones last, either way
      return sign * (u - v) || collator.compare(a.values.name, b.values.name);
    });
    const current = [...this.body.children];
    const focused = this.body.contains(document.activeElement) ? document.activeElement : null;
    if (order.some((row, i) => row.root !== current[i])) {
      this.body.append(...order.map((row) => row.root));
      focused?.focus({ preventScroll: true });
    }
  }

  #walk(event) {
    const picks = [...this.body.querySelectorAll(".pick")], at = picks.indexOf(document.activeElement);
    const last = picks.length - 1;
    const to = { ArrowDown: Math.min(last, at + 1), ArrowUp: Math.max(0, at - 1), Home: 0, End: last }[event.key];
    if (at < 0 || to === undefined) return;
    picks[to].focus();
    event.preventDefault();
  }
}
