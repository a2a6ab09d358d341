"""The look of a report, light and dark, and the few lines of script that show values of curves."""

STYLE = """
:root { color-scheme: light dark; --text: #1c1e21; --soft: #5a6068; --page: #f5f6f8; --card: #fff;
  --line: #dcdfe4; --c0: #1f6fd6; --c1: #d9660a; --c2: #2a8a4a; --c3: #a83fb8; --c4: #b4232c;
  --c5: #00838a; --muted: #a3a9b2; --good: #1c7a3a; --bad: #b4232c; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e8eb; --soft: #a0a6ae; --page: #121417;
  --card: #1b1e22; --line: #363b42; --c0: #6aaeff; --c1: #ffa04d; --c2: #63cf8b; --c3: #dd8cea;
  --c4: #ff7b80; --c5: #5fd0d6; --muted: #6b727c; --good: #63cf8b; --bad: #ff7b80; } }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; max-width: 76rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; color: var(--text); background: var(--page);
  overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin: .5rem 0 1rem; } h2 { font-size: 1.1rem; margin: 0 0 .6rem; }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; margin-bottom: 1rem; font-size: .9rem; }
nav a { color: var(--c0); text-decoration: none; } nav a:hover { text-decoration: underline; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: 1rem 1.2rem; margin: 0 0 1rem; }
p.lead { font-size: 1.15rem; line-height: 1.45; margin: .2rem 0 1rem; }
p.note { color: var(--soft); font-size: .88rem; }
table { border-collapse: collapse; margin: .3rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid var(--line); text-align: right; }
th { color: var(--soft); font-weight: 600; vertical-align: bottom; }
tbody tr:last-child td { border-bottom: 0; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
tr.muted td { color: var(--soft); }
table.wide { font-size: .8rem; width: 100%; } table.wide th, table.wide td { padding: .2rem .3rem; }
:is(table.narrow, table.wide) :is(th, td) { overflow-wrap: normal; }
table.narrow :is(th, td):first-child, table.wide td:first-child, td:last-child {
  overflow-wrap: anywhere; }
img { max-width: 100%; height: auto; display: block; margin: .5rem 0; border-radius: 6px; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(10.5rem, 1fr));
  gap: .8rem; }
.figures div { border-left: 3px solid var(--c0); padding: .1rem .8rem; }
.figures span { display: block; color: var(--soft); font-size: .85rem; line-height: 1.3; }
.figures b { font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.figures em { font-style: normal; font-size: .9rem; margin-left: .5rem; color: var(--soft); }
.figures em.better { color: var(--good); } .figures em.worse { color: var(--bad); }
.figures small { display: block; color: var(--soft); font-size: .8rem; line-height: 1.35; }
.figures span small { display: inline; }
figure { margin: .6rem 0 1rem; position: relative; } figcaption { font-weight: 600; }
.legend { font-size: .85rem; color: var(--soft); } .legend span { margin-right: 1.1em;
  display: inline-block; }
.legend svg { display: inline-block; width: 32px; height: 4px; vertical-align: middle;
  margin-right: .35em; }
svg { width: 100%; height: auto; display: block; } svg text { fill: var(--soft); font-size: 11px; }
svg.defs { width: 0; height: 0; position: absolute; }
svg .grid { stroke: var(--line); } svg .plot { fill: none; stroke-width: 1.5;
  stroke-linejoin: round; } svg .cursor { stroke: var(--soft); visibility: hidden; }
.tip { position: absolute; display: none; pointer-events: none; background: var(--card);
  border: 1px solid var(--line); border-radius: 6px; padding: .2rem .6rem; font-size: .82rem;
  white-space: pre; }
.frames { display: grid; grid-template-columns: repeat(var(--columns), minmax(0, 1fr));
  gap: 3px; align-items: end; }
.frames figure { margin: 0; } .frames img { margin: 0; width: 100%; border-radius: 3px; }
.frames figcaption { display: none; font-size: .78rem; font-weight: 400; color: var(--soft);
  line-height: 1.25; padding: .1rem 0; } .frames .first figcaption { display: block; }
.frames b { position: absolute; left: 4px; bottom: 3px; font-size: .75rem; line-height: 1.2;
  color: #fff; background: #0009; padding: 0 .3em; border-radius: 3px; }
.bars { display: flex; flex-wrap: wrap; gap: .4rem 2rem; margin: .6rem 0; font-size: .8rem;
  color: var(--soft); align-items: end; }
.bar { flex: 1 1 16rem; max-width: 30rem; } .bar i { display: block; height: 12px;
  border-radius: 3px; } .bar div { display: flex; justify-content: space-between; }
.none i { display: inline-block; width: 12px; height: 12px; margin-right: .4em; border-radius: 3px;
  background: #464646; vertical-align: -1px; }
.cloud canvas { display: none; width: 100%; height: 30rem; max-height: 80vh; border-radius: 6px;
  touch-action: none; cursor: grab; } .cloud .tools { display: none; flex-wrap: wrap; gap: .4rem;
  margin-bottom: .5rem; font-size: .9rem; } .cloud > p { display: none; margin: .3rem 0; }
.cloud.live canvas, .cloud.live > p { display: block; } .cloud.live .tools { display: flex; }
.cloud.live > img { display: none; }
.cloud button { font: inherit; color: inherit; background: none; border: 1px solid var(--line);
  border-radius: 6px; padding: .15rem .7rem; cursor: pointer; }
.cloud button[aria-pressed=true] { background: var(--c0); border-color: var(--c0); color: #fff; }
@media (max-width: 700px) {
  section { padding: .8rem .7rem; } body { padding: 1rem .6rem 3rem; }
  svg text { font-size: 19px; } svg .plot { stroke-width: 2.2; }
  .frames { grid-template-columns: repeat(var(--half), minmax(0, 1fr)); }
  .frames figcaption { display: block; font-size: .72rem; }
  table.narrow { font-size: .8rem; } table.narrow th, table.narrow td { padding: .2rem .3rem; }
  table.wide, table.wide tbody { display: block; } table.wide thead { display: none; }
  table.wide tr { display: grid; grid-template-columns: repeat(auto-fill, minmax(8.5rem, 1fr));
    gap: 0 1rem; border-bottom: 1px solid var(--line); padding: .4rem 0; }
  table.wide td { border: 0; padding: 0; display: flex; justify-content: space-between;
    gap: .5rem; overflow-wrap: anywhere; } table.wide td::before { content: attr(data-name);
    color: var(--soft); }
  table.wide td:first-child { grid-column: 1 / -1; font-weight: 600; }
  table.wide td:first-child::before { content: none; }
  .cloud canvas { height: 20rem; }
}
"""

# Static pages stay readable: the script adds values under the pointer and nothing else.
CURVES_SCRIPT = """
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
    var x = data.ends[0] + share * (data.ends[1] - data.ends[0]), lines = [], shown = null;
    data.lines.forEach(function (line) {
      if (!line.points.length) return;
      var point = near(line.points, x);
      if (shown === null) shown = point[0];
      lines.push(line.name + ": " + point[1] + (point[0] === shown ? "" : " (" + point[0] + ")"));
    });
    if (shown === null) return;
    var place = box.left + (shown - data.ends[0]) / (data.ends[1] - data.ends[0])
      * (box.right - box.left);
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
