"""The look of a report: one style sheet for light and dark, phone and desktop, screen and paper."""

from __future__ import annotations

CSS = """
:root {
  color-scheme: light dark;
  --sans: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
  --mono: ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", monospace;
  --ground: #ffffff; --raised: #f5f7f9; --ink: #1c2430; --muted: #586474; --line: #d5dbe3;
  --c1: #1d63c1; --c2: #c4540a; --c3: #2a7d4b; --c4: #7d8794; --c5: #8141b5;
  --warn: #8a5a00; --warn-ground: #fff6e0; --warn-line: #e3b34a;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ground: #13171d; --raised: #1b2129; --ink: #e4e8ee; --muted: #9ba7b6; --line: #333c48;
    --c1: #74adff; --c2: #ff9d5c; --c3: #62c48c; --c4: #8d98a7; --c5: #c79bf2;
    --warn: #f2c66d; --warn-ground: #2b2412; --warn-line: #7d6323;
  }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-behavior: smooth; }
@media (prefers-reduced-motion: reduce) { html { scroll-behavior: auto; } }
body { margin: 0; background: var(--ground); color: var(--ink); font: 16px/1.55 var(--sans); }
main { max-width: 76rem; margin: 0 auto; padding: 1.5rem clamp(1rem, 4vw, 2.5rem) 4rem; }
h1 { font-size: clamp(1.5rem, 4vw, 2.1rem); line-height: 1.2; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; line-height: 1.3; margin: 2.8rem 0 .6rem; padding-top: 1rem; border-top: 1px solid var(--line);
} h3 { font-size: 1.05rem; margin: 1.6rem 0 .4rem; }
p, ul { max-width: 46rem; margin: .5rem 0 .9rem; overflow-wrap: anywhere; }
.subtitle { color: var(--muted); margin: 0 0 1rem; }
a { color: var(--c1); }
.skip { position: absolute; left: -999px; }
.skip:focus { left: 1rem; top: 1rem; background: var(--ground); padding: .5rem 1rem; z-index: 9; }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; list-style: none; padding: 0; margin: .8rem 0; max-width:
none; } :focus-visible { outline: 3px solid var(--c1); outline-offset: 2px; }
.warnings { border: 1px solid var(--warn-line); border-left-width: 5px; border-radius: 4px;
  background: var(--warn-ground); padding: .7rem 1rem; margin: 1rem 0; max-width: 60rem; }
.warnings h2 { border: 0; margin: 0; padding: 0; font-size: 1rem; color: var(--warn); }
.warnings ul { margin: .3rem 0 0; padding-left: 1.2rem; max-width: none; }
.bad { border-left: 5px solid var(--warn-line); background: var(--raised); padding: .6rem 1rem;
  max-width: 60rem; }
.good { border-left: 5px solid var(--c3); background: var(--raised); padding: .6rem 1rem; max-width: 60rem; }
.scroll { overflow-x: auto; margin: .8rem 0 .3rem; max-width: 100%; }
table { border-collapse: collapse; font-size: .9rem; line-height: 1.4; }
th, td { padding: .32rem .7rem .32rem 0; text-align: left; vertical-align: baseline; border-bottom: 1px solid
var(--line); } th { font-weight: 600; color: var(--muted); white-space: nowrap; }
tbody th { color: var(--ink); font-weight: 500; }
th.n, td.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td { white-space: nowrap; }
td.t, table.facts td { white-space: normal; min-width: 12rem; }
table.wide { font-size: .84rem; }
table.wide th, table.wide td { padding-right: .55rem; }
table:not(.facts) tbody th { position: sticky; left: 0; background: var(--ground); }
.columns { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 28rem), 1fr)); gap: 0 2rem; }
.columns > * { min-width: 0; }
table.facts th { padding-right: 1.4rem; vertical-align: top; }
table.facts td { overflow-wrap: anywhere; }
.caption, figcaption { color: var(--muted); font-size: .88rem; max-width: 60rem; margin: .2rem 0 1.2rem; }
.tag { display: inline-block; font-size: .78rem; line-height: 1.4; padding: 0 .45rem; border-radius: 3px; white-space:
nowrap; color: var(--warn); background: var(--warn-ground); border: 1px solid var(--warn-line); }
.bar { display: inline-block; width: 2rem; height: .55rem; margin-left: .4rem; background: var(--line); }
.bar i { display: block; height: 100%; background: var(--c1); }
.span { display: inline-block; position: relative; width: 6rem; height: .8rem; }
.span i { position: absolute; }
.span .prior { top: 0; height: .8rem; background: var(--line); }
.span .estimate { top: .25rem; height: .3rem; background: var(--c1); }
code, pre { font-family: var(--mono); font-size: .86rem; }
pre { background: var(--raised); padding: .7rem 1rem; overflow-x: auto; border-radius: 4px; }
figure { margin: .8rem 0; }
.panels { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 20.5rem), 1fr)); gap: .6rem 1.4rem;
  align-items: start; }
figure svg { display: block; width: 100%; height: auto; }
figure svg text { font-family: var(--sans); }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
figure svg:focus:not(:focus-visible) { outline: none; }
figure svg[data-axes] { touch-action: pan-y; cursor: crosshair; -webkit-user-select: none; user-select: none; }
figure svg .own line { stroke: var(--line); stroke-width: .6; }
figure svg .own text { font-size: 8.5px; fill: var(--muted); }
figure svg .cursor { pointer-events: none; }
figure svg .cursor line { stroke: var(--muted); stroke-width: .8; }
figure svg .cursor text { font-size: 8px; paint-order: stroke; stroke: var(--ground); stroke-width: 3px; }
figure svg .mark { fill: var(--c1); opacity: .15; }
.said { position: absolute; left: -999px; width: 1px; height: 1px; overflow: hidden; }
.key { display: flex; flex-wrap: wrap; gap: .1rem 1.2rem; font-size: .88rem; margin: .2rem 0 .5rem; padding: 0;
list-style: none; max-width: none; }
.key span { display: inline-block; width: 1.6rem; margin-right: .45rem; vertical-align: .25em; border-top: 2.5px solid;
} .key .dash { border-top-style: dashed; }
.key .dots { border-top-style: dotted; }
details { border-top: 1px solid var(--line); padding: .2rem 0; }
summary { cursor: pointer; padding: .45rem 0; font-weight: 500; overflow-wrap: anywhere; }
footer { color: var(--muted); font-size: .85rem; margin-top: 3rem; }
@media print {
  :root { --ground: #fff; --raised: #fff; --ink: #000; --muted: #444; --line: #bbb; --c1: #1d63c1; --c2: #c4540a; --c3:
  #2a7d4b; --c4: #777; --c5: #8141b5; --warn: #5c3c00; --warn-ground: #fff; --warn-line: #777; }
  body { font-size: 10pt; }
  main { max-width: none; padding: 0; }
  nav, .skip, .hint, .cursor { display: none; }
  .scroll { overflow: visible; }
  figure svg, tr, .warnings { break-inside: avoid; }
  h2, h3, summary { break-after: avoid; }
  details::details-content { content-visibility: visible; display: block; }
}
"""
