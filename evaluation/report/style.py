"""How a report's page looks and the little that moves on it: everything is in the page, nothing is fetched."""

STYLE = """
:root { color-scheme: light dark; --paper: #f7f6f3; --card: #fff; --ink: #22242a; --soft: #666a73; --line: #ddd9d1;
  --accent: #c2570c; --good: #17703b; --bad: #b3261e;
  --c0: #0b66b0; --c1: #c2570c; --c2: #17805a; --c3: #a43ba0; --c4: #8a6d00; --c5: #b3261e;
  --c6: #4b5bd6; --c7: #54606e; }
@media (prefers-color-scheme: dark) { :root { --paper: #16181c; --card: #1e2126; --ink: #e8e6e1; --soft: #a0a4ad;
  --line: #363a42; --accent: #f0913f; --good: #5cc98a; --bad: #ff8a80;
  --c0: #5fb0f2; --c1: #f0913f; --c2: #4fc79a; --c3: #de8adb; --c4: #d9bd4a; --c5: #ff8a80;
  --c6: #98a4ff; --c7: #a9b4c0; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 40px 24px 72px; }
h1 { font-size: 34px; line-height: 1.15; margin: 0 0 6px; letter-spacing: -.02em; overflow-wrap: anywhere; }
h2 { font-size: 22px; margin: 48px 0 8px; } h3 { font-size: 16px; margin: 26px 0 8px; overflow-wrap: anywhere; }
p { max-width: 76ch; margin: 8px 0; } .soft, small, figcaption, .key { color: var(--soft); font-size: 14px; }
code { background: var(--line); padding: 1px 5px; border-radius: 4px; overflow-wrap: anywhere; }
.note { border-left: 3px solid var(--accent); padding: 2px 0 2px 12px; }
.scroll { overflow-x: auto; margin: 10px 0; background: var(--card); border: 1px solid var(--line);
  border-radius: 8px; }
.tall { max-height: 70vh; overflow-y: auto; } .tall thead th { position: sticky; top: 0; background: var(--card); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 15px; }
th, td { text-align: right; padding: 7px 9px; border-bottom: 1px solid var(--line); white-space: nowrap; }
tbody tr:last-child > * { border-bottom: 0; }
thead th { color: var(--soft); font-weight: 600; font-size: 14px; vertical-align: bottom; white-space: normal; }
tbody th { font-weight: 500; }
th:first-child { text-align: left; position: sticky; left: 0; background: var(--card); }
td small { display: block; font-size: 12px; }
.names td:nth-child(2), .names th:nth-child(2), .verdicts td:nth-child(5) { text-align: left; }
.verdict.better { color: var(--good); font-weight: 600; } .verdict.worse { color: var(--bad); font-weight: 600; }
.verdict.no { color: var(--soft); }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 7px; }
.key span { margin-right: 18px; white-space: nowrap; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 460px), 1fr)); gap: 20px; }
.charts > div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 12px 14px 6px; }
.charts h3 { margin: 0 0 6px; }
.chart { display: block; width: 100%; height: auto; }
.chart text { fill: var(--soft); font: 13px system-ui, sans-serif; }
.chart .grid { stroke: var(--line); } .chart polyline { fill: none; stroke-width: 2; stroke-linejoin: round; }
.chart .dashed { stroke-dasharray: 5 4; }
.s0 { --c: var(--c0); } .s1 { --c: var(--c1); } .s2 { --c: var(--c2); } .s3 { --c: var(--c3); }
.s4 { --c: var(--c4); } .s5 { --c: var(--c5); } .s6 { --c: var(--c6); } .s7 { --c: var(--c7); }
.swatch { background: var(--c); } .swatch.dashed { background: none; border: 2px dashed var(--c); }
polyline { stroke: var(--c); } circle { fill: var(--c); }
figure { margin: 0; } img { display: block; width: 100%; height: auto; } .coarse img { image-rendering: pixelated; }
.view { margin: 28px 0 44px; }
.wipe { position: relative; border: 1px solid var(--line); border-radius: 8px; overflow: hidden; max-width: 940px; }
.wipe .top { position: absolute; inset: 0; clip-path: inset(0 calc(100% - var(--at, 50%)) 0 0); }
.wipe .bar { position: absolute; top: 0; bottom: 0; left: var(--at, 50%); width: 3px; margin-left: -1.5px;
  background: #fff; box-shadow: 0 0 0 1px #0007; pointer-events: none; }
.wipe .bar::after { content: "\\2194"; position: absolute; top: 50%; left: 50%; width: 30px; height: 30px;
  margin: -15px; border-radius: 50%; background: #fff; color: #222; box-shadow: 0 0 0 1px #0007;
  text-align: center; line-height: 29px; }
.wipe input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize;
  touch-action: pan-y; }
.wipe input:focus-visible ~ .bar { outline: 3px solid var(--accent); }
.wipe em { position: absolute; top: 10px; max-width: 45%; overflow: hidden; text-overflow: ellipsis;
  white-space: nowrap; font-style: normal; font-size: 13px; color: #222; background: #fffd;
  padding: 1px 9px; border-radius: 9px; pointer-events: none; }
.wipe em.left { left: 10px; } .wipe em.right { right: 10px; }
.choose { margin: 8px 0; font-size: 14px; color: var(--soft); } .choose select { font: inherit; color: var(--ink);
  background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: 3px 6px; margin-right: 12px; }
.thumbs { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(46%, 205px), 1fr)); gap: 12px;
  margin-top: 12px; }
.thumbs img { border-radius: 6px; } .thumbs b { color: var(--ink); font-weight: 600; }
figcaption { font-size: 13px; padding-top: 3px; overflow-wrap: anywhere; }
details > summary { cursor: pointer; margin: 12px 0; color: var(--accent); }
@media (max-width: 640px) { main { padding: 24px 14px 48px; } h1 { font-size: 27px; }
  .chart text { font-size: 18px; } thead th { font-size: 13px; }
  th:first-child { min-width: 33vw; max-width: 38vw; white-space: normal; overflow-wrap: anywhere; }
  .thumbs figure:first-child { grid-column: 1 / -1; } }
@media print { .scroll { overflow: visible; } .choose, .wipe input { display: none; } }
"""

SCRIPT = """
for (const view of document.querySelectorAll(".view")) {
  const wipe = view.querySelector(".wipe"), range = wipe.querySelector("input");
  range.addEventListener("input", () => wipe.style.setProperty("--at", range.value + "%"));
  const figures = [...view.querySelectorAll("figure[data-label]")], choose = view.querySelector(".choose");
  const pictures = {left: wipe.querySelector(".top img"), right: wipe.querySelector(":scope > img")};
  if (figures.length < 3) continue;
  for (const side of ["left", "right"]) {
    const label = wipe.querySelector("em." + side), select = document.createElement("select");
    select.setAttribute("aria-label", side + " picture");
    for (const figure of figures) {
      const option = document.createElement("option");
      option.textContent = figure.dataset.label;
      option.selected = figure.dataset.label === label.textContent;
      select.append(option);
    }
    select.addEventListener("change", () => {
      const chosen = figures[select.selectedIndex];
      pictures[side].src = chosen.querySelector("img").src;
      label.textContent = chosen.dataset.label;
    });
    choose.append(side + " ", select);
  }
  choose.hidden = false;
}
"""
