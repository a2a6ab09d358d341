"""The look of a report, light and dark, and the few lines of script that show values of curves."""

STYLE = """
:root { color-scheme: light dark; --text: #1c1e21; --soft: #5a6068; --page: #f5f6f8; --card: #fff;
  --line: #dcdfe4; --c0: #1f6fd6; --c1: #d9660a; --c2: #2a8a4a; --c3: #a83fb8; --c4: #b4232c;
  --c5: #5f6b7a; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e8eb; --soft: #a0a6ae; --page: #121417;
  --card: #1b1e22; --line: #363b42; --c0: #6aaeff; --c1: #ffa04d; --c2: #63cf8b; --c3: #dd8cea;
  --c4: #ff7b80; --c5: #a9b4c2; } }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; max-width: 66rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; color: var(--text); background: var(--page); }
h1 { font-size: 1.6rem; margin: .5rem 0 1rem; } h2 { font-size: 1.1rem; margin: 0 0 .6rem; }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; margin-bottom: 1rem; font-size: .9rem; }
nav a { color: var(--c0); text-decoration: none; } nav a:hover { text-decoration: underline; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: 1rem 1.2rem; margin: 0 0 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .3rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid var(--line); text-align: right; }
th { color: var(--soft); font-weight: 600; } tbody tr:last-child td { border-bottom: 0; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
img { max-width: 100%; height: auto; display: block; margin: .5rem 0; border-radius: 6px; }
p.note { color: var(--soft); font-size: .88rem; }
.figures { display: flex; flex-wrap: wrap; gap: .8rem; }
.figures div { flex: 1 1 8rem; border-left: 3px solid var(--c0); padding: .1rem .8rem; }
.figures b { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: .85rem; }
figure { margin: .6rem 0 1rem; position: relative; } figcaption { font-weight: 600; }
.legend { font-size: .85rem; color: var(--soft); } .legend i { display: inline-block; width: 1.1em;
  height: 3px; vertical-align: middle; margin: 0 .35em 0 .9em; }
.legend i:first-child { margin-left: 0; }
svg { width: 100%; height: auto; display: block; } svg text { fill: var(--soft); font-size: 11px; }
svg .grid { stroke: var(--line); } svg .plot { fill: none; stroke-width: 1.4;
  stroke-linejoin: round; } svg .cursor { stroke: var(--soft); visibility: hidden; }
.tip { position: absolute; display: none; pointer-events: none; background: var(--card);
  border: 1px solid var(--line); border-radius: 6px; padding: .2rem .6rem; font-size: .82rem;
  white-space: pre; }
"""

# Static pages stay readable: the script adds values under the pointer and nothing else.
SCRIPT = """
document.querySelectorAll("figure[data-curve]").forEach(function (figure) {
  var data = JSON.parse(figure.querySelector("script").textContent);
  var svg = figure.querySelector("svg"), cursor = svg.querySelector(".cursor");
  var tip = figure.querySelector(".tip"), box = data.box;
  function near(points, x) {
    var low = 0, high = points.length - 1;
    while (low < high) {
      var m = (low + high) >> 1;
      if (points[m][0] < x) low = m + 1; else high = m;
    }
    if (low > 0 && x - points[low - 1][0] < points[low][0] - x) low -= 1;
    return points[low];
  }
  svg.addEventListener("pointermove", function (event) {
    var area = svg.getBoundingClientRect();
    var at = (event.clientX - area.left) / area.width * box.width;
    var share = Math.min(1, Math.max(0, (at - box.left) / (box.right - box.left)));
    var x = share * data.last, lines = [], shown = null;
    data.lines.forEach(function (line) {
      if (!line.points.length) return;
      var point = near(line.points, x);
      if (shown === null) shown = point[0];
      lines.push(line.name + ": " + point[1] + (point[0] === shown ? "" : " (" + point[0] + ")"));
    });
    if (shown === null) return;
    var place = box.left + shown / Math.max(1, data.last) * (box.right - box.left);
    cursor.setAttribute("x1", place); cursor.setAttribute("x2", place);
    cursor.style.visibility = "visible";
    tip.textContent = data.label + " " + shown + "\\n" + lines.join("\\n");
    tip.style.display = "block";
    var left = place / box.width * area.width + 12;
    if (left + tip.offsetWidth > area.width) left -= tip.offsetWidth + 24;
    tip.style.left = left + "px";
    tip.style.top = (area.top - figure.getBoundingClientRect().top + 8) + "px";
  });
  svg.addEventListener("pointerleave", function () {
    tip.style.display = "none"; cursor.style.visibility = "hidden";
  });
});
"""
