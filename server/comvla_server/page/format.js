// Numbers with their units, and elements without markup: whatever robots say becomes text, never HTML.

const GAP = "\u00a0";
const NONE = "–";

/** An element with attributes and children; strings become text. */
export function node(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** The same in SVG. */
export function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/** Sets text only where it changed, so that nothing blinks and no reader speaks twice. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

export function fixed(value, digits = 0) {
  return known(value) ? value.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits }) : NONE;
}

/** About three digits. */
export function short(value) {
  if (!known(value)) return NONE;
  const size = Math.abs(value);
  return fixed(value, size >= 100 || value === 0 ? 0 : size >= 10 ? 1 : 2);
}

export const dB = (value) => (known(value) ? fixed(value, 1) + GAP + "dB" : NONE);
export const ms = (value) => (known(value) ? short(value) + GAP + "ms" : NONE);

export function bytes(value) {
  if (!known(value)) return NONE;
  for (const [unit, size] of [["GiB", 2 ** 30], ["MiB", 2 ** 20], ["KiB", 2 ** 10]])
    if (value >= size) return short(value / size) + GAP + unit;
  return fixed(value) + GAP + "B";
}

export function span(seconds) {
  if (!known(seconds)) return NONE;
  if (seconds < 10) return fixed(Math.max(0, seconds), 1) + GAP + "s";
  if (seconds < 90) return fixed(seconds) + GAP + "s";
  if (seconds < 5400) return fixed(seconds / 60) + GAP + "min";
  if (seconds < 172800) return fixed(seconds / 3600, 1) + GAP + "h";
  return fixed(seconds / 86400, 1) + GAP + "days";
}

/** A robot's name, and the random part that its client put behind it. */
export function split(name) {
  const match = /^(.+)\.([0-9a-f]{8})$/.exec(name);
  return match ? [match[1], match[2]] : [name, ""];
}

const REASONS = {
  ok: "answering", repeat: "answering",
  malformed: "not a message of the contract", invalid: "content the model cannot take",
  conflict: "a step sent twice with other content", mismatch: "another model or protocol",
  unknown_model: "a model not served here", predicted_late: "would have been too late",
  congested: "turned away at the door", fair_share: "above its share",
  oversize: "message too large", overload: "server full", short: "too few tokens in time",
  key_frame: "key frame needed", superseded: "overtaken by a newer step", deadline: "too late",
  cancelled: "robot hung up", loading: "model loading", draining: "server stopping",
  model: "model failed", no_identity: "no token, or an unknown one", not_owner: "another robot's session",
  rate: "above its rate", slow: "arrived too slowly",
};

/** Words for an outcome; one that this page does not know speaks for itself. */
export const words = (outcome) => (Object.hasOwn(REASONS, outcome) ? REASONS[outcome] : outcome);

export const answered = (outcome) => outcome === "ok" || outcome === "repeat";
