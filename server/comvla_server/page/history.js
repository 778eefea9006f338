// What the server told, merged: seconds of the fleet and of each robot, kept for three minutes.

/** Seconds on top of older ones; those from the first new one on are replaced. */
function merged(history, rows, columns, oldest) {
  const fresh = rows.map((row) => Object.fromEntries(columns.map((name, i) => [name, row[i]])));
  const kept = history.filter((s) => s.at_s >= oldest && (!fresh.length || s.at_s < fresh[0].at_s));
  return kept.concat(fresh);
}

/** Sums of some columns over the last seconds that are over. */
export function sums(seconds, now_s, window_s, names) {
  const to = Math.floor(now_s), from = to - window_s;
  const result = Object.fromEntries(names.map((name) => [name, 0]));
  for (let i = seconds.length - 1; i >= 0 && seconds[i].at_s >= from; i--)
    if (seconds[i].at_s < to) for (const name of names) result[name] += seconds[i][name];
  return result;
}

/** Mean of a column over the last seconds, each weighed by its answers. */
export function mean(seconds, now_s, window_s, name) {
  let sum = 0, count = 0;
  for (let i = seconds.length - 1; i >= 0 && seconds[i].at_s >= now_s - window_s; i--) {
    const second = seconds[i];
    if (second[name] !== null) { sum += second[name] * second.answered; count += second.answered; }
  }
  return count ? sum / count : null;
}

/** Largest value of a column over the last seconds. */
export function most(seconds, now_s, window_s, name) {
  const values = seconds.filter((s) => s.at_s >= now_s - window_s && s[name] !== null).map((s) => s[name]);
  return values.length ? Math.max(...values) : null;
}

export class History {
  constructor() {
    this.robots = new Map();
    this.seconds = [];
    this.server = {};
    this.total = {};
    this.kept_s = 180;
    this.boot = "";
    this.now_s = 0;
    this.told_ms = 0;
  }

  /** The server's time now: its own of the last event, and what has passed here since. */
  get clock_s() {
    return this.now_s + (performance.now() - this.told_ms) / 1000;
  }

  /** Begins anew with the first event of a stream. */
  hello(data) {
    this.columns = data.columns;
    this.kept_s = data.kept_seconds;
    this.boot = data.boot;
    this.seconds = [];
    this.robots.clear();
    this.tick(data);
  }

  /** Adds an event. */
  tick(data) {
    this.now_s = data.now_s;
    this.told_ms = performance.now();
    this.server = data.server;
    this.total = data.total;
    const oldest = Math.floor(this.now_s) - this.kept_s;
    this.seconds = merged(this.seconds, data.seconds, this.columns, oldest);
    for (const row of data.robots) {
      const before = this.robots.get(row.number);
      row.seconds = merged(before ? before.seconds : [], row.seconds, this.columns, oldest);
      this.robots.set(row.number, row);
    }
    for (const number of data.gone ?? []) this.robots.delete(number);
  }
}
