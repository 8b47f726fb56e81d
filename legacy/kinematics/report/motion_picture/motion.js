"use strict";
(function () {
  const box = document.getElementById("motion"), D = JSON.parse(document.getElementById("motion-data").textContent);
  const find = (name) => box.querySelector("[data-part=" + name + "]");
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const q = D.q.map((run) => run.map((text) => new Float32Array(bytes(text))));
  const mesh = D.mesh && { at: new Int16Array(bytes(D.mesh.vertices)), face: new Uint16Array(bytes(D.mesh.faces)) };
  const rest = mesh ? Float32Array.from(mesh.at, (value, k) => D.mesh.low[k % 3] + value * D.mesh.step) : new Float32Array(0);
  const S = { run: D.start.run, line: D.start.line, phase: 0, relative: -1, size: 1, playing: false };
  const light = [-0.40, 0.49, 0.77];

  function coordinates(run, line, body) {
    const own = q[run][body].subarray(12 * line, 12 * line + 12);
    if (S.relative < 0) return own;
    const other = q[run][S.relative].subarray(12 * line, 12 * line + 12);
    return own.map((value, k) => value - other[k]);
  }
  // displacement in m of a point in mm: real parts first, then imaginary parts
  function moved(c, x, y, z) {
    const out = [];
    for (const o of [0, 6]) out.push(
      c[o] + (c[o + 4] * z - c[o + 5] * y) * 1e-3, c[o + 1] + (c[o + 5] * x - c[o + 3] * z) * 1e-3,
      c[o + 2] + (c[o + 3] * y - c[o + 4] * x) * 1e-3);
    return out;
  }
  const length = (d) => Math.hypot(d[0], d[1], d[2], d[3], d[4], d[5]);
  function largest(run, line, body) {
    const c = coordinates(run, line, body);
    return D.bodies[body].outermost.reduce((most, p) => Math.max(most, length(moved(c, p[0], p[1], p[2]))), 0);
  }
  const nice = (value) => { const p = Math.pow(10, Math.floor(Math.log10(value)) - 1); return Math.round(value / p) * p; };
  function words(value, unit) {
    if (unit !== "m") return value.toPrecision(3) + " " + unit;
    const steps = [[1e-3, "mm"], [1e-6, "µm"], [1e-9, "nm"], [1e-12, "pm"]];
    const [scale, name] = steps.find((s) => value >= s[0]) || steps[3];
    return (value / scale).toPrecision(3) + " " + name;
  }

  let now = null;
  function settle() {
    const sizes = D.bodies.map((_, body) => largest(S.run, S.line, body));
    const most = Math.max(...sizes, 1e-300);
    const factor = nice(S.size * D.share * D.span * 1e-3 / most);
    now = { factor, sizes, bodies: D.bodies.map((body, k) => {
      const c = coordinates(S.run, S.line, k);
      return body.points.map((p) => moved(c, p[0], p[1], p[2]));
    }), mesh: null, outline: null };
    if (D.own >= 0) {
      const c = coordinates(S.run, S.line, D.own);
      now.mesh = new Float32Array(2 * rest.length);
      for (let k = 0; k < rest.length; k += 3)
        now.mesh.set(moved(c, rest[k], rest[k + 1], rest[k + 2]), 2 * k);
      now.outline = D.outline.map((p) => moved(c, p[0], p[1], p[2]));
    }
    tell();
  }
  const shifted = (p, d, cos, sin) => [0, 1, 2].map((k) => p[k] + now.factor * 1e3 * (d[k] * cos - d[k + 3] * sin));

  function paint(canvas, view) {
    const ratio = window.devicePixelRatio || 1, wide = view.size[0], high = view.size[1];
    canvas.width = wide * ratio; canvas.height = high * ratio;
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio); g.lineJoin = "round";
    const flat = (p) => [
      wide / 2 + view.scale * (dot(view.right, p) - view.middle[0]), high / 2 - view.scale * (dot(view.up, p) - view.middle[1]),
      dot(view.eye, p)];
    const phases = calm && S.playing ? [0, 45, 90, 135, 180, 225, 270, 315].map((k) => k + S.phase) : [S.phase];
    if (mesh) surface(g, flat, 1, 0, rest, null, "ghost");
    if (mesh && now.mesh) for (const phase of phases) surface(g, flat, Math.cos(phase * Math.PI / 180),
      Math.sin(phase * Math.PI / 180), rest, now.mesh, phases.length > 1 ? "outline" : "shaded", view);
    const cos = Math.cos(S.phase * Math.PI / 180), sin = Math.sin(S.phase * Math.PI / 180);
    if (now.outline && now.outline.length) {
      g.beginPath();
      D.outline.forEach((p, k) => { const at = flat(shifted(p, now.outline[k], cos, sin)); k ? g.lineTo(at[0], at[1]) : g.moveTo(at[0], at[1]); });
      g.closePath(); g.strokeStyle = "#1d2733"; g.lineWidth = 1; g.setLineDash([4, 3]); g.stroke(); g.setLineDash([]);
    }
    D.bodies.forEach((body, k) => net(g, flat, body, now.bodies[k], cos, sin, k === D.own && mesh));
    axes(g, flat, view);
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  function surface(g, flat, cos, sin, at, by, kind, view) {
    const count = at.length / 3, pts = new Array(count), f = now.factor * 1e3;
    for (let k = 0; k < count; k++) {
      const p = [at[3 * k], at[3 * k + 1], at[3 * k + 2]];
      if (by) for (let j = 0; j < 3; j++) p[j] += f * (by[6 * k + j] * cos - by[6 * k + 3 + j] * sin);
      pts[k] = flat(p);
    }
    const face = mesh.face, list = [];
    for (let k = 0; k < face.length; k += 3) {
      const a = pts[face[k]], b = pts[face[k + 1]], c = pts[face[k + 2]];
      const n = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
      if (n < 0) list.push([a[2] + b[2] + c[2], a, b, c, k / 3]);
    }
    const tones = kind === "shaded" ? colours(view) : null;
    if (kind === "shaded") list.sort((one, two) => one[0] - two[0]);
    g.lineWidth = 0.7;
    for (const t of list) {
      const [, a, b, c] = t;
      g.beginPath(); g.moveTo(a[0], a[1]); g.lineTo(b[0], b[1]); g.lineTo(c[0], c[1]); g.closePath();
      if (kind === "shaded") g.fillStyle = tones[t[4]]; else g.fillStyle = kind === "ghost" ? "#e9ecf0" : "rgba(11,110,153,0.04)";
      g.fill();
      if (kind === "shaded") { g.strokeStyle = g.fillStyle; g.stroke(); }
    }
  }
  // the small turns of the motion do not change the light: one colour per triangle and view
  const normals = mesh && smooth();
  function smooth() {
    const sum = new Float32Array(rest.length), face = mesh.face;
    for (let k = 0; k < face.length; k += 3) {
      const [a, b, c] = [0, 1, 2].map((j) => rest.subarray(3 * face[k + j], 3 * face[k + j] + 3));
      const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (let j = 0; j < 3; j++) for (let i = 0; i < 3; i++) sum[3 * face[k + j] + i] += n[i];
    }
    return sum;
  }
  function colours(view) {
    if (view.tones) return view.tones;
    const tone = (p) => {
      const n = normals.subarray(3 * p, 3 * p + 3), m = [dot(view.right, n), dot(view.up, n), dot(view.eye, n)];
      const l = Math.hypot(m[0], m[1], m[2]) || 1;
      return 0.34 + 0.46 * Math.max(0, dot(m, light) / l) + 0.2 * Math.max(0, m[2] / l);
    };
    view.tones = [];
    for (let k = 0; k < mesh.face.length; k += 3) {
      const mean = (tone(mesh.face[k]) + tone(mesh.face[k + 1]) + tone(mesh.face[k + 2])) / 3;
      view.tones.push("rgb(" + [251, 241, 216].map((x) => Math.min(255, Math.round(x * mean))).join() + ")");
    }
    return view.tones;
  }
  function net(g, flat, body, by, cos, sin, covered) {
    const at = body.points.map((p, k) => flat(shifted(p, by[k], cos, sin)));
    g.strokeStyle = body.colour; g.fillStyle = body.colour;
    if (!covered) {
      g.lineWidth = 1; g.globalAlpha = 0.45; g.beginPath();
      for (const [a, b] of body.edges) { g.moveTo(at[a][0], at[a][1]); g.lineTo(at[b][0], at[b][1]); }
      g.stroke(); g.globalAlpha = 1;
    }
    g.lineWidth = 1;
    body.points.forEach((p, k) => {
      g.beginPath();
      for (let step = 0; step <= 24; step++) {
        const turn = step * Math.PI / 12, e = flat(shifted(p, by[k], Math.cos(turn), Math.sin(turn)));
        step ? g.lineTo(e[0], e[1]) : g.moveTo(e[0], e[1]);
      }
      g.globalAlpha = 0.55; g.stroke(); g.globalAlpha = 1;
      g.beginPath(); g.arc(at[k][0], at[k][1], body.points.length > 60 ? 1.6 : 3, 0, 7); g.fill();
    });
  }
  function axes(g, flat, view) {
    g.font = "13px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
    const o = flat([0, 0, 0]);
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((unit, k) => {
      if (Math.abs(dot(view.eye, unit)) > 0.5) return;
      const tip = flat(unit.map((x) => x * 0.2 * D.span)), dx = tip[0] - o[0], dy = tip[1] - o[1], l = Math.hypot(dx, dy);
      g.strokeStyle = g.fillStyle = "#1d2733"; g.lineWidth = 1.5; g.beginPath(); g.moveTo(o[0], o[1]); g.lineTo(tip[0], tip[1]); g.stroke();
      g.beginPath(); g.moveTo(tip[0], tip[1]);
      for (const side of [-1, 1]) g.lineTo(tip[0] - 8 * dx / l + side * 3.4 * dy / l, tip[1] - 8 * dy / l - side * 3.4 * dx / l);
      g.fill();
      g.lineWidth = 3; g.strokeStyle = "#fff"; g.strokeText("xyz"[k], o[0] + dx * 1.22, o[1] + dy * 1.22);
      g.fillText("xyz"[k], o[0] + dx * 1.22, o[1] + dy * 1.22);
    });
  }

  const curves = {};
  function spectrum() {
    const canvas = find("spectrum"), wide = canvas.clientWidth || 1000, high = 92, ratio = window.devicePixelRatio || 1;
    canvas.width = wide * ratio; canvas.height = high * ratio;
    const g = canvas.getContext("2d"), key = S.run + "/" + S.relative;
    g.scale(ratio, ratio);
    curves[key] = curves[key] || D.bodies.map((_, body) => D.freq.map((_, line) => largest(S.run, line, body)));
    const all = curves[key].flat().filter((v) => v > 0);
    const top = Math.log10(Math.max(...all, 1e-300)), low = Math.max(Math.log10(Math.min(...all, 1)), top - 4);
    const x = (line) => 6 + (wide - 12) * along(line), y = (v) => 74 - 66 * (Math.log10(Math.max(v, 1e-300)) - low) / Math.max(top - low, 0.1);
    g.font = "12px system-ui, sans-serif"; g.fillStyle = "#1d2733"; g.textBaseline = "alphabetic";
    g.textAlign = "left"; g.fillText(hz(0), 6, 89); g.textAlign = "right"; g.fillText(hz(D.freq.length - 1), wide - 6, 89);
    curves[key].forEach((curve, body) => {
      if (body === S.relative) return;
      g.strokeStyle = D.bodies[body].colour; g.lineWidth = 1.4; g.beginPath();
      curve.forEach((v, line) => { const p = Math.min(y(v), 76); line ? g.lineTo(x(line), p) : g.moveTo(x(line), p); });
      g.stroke();
    });
    g.strokeStyle = "#c81e3a"; g.lineWidth = 1.6; g.beginPath(); g.moveTo(x(S.line), 2); g.lineTo(x(S.line), 77); g.stroke();
    g.fillStyle = "#c81e3a"; const end = Math.min(Math.max(x(S.line), 120), wide - 120);
    g.textAlign = "center"; g.fillText(hz(S.line), end, 89);
  }
  function along(line) {
    const f = D.log ? Math.log : (v) => v, last = D.freq.length - 1;
    return last ? (f(D.freq[line]) - f(D.freq[0])) / (f(D.freq[last]) - f(D.freq[0])) : 0.5;
  }
  const hz = (line) => Number(D.freq[line].toPrecision(6)) + " Hz";
  function nearest(f) { return D.freq.reduce((best, v, k) => Math.abs(v - f) < Math.abs(D.freq[best] - f) ? k : best, 0); }

  function tell() {
    const slider = find("line");
    slider.value = S.line; slider.setAttribute("aria-valuetext", hz(S.line)); find("hz").textContent = hz(S.line);
    find("size").setAttribute("aria-valuetext", "drawn " + S.size.toFixed(2) + " times the usual size");
    const per = D.unit === "m" ? "" : " per unit of " + D.reference;
    const parts = D.bodies.map((body, k) => k === S.relative ? "" : body.name + " " + words(now.sizes[k], D.unit)).filter((t) => t);
    find("said").textContent = hz(S.line) + (D.runs.length > 1 ? ", run " + D.runs[S.run] : "") +
      (S.relative < 0 ? "" : ", relative to " + D.bodies[S.relative].name) + ". Largest motion (peak" + per + "): " + parts.join(", ") +
      ". Drawn " + (D.unit === "m" ? now.factor.toLocaleString("en") + " times larger than life." :
        "as for " + D.reference + " = " + driven() + ".");
    find("factor").textContent = D.unit === "m" ? "× " + now.factor.toLocaleString("en") : D.reference + " = " + driven();
  }
  function driven() { return D.unit === "m/m" ? words(now.factor, "m") : now.factor.toPrecision(2) + " rad"; }
  function phase() {
    const p = Math.round(S.phase) % 360;
    find("phase").value = p; find("phase").setAttribute("aria-valuetext", p + " degrees"); find("degrees").textContent = p + "°";
  }
  const canvases = Array.from(box.querySelectorAll("canvas[data-view]"));
  function draw() { canvases.forEach((canvas, k) => paint(canvas, D.views[k])); phase(); }
  function update() { settle(); spectrum(); draw(); }

  let before = null;
  function tick(time) {
    if (!S.playing || calm) { before = null; return; }
    if (before !== null) S.phase = (S.phase + (time - before) * 0.18) % 360;
    before = time; draw(); window.requestAnimationFrame(tick);
  }
  const play = find("play");
  function name() { play.textContent = calm ? (S.playing ? "Show one phase" : "Show eight phases") : (S.playing ? "Pause" : "Play"); }
  play.addEventListener("click", () => { S.playing = !S.playing; name(); if (calm) draw(); else window.requestAnimationFrame(tick); });
  find("line").addEventListener("input", (e) => { S.line = Number(e.target.value); update(); });
  find("phase").addEventListener("input", (e) => { S.phase = Number(e.target.value); if (!calm) { S.playing = false; name(); } draw(); });
  find("size").addEventListener("input", (e) => { S.size = Math.pow(2, Number(e.target.value)); update(); });
  if (find("run")) find("run").addEventListener("change", (e) => { S.run = Number(e.target.value); update(); });
  if (find("relative")) find("relative").addEventListener("change", (e) => { S.relative = Number(e.target.value); update(); });
  find("spectrum").addEventListener("click", (e) => {
    const at = (e.offsetX - 6) / (e.target.clientWidth - 12);
    S.line = D.freq.reduce((best, _, k) => Math.abs(along(k) - at) < Math.abs(along(best) - at) ? k : best, 0); update();
  });
  window.addEventListener("resize", () => { spectrum(); draw(); });
  // page.html#motion;f=1750;phase=90;run=2;relative=base;size=2
  for (const part of decodeURIComponent(window.location.hash).split(";").slice(1)) {
    const [key, value] = part.split("=");
    if (key === "f") S.line = nearest(Number(value));
    if (key === "phase") S.phase = Number(value);
    if (key === "size") { S.size = Number(value); find("size").value = Math.log2(S.size); }
    if (key === "run") { S.run = Math.max(0, D.runs.indexOf(value)); if (find("run")) find("run").value = S.run; }
    if (key === "relative" && find("relative")) { S.relative = D.bodies.findIndex((b) => b.name === value); find("relative").value = S.relative; }
  }
  box.hidden = false; name(); update();
})();
