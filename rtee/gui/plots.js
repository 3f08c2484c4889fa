"use strict";
// Draws actions and the time of the pose into viser's plots, and reports the time of a click.
(() => {
  const SHADE = "2e", CLICK = 4; // opacity of an action (hex); longest motion of a click, beyond which it is a zoom [CSS px]
  const said = () => document.querySelector("[data-rtee-times]")?.dataset.rteeTimes ?? "{}";
  const drawTimes = (plot) => {
    plot.rteeSaid = said();
    const { pose = null, spans = [] } = JSON.parse(plot.rteeSaid);
    const { ctx, bbox: { left, top, width, height } } = plot;
    const inside = (x, w, draw) => {
      ctx.save();
      ctx.beginPath();
      ctx.rect(x, top, w, height);
      ctx.clip();
      draw();
      ctx.restore();
    };
    const at = (time) => plot.valToPos(time, "x", true);
    ctx.textAlign = "left"; // the plot leaves the alignment of its axes
    ctx.textBaseline = "alphabetic";
    ctx.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
    for (const [begin, end, name, colour] of spans) {
      const x = Math.max(at(begin), left), w = Math.min(at(end), left + width) - x;
      if (w <= 0) continue;
      inside(x, w, () => {
        ctx.fillStyle = colour + SHADE;
        ctx.fillRect(x, top, w, height);
        ctx.fillStyle = colour;
        ctx.fillRect(x, top, w, 2 * devicePixelRatio);
        ctx.fillStyle = getComputedStyle(plot.root).color;
        ctx.fillText(name, x + 3, top + height - 4 * devicePixelRatio);
      });
    }
    if (pose !== null)
      inside(left, width, () => {
        ctx.fillStyle = getComputedStyle(plot.root).color;
        ctx.fillRect(at(pose), top, 2 * devicePixelRatio, height);
      });
  };
  const prepare = (plot) => {
    (plot.hooks.drawAxes ??= []).push(drawTimes); // over the grid, which would hide letters
    let from = 0;
    plot.over.addEventListener("mousedown", (event) => (from = event.clientX));
    plot.over.addEventListener("click", (event) => {
      if (Math.abs(event.clientX - from) > CLICK || JSON.parse(said()).pose == null) return;
      const x = event.clientX - plot.over.getBoundingClientRect().left;
      const time = Math.max(plot.posToVal(x, "x"), 0).toFixed(3);
      dispatchEvent(new CustomEvent("rtee-say", { detail: `time ${time}` }));
    });
  };
  setInterval(() => {
    for (const { chart } of Object.values(window.__viserTestpoints?.uplots ?? {})) {
      if (chart.rteeSaid === said()) continue;
      if (chart.rteeSaid === undefined) prepare(chart);
      chart.rteeSaid = said();
      chart.redraw(false);
    }
  }, 100);
})();
