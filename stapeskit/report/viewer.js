"use strict";
// The three-dimensional view of every figure with data-scene: surfaces by WebGL, axes, labels and names of points on a
// second canvas above. Data: scene3d.py.
document.querySelectorAll("[data-scene]").forEach((box) => {
  const find = (selector) => box.querySelector(selector), all = (selector) => Array.from(box.querySelectorAll(selector));
  const scene = JSON.parse(find("script").textContent), solid = find(".solid"), over = find(".over"), hover = find(".hover");
  const pen = over.getContext("2d"), say = find("output"), line = find("[data-part=line]"), size = find("[data-part=size]");
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const start = { turn: [-0.45, 0.3], zoom: 1, shift: [0, 0] };
  const state = { ...structuredClone(start), motion: -1, line: 0, phase: 0, playing: false, near: -1 };
  const shown = (group) => { const tick = all("[data-group]").find((input) => input.dataset.group === group); return !tick || tick.checked; };

  // --- surfaces: unpacked, with the normals of their vertices
  const meshes = scene.meshes.map((mesh) => {
    const packed = new Int16Array(bytes(mesh.vertices)), faces = new Uint16Array(bytes(mesh.faces));
    const at = Float32Array.from(packed, (value, k) => mesh.low[k % 3] + value * mesh.step), normals = new Float32Array(at.length);
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const u = [0, 1, 2].map((k) => at[b + k] - at[a + k]), v = [0, 1, 2].map((k) => at[c + k] - at[a + k]), n = cross(u, v);
      for (const corner of [a, b, c]) for (let k = 0; k < 3; k++) normals[corner + k] += n[k];
    }
    return { ...mesh, at, normals, faces };
  });
  const motions = scene.motions.map((motion) => ({
    ...motion, bodies: Object.fromEntries(Object.entries(motion.bodies).map(([body, text]) => [body, new Float32Array(bytes(text))])),
  }));
  function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }

  // --- motion: the real part of amplitude times e^(i phase), enlarged so that it is seen
  const length = (c, o) => Math.hypot(c[o], c[o + 1], c[o + 2]) * 1e3 + scene.reach * Math.hypot(c[o + 3], c[o + 4], c[o + 5]);
  const amplitude = (body) => {
    const motion = motions[state.motion], all12 = motion && motion.bodies[body];
    return all12 ? all12.subarray(12 * state.line, 12 * state.line + 12) : null;
  };
  function enlarged() {
    const largest = Object.keys(motions[state.motion].bodies).map(amplitude).map((c) => Math.max(length(c, 0), length(c, 6)));
    return 0.13 * scene.reach * 2 ** parseFloat(size.querySelector("input").value) / Math.max(...largest, 1e-300);
  }
  function moved(body) {
    const c = state.motion < 0 ? null : amplitude(body);
    if (!c) return [0, 0, 0, 0, 0, 0];
    const factor = enlarged(), cos = Math.cos(state.phase), sin = Math.sin(state.phase);
    return [0, 1, 2, 3, 4, 5].map((k) => factor * (k < 3 ? 1e3 : 1) * (c[k] * cos - c[k + 6] * sin));
  }
  function place(p, m) { const turned = cross(m.slice(3), p); return [0, 1, 2].map((k) => p[k] + m[k] + turned[k]); }

  // --- camera: rows right, up, towards the eye; parallel projection
  let camera = null;
  function look() {
    const [a, b] = state.turn, ca = Math.cos(a), sa = Math.sin(a), cb = Math.cos(b), sb = Math.sin(b);
    const wide = over.clientWidth, high = over.clientHeight, scale = state.zoom * 0.56 * Math.min(wide, high * 1.25) / scene.reach;
    camera = { rows: [ca, 0, sa, sa * sb, cb, -ca * sb, -sa * cb, sb, ca * cb], wide, high, scale: Math.min(scale, state.zoom * 0.62 * high / scene.reach) };
  }
  function project(p) {
    const r = camera.rows, d = [0, 1, 2].map((k) => p[k] - scene.middle[k]);
    const eye = [0, 3, 6].map((k) => r[k] * d[0] + r[k + 1] * d[1] + r[k + 2] * d[2]);
    return [camera.wide / 2 + camera.scale * eye[0] + state.shift[0], camera.high / 2 - camera.scale * eye[1] + state.shift[1], eye[2]];
  }
  const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);

  // --- surfaces and points by WebGL
  const gl = solid.getContext("webgl", { antialias: true, alpha: false, preserveDrawingBuffer: true });
  if (!gl) { find(".none").textContent = "The three-dimensional view needs WebGL."; return; }
  const paint = byCard();
  function byCard() {
    const vertex = `attribute vec3 at, normal; uniform mat3 rows; uniform vec3 middle, go, turn; uniform vec4 lens; uniform vec2 dot; varying vec3 n;
      void main() { vec3 e = rows * (at + go + cross(turn, at) - middle); n = rows * normal;
        gl_Position = vec4(e.xy * lens.xy + lens.zw, -(e.z + dot.y) / ${(12 * scene.reach).toFixed(4)}, 1.0); gl_PointSize = dot.x; }`;
    const fragment = `precision mediump float; varying vec3 n; uniform vec4 colour; uniform float kind;
      void main() { if (kind > 0.5) { float r = length(gl_PointCoord - 0.5); if (r > 0.5) discard;
          gl_FragColor = vec4(r > 0.36 ? vec3(1.0) : colour.rgb, 1.0); return; }
        vec3 m = normalize(n); if (m.z < 0.0) m = -m;
        float f = 0.36 + 0.52 * max(0.0, dot(m, normalize(vec3(-0.4, 0.55, 0.73)))) + 0.2 * m.z;
        gl_FragColor = vec4(min(colour.rgb * f + 0.05 * pow(m.z, 24.0), 1.0), colour.a); }`;
    const program = gl.createProgram();
    [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].forEach(([kind, text]) => {
      const shader = gl.createShader(kind); gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
    });
    gl.linkProgram(program); gl.useProgram(program);
    const at = gl.getAttribLocation(program, "at"), normal = gl.getAttribLocation(program, "normal");
    const uniform = (name) => gl.getUniformLocation(program, name);
    const U = Object.fromEntries(["rows", "middle", "go", "turn", "lens", "dot", "colour", "kind"].map((name) => [name, uniform(name)]));
    const buffer = (kind, data) => { const made = gl.createBuffer(); gl.bindBuffer(kind, made); gl.bufferData(kind, data, gl.STATIC_DRAW); return made; };
    const stored = meshes.map((mesh) => ({
      ...mesh, at: buffer(gl.ARRAY_BUFFER, mesh.at), normals: buffer(gl.ARRAY_BUFFER, mesh.normals),
      index: buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.faces), count: mesh.faces.length,
    }));
    const dots = buffer(gl.ARRAY_BUFFER, new Float32Array(scene.points.flatMap((point) => point.at)));
    const put = (body) => { const m = moved(body); gl.uniform3f(U.go, m[0], m[1], m[2]); gl.uniform3f(U.turn, m[3], m[4], m[5]); };
    function surface(mesh, side) {
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.at); gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, mesh.normals); gl.enableVertexAttribArray(normal); gl.vertexAttribPointer(normal, 3, gl.FLOAT, false, 0, 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.index); gl.uniform4f(U.colour, ...rgb(mesh.colour), mesh.opacity);
      put(mesh.body); gl.depthMask(mesh.opacity === 1);
      if (side) { gl.enable(gl.CULL_FACE); gl.cullFace(side); }
      gl.drawElements(gl.TRIANGLES, mesh.count, gl.UNSIGNED_SHORT, 0); gl.disable(gl.CULL_FACE); gl.depthMask(true);
    }
    return (ratio) => {
      const { wide, high, scale } = camera, [x, y] = state.shift;
      gl.viewport(0, 0, solid.width, solid.height); gl.clearColor(0.969, 0.976, 0.984, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
      const r = camera.rows;
      gl.uniformMatrix3fv(U.rows, false, [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]]);
      gl.uniform3f(U.middle, ...scene.middle); gl.uniform4f(U.lens, 2 * scale / wide, 2 * scale / high, 2 * x / wide, -2 * y / high);
      gl.enableVertexAttribArray(at); gl.uniform1f(U.kind, 0); gl.uniform2f(U.dot, 1, 0);
      const visible = stored.filter((mesh) => shown(mesh.name));
      visible.filter((mesh) => mesh.opacity === 1).forEach((mesh) => surface(mesh, 0));
      gl.disableVertexAttribArray(normal); gl.uniform1f(U.kind, 1); gl.uniform2f(U.dot, 11 * ratio, 0.03 * scene.reach);
      if (shown("points")) scene.points.forEach((point, k) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, dots); gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
        gl.uniform4f(U.colour, ...rgb(point.colour), 1); put(point.body); gl.drawArrays(gl.POINTS, k, 1);
      });
      gl.uniform1f(U.kind, 0); gl.uniform2f(U.dot, 1, 0);
      visible.filter((mesh) => mesh.opacity < 1).forEach((mesh) => { surface(mesh, gl.FRONT); surface(mesh, gl.BACK); });
    };
  }

  // --- lines with arrows, labels, the point under the mouse
  function label(words, x, y, placed) {
    const wide = pen.measureText(words).width, at = Math.min(Math.max(x, 4), camera.wide - wide - 4);
    let down = Math.min(Math.max(y, 12), camera.high - 12);
    while (placed.some((other) => Math.abs(other[1] - down) < 16 && at < other[0] + other[2] + 4 && other[0] < at + wide + 4)) down += 4;
    placed.push([at, down, wide]);
    pen.lineWidth = 4; pen.strokeStyle = "rgba(255,255,255,.9)"; pen.strokeText(words, at, down);
    pen.fillStyle = "#1d2733"; pen.fillText(words, at, down);
  }
  function overlay(ratio) {
    pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, camera.wide, camera.high);
    pen.lineJoin = pen.lineCap = "round"; pen.font = "600 13px system-ui, sans-serif"; pen.textBaseline = "middle";
    const placed = [];
    scene.lines.filter((one) => shown(one.group)).forEach((one) => {
      const m = moved(one.body), at = one.at.map((p) => project(place(p, m))), [x, y] = at[at.length - 1], before = at[at.length - 2];
      pen.beginPath(); at.forEach((p, k) => (k ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
      pen.strokeStyle = one.colour; pen.lineWidth = one.width; pen.stroke();
      const dx = x - before[0], dy = y - before[1], long = Math.hypot(dx, dy) || 1;
      if (one.arrow && long > 8) {
        pen.beginPath(); pen.moveTo(x, y);
        for (const side of [-1, 1]) pen.lineTo(x - 9 * dx / long + side * 4 * dy / long, y - 9 * dy / long - side * 4 * dx / long);
        pen.fillStyle = one.colour; pen.fill();
      }
      if (one.label) label(one.label, x + 7 * dx / long + 3, y + 9 * dy / long, placed);
    });
    const near = scene.points[state.near];
    hover.hidden = !near || !shown("points");
    if (hover.hidden) return;
    const [x, y] = project(place(near.at, moved(near.body)));
    pen.beginPath(); pen.arc(x, y, 8, 0, 7); pen.strokeStyle = "#1d2733"; pen.lineWidth = 2; pen.stroke();
    hover.textContent = `${near.body} ${near.name}: ${near.verdict}`;
    hover.style.left = Math.min(x + 12, camera.wide - hover.offsetWidth - 6) + "px"; hover.style.top = Math.max(y - 30, 4) + "px";
  }
  function draw() {
    look();
    const ratio = window.devicePixelRatio || 1, wide = Math.round(camera.wide * ratio), high = Math.round(camera.high * ratio);
    if (!wide || !high) return;
    for (const canvas of [solid, over]) if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
    paint(ratio); overlay(ratio);
    const motion = motions[state.motion];
    if (!motion) { say.textContent = ""; return; }
    const times = motion.measured ? ` enlarged ${Number(enlarged().toPrecision(2)).toLocaleString("en")} times` : " enlarged";
    say.textContent = `${Number(motion.hz[state.line].toPrecision(5))} Hz, phase ${Math.round(state.phase * 180 / Math.PI) % 360}°,${times}`;
  }

  // --- playing
  let before = 0;
  function step(time) {
    if (!state.playing) return;
    state.phase += Math.min(0.1, Math.max(0, (time - before) / 1000)) * 2 * Math.PI * (calm ? 0.12 : 0.6); before = time;
    draw(); requestAnimationFrame(step);
  }
  function choose(number) {
    if (number === state.motion) state.playing = number >= 0 && !state.playing;
    else { state.motion = number; state.playing = number >= 0; state.phase = 0; state.line = number < 0 ? 0 : motions[number].start; }
    all("[data-motion]").forEach((button) => button.setAttribute("aria-pressed", String(+button.dataset.motion === number)));
    size.hidden = number < 0; line.hidden = number < 0 || motions[number].hz.length < 2;
    if (!line.hidden) { line.querySelector("input").max = motions[number].hz.length - 1; line.querySelector("input").value = state.line; }
    if (state.playing) { before = performance.now(); requestAnimationFrame(step); }
    draw();
  }

  // --- hands: one finger or the left button turns, right button or shift shifts, wheel and two fingers zoom
  const held = new Map(); let scrolled = 0;
  const zoom = (factor) => { state.zoom = Math.min(40, Math.max(0.2, state.zoom * factor)); };
  over.addEventListener("pointerdown", (event) => { held.set(event.pointerId, [event.clientX, event.clientY]); over.setPointerCapture(event.pointerId); });
  for (const kind of ["pointerup", "pointercancel"]) over.addEventListener(kind, (event) => held.delete(event.pointerId));
  over.addEventListener("contextmenu", (event) => event.preventDefault());
  over.addEventListener("pointermove", (event) => {
    const last = held.get(event.pointerId);
    if (!last) {
      const frame = over.getBoundingClientRect(), x = event.clientX - frame.left, y = event.clientY - frame.top;
      const far = scene.points.map((point) => { const p = project(place(point.at, moved(point.body))); return Math.hypot(p[0] - x, p[1] - y); });
      const least = Math.min(...far, 12), near = least < 12 ? far.indexOf(least) : -1;
      if (near !== state.near) { state.near = near; draw(); }
      return;
    }
    const dx = event.clientX - last[0], dy = event.clientY - last[1];
    if (held.size > 1) {
      const other = Array.from(held).find(([id]) => id !== event.pointerId)[1], span = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(span([event.clientX, event.clientY]) / (span(last) || 1)); state.shift[0] += dx / 2; state.shift[1] += dy / 2;
    } else if (event.buttons & 2 || event.shiftKey) { state.shift[0] += dx; state.shift[1] += dy; }
    else turn(0.008 * dx, 0.008 * dy);
    held.set(event.pointerId, [event.clientX, event.clientY]); draw();
  });
  over.addEventListener("pointerleave", () => { if (state.near >= 0) { state.near = -1; draw(); } });
  function turn(a, b) { state.turn = [state.turn[0] + a, Math.min(1.5708, Math.max(-1.5708, state.turn[1] + b))]; }
  // A page that is being scrolled goes on scrolling over the view.
  window.addEventListener("scroll", () => { scrolled = performance.now(); }, { passive: true });
  over.addEventListener("wheel", (event) => {
    if (performance.now() - scrolled < 250) return;
    event.preventDefault(); zoom(Math.exp(-0.0012 * event.deltaY * (event.deltaMode ? 30 : 1))); draw();
  }, { passive: false });
  const views = { reset: start, front: { ...start, turn: [0, 0] }, side: { ...start, turn: [-1.5708, 0] }, top: { ...start, turn: [0, 1.5708] } };
  const view = (name) => { Object.assign(state, structuredClone(views[name])); draw(); };
  over.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    const keys = { "+": () => zoom(1.1), "=": () => zoom(1.1), "-": () => zoom(1 / 1.1), 0: () => view("reset"), Home: () => view("reset"),
      " ": () => choose(state.motion < 0 && motions.length ? 0 : state.motion) };
    if (way && event.shiftKey) { state.shift[0] += 20 * way[0]; state.shift[1] += 20 * way[1]; }
    else if (way) turn(0.1 * way[0], 0.1 * way[1]);
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault(); draw();
  });
  all("[data-motion]").forEach((button) => button.addEventListener("click", () => choose(+button.dataset.motion)));
  all("[data-view]").forEach((button) => button.addEventListener("click", () => view(button.dataset.view)));
  all("[data-group]").forEach((input) => input.addEventListener("change", draw));
  line.querySelector("input").addEventListener("input", (event) => { state.line = +event.target.value; draw(); });
  size.addEventListener("input", draw);
  new Map(scene.points.map((point) => [point.verdict, point.colour])).forEach((colour, verdict) => {
    const mark = document.createElement("span"), dot = document.createElement("i");
    dot.style.background = colour; mark.append(dot, verdict); find(".legend").append(mark);
  });
  find(".none").hidden = true; find(".motions").hidden = !motions.length;
  new ResizeObserver(draw).observe(over);
  draw();
});
