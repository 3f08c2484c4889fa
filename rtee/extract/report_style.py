"""The style of the report's page."""

from typing import Final

STYLE: Final = """
:root { --ink: #1b1f24; --soft: #5b6570; --line: #e2e6ea; --card: #ffffff; --page: #f5f6f8;
  --accent: #0072b2; --warn: #b34700; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink); line-height: 1.45;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 30px; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 21px; margin: 44px 0 4px; letter-spacing: -0.01em; }
h3 { font-size: 16px; margin: 0; }
p { margin: 4px 0 12px; max-width: 75ch; }
.soft { color: var(--soft); }
.panel, .card { background: var(--card); border: 1px solid var(--line); border-radius: 12px; }
.panel { padding: 18px 20px; margin-top: 14px; overflow-x: auto; }
.hero { display: grid; grid-template-columns: minmax(280px, 480px) 1fr; gap: 26px;
  align-items: center; margin-top: 16px; }
.hero img { width: 100%; height: auto; display: block; }
.tiles { display: flex; flex-wrap: wrap; gap: 10px 30px; margin: 14px 0 18px; }
.tile b { display: block; font-size: 26px; font-weight: 600; }
.tile span { color: var(--soft); }
.legend { list-style: none; padding: 0; margin: 0; display: flex; flex-wrap: wrap; gap: 6px 18px; }
.dot { display: inline-block; width: 12px; height: 12px; border-radius: 50%; margin-right: 7px;
  vertical-align: -1px; border: 1px solid rgba(0, 0, 0, 0.18); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; color: var(--soft); font-size: 13px; }
th, td { padding: 5px 14px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
tr:last-child > td { border-bottom: 0; }
td.number, th.number { text-align: right; white-space: nowrap; }
code, .name { white-space: nowrap; }
.tried th, .tried td { padding-right: 9px; }
.tried td:first-child { overflow-wrap: anywhere; min-width: 11em; }
.card code { white-space: normal; }
code { font: 13px/1.4 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(330px, 1fr)); gap: 16px;
  margin-top: 14px; }
.card { overflow: hidden; display: flex; flex-direction: column; break-inside: avoid; }
.card.wide { grid-column: 1 / -1; }
.card.pair { grid-column: span 2; }
.shots { position: relative; background: #fff; }
.shots > img { width: 100%; height: auto; display: block; }
.shots .close { position: absolute; width: 37%; border-radius: 10px;
  border: 1px solid var(--line); box-shadow: 0 2px 10px rgba(0, 0, 0, 0.12); }
.close.top { top: 10px; }
.close.bottom { bottom: 10px; }
.close.left { left: 10px; }
.close.right { right: 10px; }
.steps { display: grid; grid-template-columns: repeat(auto-fit, minmax(220px, 1fr)); }
.steps figure { margin: 0; }
.steps img { width: 100%; height: auto; display: block; }
.steps figcaption { padding: 0 16px 10px; font-size: 13px; color: var(--soft); }
.body { padding: 12px 16px 14px; border-top: 1px solid var(--line); flex: 1; }
.body table { margin-top: 8px; font-size: 13px; }
.body td, .body th { padding: 3px 10px 3px 0; }
.bar { position: relative; width: 110px; height: 8px; border-radius: 4px; background: #e8ebee;
  margin-top: 6px; }
.bar i { position: absolute; top: 0; bottom: 0; border-radius: 4px; background: var(--accent); }
.bar u { position: absolute; top: -3px; bottom: -3px; width: 2px; background: var(--ink); }
.tag { display: inline-block; padding: 1px 9px; border-radius: 20px; font-size: 12.5px;
  background: #eef1f4; color: var(--ink); margin: 6px 4px 0 0; }
details.tag { display: block; border-radius: 12px; margin: 6px 0 0; }
details.tag summary { color: var(--warn); }
details.tag ul { margin: 4px 0; padding-left: 18px; }
.contents { list-style: none; padding: 14px 0 0; margin: 20px 0 0; max-width: 400px;
  border-top: 1px solid var(--line); }
.contents li { display: flex; justify-content: space-between; padding: 2px 0; }
.contents a { color: var(--accent); text-decoration: none; }
.contents a:hover { text-decoration: underline; }
.count { color: var(--soft); font-variant-numeric: tabular-nums; }
.tag.warn { background: #fdeee3; color: var(--warn); }
details { margin-top: 14px; }
summary { cursor: pointer; color: var(--soft); }
footer { margin-top: 50px; color: var(--soft); font-size: 13px; }
@media (max-width: 760px) { .hero { grid-template-columns: 1fr; }
  .card.pair { grid-column: 1 / -1; } }
@media print { body { background: #fff; } main { max-width: none; } }
"""
