// Server-sent events over fetch, so that the token travels in a header and never in an address.

const KEY = "comvla-admin-token";
const SILENCE_MS = 5000; // the server speaks every second
const WAITS_MS = [500, 1000, 2000, 4000, 5000];

export const token = {
  get: () => sessionStorage.getItem(KEY),
  set: (value) => sessionStorage.setItem(KEY, value),
  clear: () => sessionStorage.removeItem(KEY),
};

/** A request to this server. Without credentials, so that no browser asks for a password by itself. */
export function ask(path, options = {}) {
  const secret = token.get();
  const headers = secret ? { authorization: `Bearer ${secret}` } : {};
  return fetch(path, { ...options, headers, credentials: "omit", cache: "no-store" });
}

/** Keeps a stream open for ever, and says how that goes.
 *
 *  on.event(name, data)   an event
 *  on.shut(refused)       a token is needed; refused: the one that was given is none
 *  on.lost(why, wait_ms)  it broke, or was refused; the next try comes by itself
 */
export class Stream {
  #on;
  #stop = null;
  #wake = null;
  #running = false;

  constructor(on) {
    this.#on = on;
    addEventListener("online", () => this.now());
    document.addEventListener("visibilitychange", () => { if (!document.hidden) this.now(); });
  }

  /** Begins, unless it has begun. */
  async run() {
    if (this.#running) return;
    this.#running = true;
    for (let tries = 0; this.#running; ) {
      let why = "Connection lost";
      try {
        const answer = await this.#open();
        if (answer.status === 401) {
          this.#running = false;
          const refused = token.get() !== null;
          token.clear();
          this.#on.shut(refused);
          return;
        }
        if (answer.ok) {
          await this.#read(answer, () => { tries = 0; });
        } else {
          const { detail } = await answer.json().catch(() => ({}));
          why = typeof detail === "string" ? `The server says: ${detail}` : `The server answered ${answer.status}`;
        }
      } catch {
        // not there, gone, or silent for too long
      }
      if (!this.#running) return;
      const wait = WAITS_MS[Math.min(tries++, WAITS_MS.length - 1)] * (0.8 + 0.4 * Math.random());
      this.#on.lost(why, wait);
      await new Promise((done) => { this.#wake = done; setTimeout(done, wait); });
      this.#wake = null;
    }
  }

  /** Tries at once where it waits. */
  now() {
    this.#wake?.();
  }

  /** Ends it for good, or until the next run. */
  end() {
    this.#running = false;
    this.#stop?.abort();
    this.#wake?.();
  }

  #open() {
    this.#stop = new AbortController();
    return this.#patient(ask("/events", { signal: this.#stop.signal }));
  }

  /** A promise that breaks the stream where it takes too long. */
  async #patient(promise) {
    const stop = this.#stop, timer = setTimeout(() => stop.abort(), SILENCE_MS);
    try { return await promise; } finally { clearTimeout(timer); }
  }

  async #read(answer, alive) {
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    let text = "";
    for (;;) {
      const { done, value } = await this.#patient(reader.read());
      if (done) return;
      text += value;
      const events = text.split("\n\n");
      text = events.pop();
      for (const event of events) {
        const fields = Object.fromEntries(event.split("\n").map((line) => {
          const at = line.indexOf(": ");
          return [line.slice(0, at), line.slice(at + 2)];
        }));
        if (fields.data) { alive(); this.#on.event(fields.event, JSON.parse(fields.data)); }
      }
    }
  }
}
