// A live page of the fleet. One stream of events; everything is drawn from the history that it fills.

import { Charts } from "./charts.js";
import { bytes, fixed, known, ms, node, say, short, span, split, words } from "./format.js";
import { History, mean, most, sums } from "./history.js";
import { Chosen } from "./robot.js";
import { ask, Stream, token } from "./stream.js";
import { standing, Table } from "./table.js";

const find = (id) => document.getElementById(id);
const WINDOW_S = 10;
const PHASES = {
  loading: ["warn", "starting: loading the model"], warming: ["warn", "starting: warming up"],
  serving: ["good live", "serving"], draining: ["warn", "draining"], stopped: ["bad", "stopped"],
};

const history = new History();
const charts = new Charts(find("charts"));
const chosen = new Chosen(find, ask);
const table = new Table(find("heads"), find("rows"), (number) => { choose(number); draw(); reveal(); });
let chosenName = null; // outlives a restart of the server, which numbers robots anew
let connected = false;

function choose(number) {
  const robot = history.robots.get(number);
  chosenName = robot ? `${robot.owner} ${robot.name}` : chosenName;
  chosen.choose(number);
}

/** Where the robot's card is not in sight, as on a phone, it is scrolled to. */
function reveal() {
  const box = find("chosen").getBoundingClientRect();
  if (box.top > innerHeight * 0.8) {
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    find("chosen").scrollIntoView({ behavior: still ? "auto" : "smooth" });
  }
}

function state(cls, word) {
  find("state").className = `badge ${cls}`;
  say(find("state-word"), word);
}

/** A number and its unit, which may be missing. */
function parted(text) {
  const [value, unit = ""] = text.split("\u00a0");
  return [value, unit];
}

function tiles(now_s) {
  const { server, seconds, total, robots } = history;
  const rates = sums(seconds, now_s, WINDOW_S, ["answered", "wire_bytes", "payload_bytes"]);
  const minute = sums(seconds, now_s + 1, 60, ["refused", "bridged"]);
  const recent = (name) => mean(seconds, now_s, WINDOW_S, name);
  const answering = [...robots.values()].filter((r) => standing(r, now_s)[0] === "good").length;
  const tokens = recent("tokens"), all = server.num_tokens;
  const share = known(tokens) && all ? `${fixed((100 * tokens) / all, 1)} % of all` : "mean of 10 s";
  const busy = known(server.utilization) ? fixed(100 * server.utilization) : "–";
  const parts = [
    ["Robots", fixed(robots.size), "", `${answering} answering`],
    ["Answers", short(rates.answered / WINDOW_S), "per s", `${fixed(total.answered)} in all`],
    ["Answer time", ...parted(ms(recent("total_ms"))), `slowest ${ms(most(seconds, now_s, WINDOW_S, "slowest_ms"))}`],
    ["Tokens in use", short(tokens), all ? `of ${fixed(all)}` : "", share],
    ["Uplink", ...parted(bytes(rates.wire_bytes / WINDOW_S) + "/s"), `payload ${bytes(rates.payload_bytes / WINDOW_S)}/s`],
    ["Without an answer", fixed(minute.refused + minute.bridged), "in 1 min", `${fixed(minute.refused)} refused, ${fixed(minute.bridged)} bridged`],
    ["Model busy", busy, "%", `${fixed(server.queue_depth)} in the queue`],
  ];
  const place = find("tiles");
  if (!place.children.length) {
    place.replaceChildren(...parts.map(([name]) => node("div", {}, node("dt", {}, name),
      node("dd", { class: "big" }, node("span"), " ", node("small")), node("dd", { class: "more" }))));
  }
  parts.forEach(([, value, unit, more], i) => {
    const [, big, small] = place.children[i].children;
    say(big.children[0], value);
    say(big.children[1], unit);
    say(small, more);
  });
}

function why() {
  const reasons = Object.entries(history.server.refused ?? {}).sort((a, b) => b[1] - a[1]);
  find("why").hidden = !reasons.length;
  find("reasons").replaceChildren(...reasons.map(([reason, count]) =>
    node("div", {}, node("dt", {}, words(reason)), node("dd", {}, fixed(count)))));
}

function draw() {
  const { server, robots } = history, now_s = history.now_s;
  if (!now_s) return;
  say(find("model"), server.model ?? "No model yet");
  const about = [`release ${server.version}`, `up ${span(server.up_s)}`];
  if (server.fingerprint) about.unshift(`fingerprint ${server.fingerprint}`);
  say(find("about"), about.join(" · "));
  if (connected) state(...(PHASES[server.phase] ?? ["warn", server.phase]));
  if (!robots.has(chosen.number)) {
    const again = [...robots.values()].find((r) => `${r.owner} ${r.name}` === chosenName);
    const first = [...robots.values()].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }))[0];
    if (again) choose(again.number);
    else if (chosen.number === null && first) choose(first.number);
  }
  const robot = robots.get(chosen.number);
  tiles(now_s);
  charts.draw(history.seconds, robot?.seconds ?? [], robot ? split(robot.name)[0] : "", now_s, history.kept_s);
  table.update(robots, now_s, chosen.number);
  find("no-robots").hidden = robots.size > 0;
  find("robots-table").hidden = !robots.size;
  say(find("robots-note"), robots.size ? `${robots.size} seen in the last minute` : "");
  chosen.update(robot, now_s);
  why();
  const lost = connected ? "" : "connection lost · ";
  document.title = `${lost}${robots.size} ${robots.size === 1 ? "robot" : "robots"} · ComVLA fleet`;
}

let drawing = false;
function drawSoon() { // once per frame, however many events come
  if (drawing) return;
  drawing = true;
  const now = () => { drawing = false; draw(); };
  if (document.hidden) setTimeout(now); else requestAnimationFrame(now);
}

function show(part) {
  find("live").hidden = part !== "live";
  find("sign-in").hidden = part !== "sign-in";
  find("sign-out").hidden = part !== "live" || token.get() === null;
}

let retryAt = 0, counting = null;
function banner(text, wait_ms = 0) {
  find("banner").hidden = !text;
  say(find("banner-text"), text);
  clearInterval(counting);
  if (!text) return;
  retryAt = performance.now() + wait_ms;
  const tell = () => say(find("banner-when"), `in ${Math.max(0, Math.ceil((retryAt - performance.now()) / 1000))} s`);
  tell();
  counting = setInterval(tell, 250);
}

const stream = new Stream({
  event(name, data) {
    if (name === "hello") { history.hello(data); chosen.choose(null); } else history.tick(data);
    if (!connected) { connected = true; banner(""); show("live"); find("live").classList.remove("stale"); }
    drawSoon();
  },
  shut(refused) {
    connected = false;
    banner("");
    state("warn", "signed out");
    show("sign-in");
    say(find("sign-in-error"), refused ? "This is none of the server's admin tokens." : "");
    find("token").focus();
  },
  lost(why, wait_ms) {
    connected = false;
    state("bad", "connection lost");
    banner(`${why}, retrying`, wait_ms);
    find("live").classList.add("stale");
    drawSoon();
  },
});

find("retry").addEventListener("click", () => stream.now());
find("sign-in").addEventListener("submit", (event) => {
  event.preventDefault();
  token.set(find("token").value.trim());
  find("token").value = "";
  say(find("sign-in-error"), "");
  stream.run();
});
find("sign-out").addEventListener("click", () => {
  stream.end();
  token.clear();
  location.reload();
});
stream.run();
