"use strict";
// Every table as CSV and LaTeX, every figure as a file by a click; the place in the side navigation; scrolling by
// keyboard.
(function () {
  const all = (selector, within) => Array.from((within || document).querySelectorAll(selector));
  const name = (node) => {
    const section = node.closest("section"), heading = section && section.querySelector("h2");
    return (heading ? heading.textContent : document.title).trim().toLowerCase().replace(/[^a-z0-9]+/g, "_");
  };
  function save(address, file) {
    const link = document.createElement("a");
    link.href = address; link.download = file;
    document.body.append(link); link.click(); link.remove();
  }
  function button(words, title, act) {
    const made = document.createElement("button");
    made.type = "button"; made.className = "tool"; made.textContent = words; made.title = title;
    made.addEventListener("click", act);
    return made;
  }
  const words = (cell) => cell.innerText.trim().replace(/\s+/g, " ");
  // An apostrophe before what a spreadsheet would run as a formula (stapeskit/tables/text_cells.py has the same rule).
  const harmless = (text) => (/^[=+\-@]/.test(text) && !/^[+-]?[\d.]/.test(text) ? "'" : "") + text;
  const quoted = (cell) => '"' + harmless(words(cell)).replace(/"/g, '""') + '"';
  const SIGNS = { "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "±": "$\\pm$", "·": "$\\cdot$",
    "×": "$\\times$", "°": "$^\\circ$", "µ": "$\\mu$", "μ": "$\\mu$", "√": "$\\surd$", "φ": "$\\varphi$", "−": "$-$", "–": "--",
    "α": "$\\alpha$", "β": "$\\beta$", "γ": "$\\gamma$", "ω": "$\\omega$", "ζ": "$\\zeta$", "σ": "$\\sigma$", "χ": "$\\chi$" };
  const POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹⁻";
  const lowered = (power) => "$^{" + Array.from(power, (sign) => "0123456789-"[POWERS.indexOf(sign)]).join("") + "}$";
  const latex = (cell) => words(cell).replace(/[&%$#_{}\\~^±·×°µμ√−–αβγωζσχφ]/g, (sign) => SIGNS[sign] || "\\" + sign)
    .replace(/[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+/g, lowered);
  function tabular(table) {
    const rows = Array.from(table.rows), width = Math.max(...rows.map((row) => row.cells.length));
    const lines = rows.map((row, place) => Array.from(row.cells, latex).join(" & ") + " \\\\" + (place === 0 ? "\n\\midrule" : ""));
    return "% needs \\usepackage{booktabs}\n\\begin{tabular}{l" + "r".repeat(width - 1) + "}\n\\toprule\n" + lines.join("\n") + "\n\\bottomrule\n\\end{tabular}\n";
  }
  all(".scroll").forEach((box, place) => {
    const table = box.querySelector("table");
    if (!table || table.rows.length < 3) return;
    const file = name(box) + "_" + (place + 1);
    box.after(button("CSV", "save this table as CSV", () => {
      const text = Array.from(table.rows, (row) => Array.from(row.cells, quoted).join(",")).join("\r\n") + "\r\n";
      save("data:text/csv;charset=utf-8," + encodeURIComponent("\ufeff" + text), file + ".csv");
    }), button("LaTeX", "save this table for LaTeX", () => {
      save("data:text/x-tex;charset=utf-8," + encodeURIComponent(tabular(table)), file + ".tex");
    }));
  });
  all(".scroll").forEach((box) => {
    if (box.scrollWidth > box.clientWidth + 1) { box.tabIndex = 0; box.setAttribute("role", "group"); box.setAttribute("aria-label", "table, scrolls sideways"); }
  });
  all("figure").forEach((box) => {
    if (box.scrollWidth <= box.clientWidth + 1) return;
    box.classList.add("wide"); box.tabIndex = 0; box.setAttribute("aria-label", "figure, scrolls sideways");
  });
  all("figure > img").forEach((image, place) => {
    const kind = (/^data:image\/(\w+)/.exec(image.src) || [])[1];
    if (!kind) return;
    image.after(button(kind.toUpperCase(), "save this figure as " + kind.toUpperCase(), () => save(image.src, name(image) + "_" + (place + 1) + "." + kind)));
  });
  const links = all("nav.side a"), fold = document.querySelector("nav.side details");
  if (fold && window.matchMedia("(max-width: 1179px)").matches) fold.open = false;
  if (links.length && "IntersectionObserver" in window) {
    const seen = new Set();
    const watch = new IntersectionObserver((entries) => {
      entries.forEach((entry) => seen[entry.isIntersecting ? "add" : "delete"](entry.target.id));
      const first = links.find((link) => seen.has(link.hash.slice(1)));
      if (first) links.forEach((link) => link.classList.toggle("here", link === first));
    });
    all("section").forEach((section) => watch.observe(section));
  }
})();
