"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const [views, rows, columns] = data.grid;
  const stillness = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const SVG = "http://www.w3.org/2000/svg";

  const svg = (name, attributes, text) => {
    const node = document.createElementNS(SVG, name);
    for (const key in attributes) node.setAttribute(key, attributes[key]);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  const kib = (bytes) => (bytes / 1024).toFixed(1) + "\u00a0KiB";
  const round = (value) => Math.round(value * 10) / 10;

  /* Three curves over one time axis. Returns a function that moves the cursor. */
  function charts(place, episode, seek) {
    const narrow = place.clientWidth < 520;
    const width = narrow ? 420 : 860, left = 46, right = 10, lane = narrow ? 74 : 66, gap = 24;
    const height = 3 * (lane + gap) + 22;
    const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img",
      "aria-label": "SNR, tokens and bytes over control periods" });
    const last = Math.max(1, episode.periods);
    const x = (t) => left + (t / last) * (width - left - right);
    const sent = episode.queries.filter((q) => q.source === "cloud");
    const held = episode.queries.filter((q) => q.source !== "cloud");
    const steps = (values, y) => values.map((v, t) =>
      `${t ? "L" : "M"}${x(t).toFixed(1)} ${y(v).toFixed(1)}L${x(t + 1).toFixed(1)} ${y(v).toFixed(1)}`).join("");

    const lanes = [
      { name: "SNR, dB", values: episode.snr, low: Math.max(-12, Math.min(0, ...episode.snr)), high: Math.max(15, ...episode.snr) },
      { name: "K*, tokens sent", values: sent.map((q) => q.tokens), low: 0, high: Math.max(1, ...sent.map((q) => q.tokens)) },
      { name: "KiB on the wire, and what the period carried", values: episode.capacity, low: 0,
        high: Math.max(1, ...episode.capacity, ...sent.map((q) => q.bytes)) },
    ];
    lanes.forEach((part, i) => {
      const top = 16 + i * (lane + gap), bottom = top + lane;
      const y = (v) => bottom - ((Math.max(v, part.low) - part.low) / (part.high - part.low)) * lane;
      const label = (v) => (i === 2 ? round(v / 1024) : Math.round(v));
      root.append(svg("text", { x: left, y: top - 5, class: "name" }, part.name));
      for (const v of [part.low, part.high]) {
        root.append(svg("line", { x1: left, x2: width - right, y1: y(v), y2: y(v), class: "axis" }));
        root.append(svg("text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, label(v)));
      }
      if (i === 0) root.append(svg("path", { d: steps(episode.snr, y), class: "snr" }));
      if (i === 2) root.append(svg("path", { d: steps(episode.capacity, y), class: "limit" }));
      if (i > 0) for (const q of sent) {
        const kind = i === 1 ? "tokens" : "bytes", value = i === 1 ? q.tokens : q.bytes;
        const at = x(q.t + 0.5);
        root.append(svg("line", { x1: at, x2: at, y1: bottom, y2: y(value), class: `stem ${kind}` }));
        root.append(svg("circle", { cx: at, cy: y(value), r: 3, class: kind }));
      }
      if (i === 1) for (const q of held)
        root.append(svg("circle", { cx: x(q.t + 0.5), cy: bottom, r: 3.5, class: "held" }));
    });
    const end = height - 6;
    root.append(svg("text", { x: left, y: end }, "0 s"));
    root.append(svg("text", { x: width - right, y: end, "text-anchor": "end" },
      `${(last * data.period_s).toFixed(1)} s`));
    root.append(svg("text", { x: (left + width) / 2, y: end, "text-anchor": "middle" },
      `${last} control periods of ${Math.round(1000 * data.period_s)} ms`));
    const cursor = svg("line", { y1: 12, y2: height - 20, class: "cursor" });
    root.append(cursor);
    place.replaceChildren(root);
    const point = (event) => {
      const box = root.getBoundingClientRect();
      const at = ((event.clientX - box.left) / box.width) * width;
      seek(((at - left) / (width - left - right)) * last);
    };
    root.addEventListener("pointerdown", point);
    root.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
    return (t) => { cursor.setAttribute("x1", x(t)); cursor.setAttribute("x2", x(t)); };
  }

  function player(card) {
    const episode = data.episodes[card.dataset.episode];
    const find = (selector) => card.querySelector(selector);
    const box = find(".player"), scrub = find(".scrub"), play = find(".play");
    const speed = find(".speed"), marks = find(".marks"), readout = find(".readout");
    const canvases = [...card.querySelectorAll("canvas")];
    const pictures = episode.frames.map(([, uri]) => { const p = new Image(); p.src = uri; return p; });
    const queryAt = (t) => episode.queries.filter((q) => q.t <= t && q.source === "cloud").pop();
    let index = 0, timer = null, moveCursor = () => {};
    scrub.max = episode.frames.length - 1;

    function drawView(canvas, view, picture, query) {
      const side = picture.naturalHeight;
      if (!side) return;
      if (canvas.width !== side) canvas.width = canvas.height = side;
      const pen = canvas.getContext("2d");
      pen.drawImage(picture, view * side, 0, side, side, 0, 0, side, side);
      if (!query || marks.value === "off") return;
      const w = side / columns, h = side / rows;
      const cells = query.positions.map((p, rank) => [p, rank]).filter(([p]) => Math.floor(p / (rows * columns)) === view)
        .map(([p, rank]) => { const c = p % (rows * columns); return [(c % columns) * w, Math.floor(c / columns) * h, rank]; });
      if (marks.value === "spot") {
        pen.beginPath();
        pen.rect(0, 0, side, side);
        for (const [cx, cy] of cells) pen.rect(cx, cy, w, h);
        pen.fillStyle = "rgba(8, 12, 20, .62)";
        pen.fill("evenodd");
      }
      for (const [cx, cy, rank] of cells.reverse()) {
        const share = 1 - rank / query.positions.length;
        pen.strokeStyle = `hsl(${45 + 10 * (1 - share)} 100% ${45 + 20 * share}% / ${0.25 + 0.75 * share})`;
        pen.lineWidth = 1 + 1.2 * share;
        pen.strokeRect(cx + 1, cy + 1, w - 2, h - 2);
      }
    }

    function show() {
      const [t] = episode.frames[index], query = queryAt(t), picture = pictures[index];
      const draw = () => { if (pictures[index] === picture) canvases.forEach((c, v) => drawView(c, v, picture, query)); };
      if (picture.complete) draw(); else picture.addEventListener("load", draw, { once: true });
      scrub.value = index;
      scrub.setAttribute("aria-valuetext", `period ${t} of ${episode.periods}`);
      moveCursor(t);
      const snr = episode.snr[Math.min(t, episode.snr.length - 1)];
      const sent = query ? ` · sent <b>${query.tokens}</b> of ${data.num_tokens} tokens, <b>${kib(query.bytes)}</b>` +
        (query.capacity ? ` of ${kib(query.capacity)} that fit` : "") : " · waiting for the link";
      readout.innerHTML = `period <b>${t}</b>` + (snr === undefined ? "" : ` · SNR <b>${snr.toFixed(1)} dB</b>`) + sent;
    }

    function go(to) { index = Math.max(0, Math.min(episode.frames.length - 1, to)); show(); }
    function seek(t) {
      stop();
      let best = 0;
      episode.frames.forEach(([period], i) => { if (period <= t + 0.5) best = i; });
      go(best);
    }
    function stop() { clearTimeout(timer); timer = null; play.textContent = "▶"; play.setAttribute("aria-label", "play"); }
    function tick() {
      if (index >= episode.frames.length - 1) return stop();
      go(index + 1);
      const [t] = episode.frames[index], next = episode.frames[Math.min(index + 1, episode.frames.length - 1)][0];
      timer = setTimeout(tick, (1000 * data.period_s * Math.max(1, next - t)) / Number(speed.value));
    }
    function start() {
      if (index >= episode.frames.length - 1) go(0);
      play.textContent = "❚❚"; play.setAttribute("aria-label", "pause");
      timer = setTimeout(tick, 60);
    }
    const toggle = () => (timer === null ? start() : stop());

    play.addEventListener("click", toggle);
    canvases.forEach((c) => c.addEventListener("click", toggle));
    scrub.addEventListener("input", () => { stop(); go(Number(scrub.value)); });
    marks.addEventListener("change", show);
    box.addEventListener("keydown", (event) => {
      if (event.target.tagName === "SELECT" || (event.target === play && event.key === " ")) return;
      const moves = { ArrowLeft: () => go(index - 1), ArrowRight: () => go(index + 1), Home: () => go(0),
        End: () => go(episode.frames.length - 1) };
      if (event.key === " ") toggle();
      else if (moves[event.key]) { stop(); moves[event.key](); }
      else return;
      event.preventDefault();
    });
    new IntersectionObserver((seen) => { if (!seen[0].isIntersecting && timer !== null) stop(); }).observe(box);

    let drawnAt = 0;
    const place = find(".charts");
    const redraw = () => {
      const kind = place.clientWidth < 520 ? 1 : 2;
      if (kind === drawnAt) return;
      drawnAt = kind;
      moveCursor = charts(place, episode, seek);
      moveCursor(episode.frames[index][0]);
    };
    new ResizeObserver(redraw).observe(place);
    redraw();
    show();
    return start;
  }

  const starts = [...document.querySelectorAll(".card")].map(player);
  if (!stillness && starts.length) starts[0]();
})();
