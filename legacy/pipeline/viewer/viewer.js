"use strict";
// Started when the page is whole: points, beams and measured motion are data of a later section.
document.addEventListener("DOMContentLoaded", function () {
  const box = document.getElementById("viewer"), D = JSON.parse(document.getElementById("viewer-data").textContent);
  const part = (name) => box.querySelector("[data-part=" + name + "]"), shows = (name) => box.querySelector("[data-show=" + name + "]").checked;
  const canvas = box.querySelector("canvas"), labels = box.querySelector(".labels"), say = box.querySelector(".say");
  const gl = canvas.getContext("webgl", { antialias: true, alpha: false, preserveDrawingBuffer: true });
  if (!gl) { box.querySelector(".none").hidden = false; canvas.hidden = true; return; }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const holder = document.getElementById("motion-data"), M = holder ? JSON.parse(holder.textContent) : null;
  const q = M ? M.q.map((run) => run.map((text) => new Float32Array(bytes(text)))) : [];
  const COLOUR = { x: [0.78, 0.18, 0.1], y: [0.1, 0.5, 0.28], z: [0.12, 0.3, 0.78], principal: [0.5, 0.1, 0.55], beam: [0.85, 0.15, 0.25],
    outline: [0.1, 0.15, 0.2], stapes: [0.9, 0.79, 0.58], plate: [0.62, 0.74, 0.82] };

  // --- programs: positions move rigidly with the real part of a shape times e^(i phase)
  const vertex = `attribute vec3 at; attribute vec3 normal; uniform mat4 view, lens; uniform vec3 go, turn; varying vec3 n;
    void main() { n = mat3(view) * normal; gl_Position = lens * view * vec4(at + go + cross(turn, at), 1.0); gl_PointSize = 8.0; }`;
  const fragment = `precision mediump float; varying vec3 n; uniform vec4 colour; uniform float lit;
    void main() { vec3 m = normalize(n); float f = 0.35 + 0.65 * abs(dot(m, normalize(vec3(-0.35, 0.45, 0.82))));
      gl_FragColor = vec4(colour.rgb * mix(1.0, f, lit), colour.a); }`;
  const program = gl.createProgram();
  [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, text]) => {
    const made = gl.createShader(kind); gl.shaderSource(made, text); gl.compileShader(made); gl.attachShader(program, made);
  });
  gl.linkProgram(program); gl.useProgram(program);
  const at = gl.getAttribLocation(program, "at"), normal = gl.getAttribLocation(program, "normal");
  const place = (name) => gl.getUniformLocation(program, name);
  const U = { view: place("view"), lens: place("lens"), go: place("go"), turn: place("turn"), colour: place("colour"), lit: place("lit") };
  function buffer(kind, data) { const made = gl.createBuffer(); gl.bindBuffer(kind, made); gl.bufferData(kind, data, gl.STATIC_DRAW); return made; }

  const meshes = D.meshes.map((mesh) => {
    const packed = new Int16Array(bytes(mesh.vertices)), faces = new Uint16Array(bytes(mesh.faces));
    const points = Float32Array.from(packed, (value, k) => mesh.low[k % 3] + value * mesh.step), normals = new Float32Array(points.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]], u = [], v = [];
      for (let k = 0; k < 3; k++) { u.push(points[b + k] - points[a + k]); v.push(points[c + k] - points[a + k]); }
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      [a, b, c].forEach((corner) => n.forEach((value, k) => { normals[corner + k] += value; }));
    }
    return { name: mesh.name, points: buffer(gl.ARRAY_BUFFER, points), normals: buffer(gl.ARRAY_BUFFER, normals),
      faces: buffer(gl.ELEMENT_ARRAY_BUFFER, faces), count: faces.length, list: points };
  });
  const strokes = D.lines.map((line) => ({ kind: line.kind, colour: COLOUR[line.colour], body: "", data: buffer(gl.ARRAY_BUFFER, new Float32Array([...line.from, ...line.to])), count: 2, mode: gl.LINES }));
  if (D.outline.length) strokes.push({ kind: "principal", colour: COLOUR.outline, body: "stapes", data: buffer(gl.ARRAY_BUFFER, new Float32Array(D.outline.flat())), count: D.outline.length, mode: gl.LINE_LOOP });
  const pointsLabel = box.querySelector('[data-show="points"]').parentElement;
  (M ? M.bodies : []).forEach((body, number) => {
    const colour = [1, 3, 5].map((k) => parseInt(body.colour.slice(k, k + 2), 16) / 255);
    strokes.push({ kind: "points", colour, body: number, data: buffer(gl.ARRAY_BUFFER, new Float32Array(body.points.flat())), count: body.points.length, mode: gl.POINTS });
    const mark = pointsLabel.appendChild(document.createElement("span")); mark.textContent = " ■"; mark.style.color = body.colour;
    pointsLabel.append(` ${body.name}`);
    const rays = (body.beams || []).flatMap(([point, x, y, z]) => { const p = body.points[point]; return [...p, p[0] + 2.2 * x, p[1] + 2.2 * y, p[2] + 2.2 * z]; });
    if (rays.length) strokes.push({ kind: "beams", colour: COLOUR.beam, body: number, data: buffer(gl.ARRAY_BUFFER, new Float32Array(rays)), count: rays.length / 3, mode: gl.LINES });
  });
  const stapes = meshes.find((mesh) => mesh.name === "stapes") || meshes[0];
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  (stapes ? stapes.list : []).forEach((value, k) => { low[k % 3] = Math.min(low[k % 3], value); high[k % 3] = Math.max(high[k % 3], value); });
  const middle = low.map((value, k) => (stapes ? (value + high[k]) / 2 - (k === 1 ? 0.12 * (high[k] - value) : 0) : 0)), reach = stapes ? Math.hypot(...high.map((value, k) => value - low[k])) / 2 : 2;

  // --- state
  const S = { turn: [0.35, 0.25], zoom: 1, phase: 0, playing: false, motion: "rest", line: 0 };
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (M) { part("motion").querySelector("[value=measured]").hidden = false; part("line").max = M.freq.length - 1; S.line = M.start.line; part("line").value = S.line; }
  else ["points", "beams"].forEach((name) => { box.querySelector("[data-show=" + name + "]").parentElement.hidden = true; });

  function shape(body) {
    // 12 numbers: real and imaginary parts of x y z (mm) and of the rotations (rad), scaled to be seen
    if (S.motion === "rest") return null;
    const factor = 0.16 * reach * parseFloat(part("size").value);
    let own;
    if (S.motion === "measured") {
      const run = M.start.run, read = (b) => Array.from(q[run][b].subarray(12 * S.line, 12 * S.line + 12));
      const all = M.bodies.map((_, b) => read(b));
      const most = Math.max(...all.map(size), 1e-30), number = body === "stapes" ? M.own : body;
      if (number < 0 || number === "") return null;
      own = all[number].map((value, k) => (k % 6 < 3 ? value * 1e3 : value) * factor / most);
    } else {
      if (!(body === "stapes" || (M && body === M.own))) return null;
      const mode = D.modes[+S.motion].shape, most = size(mode);
      own = mode.map((value, k) => (k % 6 < 3 ? value * 1e3 : value) * factor / most);
    }
    const cos = Math.cos(S.phase), sin = Math.sin(S.phase);
    return [0, 1, 2, 3, 4, 5].map((k) => own[k] * cos - own[k + 6] * sin);
  }
  // largest displacement on the stapes, mm, of a motion in m and rad
  const size = (c) => Math.max(...[0, 6].map((o) => Math.hypot(c[o], c[o + 1], c[o + 2]) * 1e3 + reach * Math.hypot(c[o + 3], c[o + 4], c[o + 5])));

  function matrices() {
    const [a, b] = S.turn, ca = Math.cos(a), sa = Math.sin(a), cb = Math.cos(b), sb = Math.sin(b);
    const r = [ca, 0, sa, sa * sb, cb, -ca * sb, -sa * cb, sb, ca * cb];  // rows: right, up, towards the eye
    const view = [r[0], r[3], r[6], 0, r[1], r[4], r[7], 0, r[2], r[5], r[8], 0, 0, 0, 0, 1];
    for (let k = 0; k < 3; k++) view[12 + k] = -(r[3 * k] * middle[0] + r[3 * k + 1] * middle[1] + r[3 * k + 2] * middle[2]);
    const aspect = canvas.width / canvas.height, s = S.zoom / (1.3 * reach), deep = 1 / (12 * reach);
    const [sx, sy] = aspect > 1 ? [s / aspect, s] : [s, s * aspect];
    return { view, lens: [sx, 0, 0, 0, 0, sy, 0, 0, 0, 0, -deep, 0, 0, 0, 0, 1] };
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, wide = Math.round(canvas.clientWidth * ratio), tall = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== wide || canvas.height !== tall) { canvas.width = wide; canvas.height = tall; }
    gl.viewport(0, 0, wide, tall); gl.clearColor(0.969, 0.976, 0.984, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    const now = matrices();
    gl.uniformMatrix4fv(U.view, false, now.view); gl.uniformMatrix4fv(U.lens, false, now.lens);
    const put = (body) => { const c = shape(body) || [0, 0, 0, 0, 0, 0]; gl.uniform3f(U.go, c[0], c[1], c[2]); gl.uniform3f(U.turn, c[3], c[4], c[5]); };
    gl.enableVertexAttribArray(at);
    const solid = (mesh, alpha) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.points); gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
      gl.enableVertexAttribArray(normal); gl.bindBuffer(gl.ARRAY_BUFFER, mesh.normals); gl.vertexAttribPointer(normal, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces); gl.uniform4f(U.colour, ...COLOUR[mesh.name], alpha); gl.uniform1f(U.lit, 1);
      put(mesh.name === "stapes" ? "stapes" : ""); gl.depthMask(alpha === 1); gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0); gl.depthMask(true);
    };
    const opaque = shows("solid");
    if (opaque) meshes.filter((mesh) => mesh.name === "stapes").forEach((mesh) => solid(mesh, 1));
    gl.disableVertexAttribArray(normal); gl.vertexAttrib3f(normal, 0, 0, 1); gl.uniform1f(U.lit, 0);
    strokes.forEach((stroke) => {
      const shown = stroke.kind === "plate" ? shows("plate") && shows("axes") : shows(stroke.kind);
      if (!shown) return;
      // axes lie in front of the bone, or they would be hidden in it
      if (stroke.kind === "axes" || stroke.kind === "principal") gl.disable(gl.DEPTH_TEST); else gl.enable(gl.DEPTH_TEST);
      gl.bindBuffer(gl.ARRAY_BUFFER, stroke.data); gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
      gl.uniform4f(U.colour, ...stroke.colour, 1); put(stroke.body); gl.drawArrays(stroke.mode, 0, stroke.count);
    });
    gl.enable(gl.DEPTH_TEST);
    if (!opaque) meshes.filter((mesh) => mesh.name === "stapes").forEach((mesh) => solid(mesh, 0.35));
    if (shows("plate")) meshes.filter((mesh) => mesh.name === "plate").forEach((mesh) => solid(mesh, 0.45));
    name(now);
  }
  function name(now) {
    labels.replaceChildren();
    const side = { x: " anterior", y: " lateral", z: D.z_is ? " " + D.z_is : "" };
    D.lines.filter((line) => (line.kind === "axes" && shows("axes")) || (line.kind === "plate" && shows("plate") && shows("axes"))).forEach((line) => {
      const p = line.to, v = now.view, e = [0, 1, 2].map((k) => v[k] * p[0] + v[k + 4] * p[1] + v[k + 8] * p[2] + v[k + 12]);
      const made = document.createElement("span");
      made.textContent = line.name + (line.kind === "axes" ? side[line.name] : "");
      made.style.left = 50 * (1 + e[0] * now.lens[0]) + "%"; made.style.top = 50 * (1 - e[1] * now.lens[5]) + "%";
      labels.append(made);
    });
  }
  function tell() {
    part("at").hidden = S.motion !== "measured";
    if (M) part("at").querySelector("output").textContent = M.freq[S.line].toFixed(0) + " Hz";
    say.textContent = S.motion === "rest" ? "Drag to turn; click, then wheel to zoom; keys: arrows, plus, minus, space to play."
      : (S.motion === "measured" ? "Measured motion at " + M.freq[S.line].toFixed(1) + " Hz" : "Fitted mode shape, " + D.modes[+S.motion].hz.toFixed(0) + " Hz (damped)") + ", phase " + (Math.round(S.phase * 180 / Math.PI) % 360 + 360) % 360 + "°, enlarged.";
  }
  const refresh = () => { tell(); draw(); };
  let last = 0;
  function step(time) {
    if (!S.playing) return;
    S.phase += Math.max(0, Math.min(0.1, (time - last) / 1000)) * 2 * Math.PI * (calm ? 0.15 : 0.6); last = time;
    refresh(); requestAnimationFrame(step);
  }
  function play(on) {
    if (on && S.motion === "rest") { S.motion = D.modes.length ? "0" : M ? "measured" : "rest"; part("motion").value = S.motion; }
    S.playing = on && S.motion !== "rest"; part("play").textContent = S.playing ? "stop" : "play";
    if (S.playing) { last = performance.now(); requestAnimationFrame(step); }
    refresh();
  }
  let held = null;
  canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    S.turn[0] += (event.clientX - held[0]) * 0.008; S.turn[1] += (event.clientY - held[1]) * 0.008; held = [event.clientX, event.clientY]; draw();
  });
  ["pointerup", "pointercancel"].forEach((kind) => canvas.addEventListener(kind, () => { held = null; }));
  canvas.addEventListener("wheel", (event) => { if (!event.ctrlKey && document.activeElement !== canvas) return; event.preventDefault(); S.zoom *= Math.exp(-0.001 * event.deltaY); draw(); }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = { ArrowLeft: () => { S.turn[0] -= 0.1; }, ArrowRight: () => { S.turn[0] += 0.1; }, ArrowUp: () => { S.turn[1] -= 0.1; }, ArrowDown: () => { S.turn[1] += 0.1; },
      "+": () => { S.zoom *= 1.1; }, "=": () => { S.zoom *= 1.1; }, "-": () => { S.zoom /= 1.1; }, " ": () => play(!S.playing) };
    if (keys[event.key]) { event.preventDefault(); keys[event.key](); draw(); }
  });
  part("motion").addEventListener("change", (event) => { S.motion = event.target.value; play(S.motion !== "rest" && !calm); });
  part("line").addEventListener("input", (event) => { S.line = +event.target.value; refresh(); });
  part("size").addEventListener("input", refresh);
  part("play").addEventListener("click", () => play(!S.playing));
  part("home").addEventListener("click", () => { S.turn = [0, 0]; S.zoom = 1; draw(); });
  part("top").addEventListener("click", () => { S.turn = [0, Math.PI / 2]; S.zoom = 1; draw(); });
  box.querySelectorAll("[data-show]").forEach((input) => input.addEventListener("change", draw));
  new ResizeObserver(draw).observe(canvas);
  refresh();
});
