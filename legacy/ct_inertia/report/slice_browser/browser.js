"use strict";
(async function () {
  const box = document.getElementById("slices"), D = JSON.parse(document.getElementById("slices-data").textContent);
  const part = (name) => box.querySelector("[data-part=" + name + "]"), canvas = box.querySelector("canvas"), say = box.querySelector(".say");
  if (!("DecompressionStream" in window)) { box.hidden = true; return; }
  const packed = Uint8Array.from(atob(D.voxels), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const voxels = new Uint8Array(await new Response(stream).arrayBuffer()), [nx, ny, nz] = D.size;
  const colour = D.colours.map((text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16)));
  const value = (x, y, z) => voxels[x + nx * (y + ny * z)];
  const place = D.middle.slice();
  part("axis").value = D.axis;
  const legend = box.querySelector(".legend"), present = new Set(voxels.map((v) => v & 7));
  legend.textContent = "";
  D.names.forEach((name, label) => {
    if (!name || !present.has(label)) return;
    const mark = document.createElement("i"); mark.style.background = D.colours[label];
    legend.append(mark, name);
  });
  const ways = () => { const axis = +part("axis").value; return [axis, ...[0, 1, 2].filter((k) => k !== axis)]; };
  function draw() {
    const [axis, right, down] = ways(), wide = D.size[right], tall = D.size[down], at = [0, 0, 0];
    part("slice").max = D.size[axis] - 1; part("slice").value = place[axis]; at[axis] = place[axis];
    const image = new ImageData(wide, tall), shown = part("labels").checked;
    const read = (u, v) => { at[right] = u; at[down] = v; return value(at[0], at[1], at[2]); };
    for (let v = 0; v < tall; v++) for (let u = 0; u < wide; u++) {
      const now = read(u, v), label = now & 7, grey = (now >> 3) * 255 / 31, o = 4 * (u + wide * v);
      // the outline of a label is drawn full, its inside as a tint
      let share = 0;
      if (shown && label) share = label === 4 || [[1, 0], [-1, 0], [0, 1], [0, -1]].some(([a, b]) =>
        u + a >= 0 && u + a < wide && v + b >= 0 && v + b < tall && (read(u + a, v + b) & 7) !== label) ? 0.9 : 0.16;
      for (let k = 0; k < 3; k++) image.data[o + k] = grey * (1 - share) + colour[label][k] * share;
      image.data[o + 3] = 255;
    }
    const small = document.createElement("canvas"); small.width = wide; small.height = tall; small.getContext("2d").putImageData(image, 0, 0);
    const across = wide * D.spacing_mm[right], along = tall * D.spacing_mm[down], scale = Math.min(900 / across, 620 / along);
    canvas.width = Math.round(across * scale); canvas.height = Math.round(along * scale);
    canvas.getContext("2d").drawImage(small, 0, 0, canvas.width, canvas.height);
    part("where").textContent = "scan slice " + "xyz"[axis] + " = " + (D.first_index[axis] + D.step * place[axis]);
  }
  function go(steps) { const axis = +part("axis").value; place[axis] = Math.max(0, Math.min(D.size[axis] - 1, place[axis] + steps)); draw(); }
  part("slice").addEventListener("input", (event) => { place[+part("axis").value] = +event.target.value; draw(); });
  ["axis", "labels"].forEach((name) => part(name).addEventListener("change", draw));
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: 5, PageDown: -5 }[event.key];
    if (step) { event.preventDefault(); go(step); }
  });
  canvas.addEventListener("click", (event) => {
    const [axis, right, down] = ways(), frame = canvas.getBoundingClientRect(), at = place.slice();
    at[right] = Math.min(D.size[right] - 1, Math.floor((event.clientX - frame.left) / frame.width * D.size[right]));
    at[down] = Math.min(D.size[down] - 1, Math.floor((event.clientY - frame.top) / frame.height * D.size[down]));
    const mm = [0, 1, 2].map((k) => (D.first_mm[k] + at.reduce((sum, index, a) => sum + index * D.step_mm[a][k], 0)).toFixed(3));
    const label = value(at[0], at[1], at[2]) & 7;
    say.textContent = "Scan coordinates " + mm.join(", ") + " mm: " + (D.names[label] || "no label") + ". As a seed: --seed " + mm.join(",");
  });
  draw();
})();
