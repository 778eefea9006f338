// The chosen robot: which visual tokens it sent last, as a grid of its views, and what that cost.

import { bytes, dB, fixed, known, ms, node, say, short, span, split } from "./format.js";
import { mean, sums } from "./history.js";
import { standing } from "./table.js";

const WINDOW_S = 10;

function mixed(high, low, share) {
  const [a, b] = [high, low].map((hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)));
  return `rgb(${a.map((v, i) => Math.round(v + (b[i] - v) * share)).join(" ")})`;
}

export class Chosen {
  constructor(find, ask) {
    this.find = find;
    this.ask = ask;
    this.number = null;
    this.tokens = null;
    this.asked = "";
    this.asking = false;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#drawGrid());
    new ResizeObserver(() => this.#drawGrid()).observe(find("views"));
  }

  /** Chooses a robot; null chooses none. */
  choose(number) {
    if (number === this.number) return;
    this.number = number;
    this.tokens = null;
    this.asked = "";
    this.find("views").replaceChildren();
  }

  update(robot, now_s) {
    const { find } = this, there = Boolean(robot);
    for (const id of ["chosen-state", "chosen-says", "views-legend"]) find(id).hidden = !there;
    if (!there) {
      say(find("chosen-title"), this.number === null ? "No robot chosen" : "This robot has left");
      say(find("views-note"), "Choose a robot to see which visual tokens it sends.");
      find("views").replaceChildren();
      find("facts").replaceChildren();
      return;
    }
    say(find("chosen-title"), split(robot.name)[0]);
    const [cls, word] = standing(robot, now_s);
    find("chosen-state").className = `badge ${cls}`;
    say(find("chosen-state"), word);
    this.#facts(robot, now_s);
    this.#refresh(robot);
  }

  async #refresh(robot) {
    const wanted = `${robot.number} ${robot.episode} ${robot.step} ${robot.outcome}`;
    if (this.asking || wanted === this.asked) return;
    this.asking = true;
    try {
      const answer = await this.ask(`/v1/fleet/tokens?robot=${robot.number}`);
      if (!answer.ok) return;
      const tokens = await answer.json();
      if (tokens.number !== this.number) return; // another was chosen meanwhile
      this.asked = wanted;
      this.tokens = tokens;
      this.#drawGrid();
    } catch {
      // the stream says when the server is gone
    } finally {
      this.asking = false;
    }
  }

  #drawGrid() {
    const { find, tokens } = this;
    if (!tokens) return;
    const says = find("chosen-says");
    says.hidden = !tokens.instruction;
    say(says, tokens.instruction);
    find("views-legend").hidden = tokens.positions === null;
    if (tokens.positions === null) {
      find("views").replaceChildren();
      say(find("views-note"), `It sends pictures (${tokens.coding}); the cloud makes the tokens.`);
      return;
    }
    const [views, rows, columns] = tokens.grid, kept = tokens.positions, place = find("views");
    if (place.children.length !== views) {
      place.replaceChildren(...Array.from({ length: views }, () =>
        node("figure", {}, node("canvas", { role: "img" }), node("figcaption"))));
    }
    const style = getComputedStyle(document.documentElement);
    const [cell, low, high] = ["--cell", "--low", "--high"].map((name) => style.getPropertyValue(name).trim());
    [...place.children].forEach((figure, view) => {
      const [canvas, caption] = figure.children;
      const here = kept.map((p, rank) => [p - view * rows * columns, rank]).filter(([p]) => p >= 0 && p < rows * columns);
      const text = `View ${view + 1}: ${here.length} of ${rows * columns}`;
      say(caption, text);
      canvas.setAttribute("aria-label", `${text} tokens kept, on a grid of ${rows} by ${columns}`);
      canvas.dataset.kept = here.length;
      const side = Math.max(columns, Math.round(canvas.clientWidth * devicePixelRatio));
      if (canvas.width !== side) canvas.width = canvas.height = side;
      const pen = canvas.getContext("2d"), gap = Math.max(1, Math.round(side / columns / 9));
      const edge = (i, n) => Math.round((i * (side + gap)) / n);
      const fill = (p, colour) => {
        const [r, c] = [Math.floor(p / columns), p % columns];
        const [x, y] = [edge(c, columns), edge(r, rows)];
        pen.fillStyle = colour;
        pen.fillRect(x, y, edge(c + 1, columns) - gap - x, edge(r + 1, rows) - gap - y);
      };
      pen.clearRect(0, 0, side, side);
      for (let p = 0; p < rows * columns; p++) fill(p, cell);
      for (const [p, rank] of here) fill(p, mixed(high, low, rank / Math.max(1, kept.length - 1)));
    });
    const share = fixed((100 * kept.length) / tokens.num_tokens, 1);
    say(find("views-note"), `${kept.length} of ${tokens.num_tokens} tokens sent (${share} %), step ${tokens.step}.`);
  }

  #facts(robot, now_s) {
    const recent = (name) => mean(robot.seconds, now_s, WINDOW_S, name);
    const sent = sums(robot.seconds, now_s, WINDOW_S, ["payload_bytes", "wire_bytes", "answered", "refused"]);
    const calls = sent.answered + sent.refused;
    const per = (value) => (calls ? bytes(value / calls) : "–");
    const age = known(robot.snr_age_s) && robot.snr_age_s > 0 ? `, ${ms(1000 * robot.snr_age_s)} old` : "";
    const facts = [
      ["SNR reported", known(robot.snr_db) ? dB(robot.snr_db) + age : "none"],
      ["K*, mean of 10 s", `${short(recent("tokens"))} tokens`],
      ["Coding", robot.coding || "–"],
      ["Payload per request", per(sent.payload_bytes)],
      ["On the wire", per(sent.wire_bytes)],
      ["Requests", `${short(calls / WINDOW_S)} per s`],
      ["Answer time", ms(recent("total_ms"))],
      ["of it queue, model", `${ms(recent("queue_ms"))}, ${ms(recent("predict_ms"))}`],
      ["Answered", fixed(robot.total.answered)],
      ["Refused, bridged", `${fixed(robot.total.refused)}, ${fixed(robot.total.bridged)}`],
      ["Sent in all", bytes(robot.total.wire_bytes)],
      ["Episode, step", `${robot.episode < 0 ? "–" : robot.episode}, ${robot.step}`],
      ...(robot.owner ? [["Identity", robot.owner]] : []),
      ["Session", robot.name],
      ["Model", robot.model || "–"],
      ["Last seen", `${span(now_s - robot.seen_s)} ago`],
    ];
    const place = this.find("facts");
    if (place.children.length !== 2 * facts.length)
      place.replaceChildren(...facts.flatMap(() => [node("dt"), node("dd")]));
    facts.forEach(([name, value], i) => { say(place.children[2 * i], name); say(place.children[2 * i + 1], value); });
  }
}
