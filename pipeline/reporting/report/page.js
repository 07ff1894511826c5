"use strict";
// Draws the panels, and again in the unit and the sense of phase that the reader chooses.
(() => {
  const panels = JSON.parse(document.getElementById("panels").textContent);
  const amplitude = document.getElementById("amplitude");
  const phase = document.getElementById("phase");
  const units = { pp: ["µm pk-pk", 1, "µm", 1], zp: ["µm 0-pk", 0.5, "µm", 1], mil: ["mil pk-pk", 1 / 25.4, "mil", 1 / 25.4] };
  const options = { displaylogo: false, responsive: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
  const times = (values, factor) => values.map((v) => (v === null ? null : v * factor));
  const rename = (axis, unit) => {
    if (!axis || !axis.title) return;
    axis.title.text = axis.title.text.replace("µm pk-pk", unit).replace("(µm)", `(${units[amplitude.value][2]})`);
    if (phase.value === "lead") axis.title.text = axis.title.text.replace("phase lag", "phase lead");
  };

  function draw(panel) {
    const [unit, factor, , place_factor] = units[amplitude.value];
    const sign = phase.value === "lead" ? -1 : 1;
    const traces = panel.traces.map((trace) => {
      const shown = { ...trace };
      if (trace.meta === "y") shown.y = times(trace.y, factor);
      if (trace.meta === "xy") Object.assign(shown, { x: times(trace.x, place_factor), y: times(trace.y, place_factor) });
      if (trace.meta === "r") Object.assign(shown, { r: times(trace.r, factor), theta: times(trace.theta, sign) });
      if (trace.meta === "lag") shown.y = times(trace.y, sign);
      return shown;
    });
    const layout = structuredClone(panel.layout);
    const place = document.getElementById(panel.id);
    layout.height = panel.height * (document.body.classList.contains("paper") ? 0.8 : 1);
    place.style.height = `${layout.height}px`;
    layout.width = place.clientWidth;
    for (const name of Object.keys(layout)) if (/^[xy]axis/.test(name)) rename(layout[name], unit);
    if (traces.length && traces[0].meta === "xy") {
      for (const axis of [layout.xaxis, layout.yaxis]) axis.range = times(axis.range, place_factor);
    }
    if (layout.polar && sign < 0) layout.polar.angularaxis.direction = "counterclockwise";
    layout.title.text = layout.title.text.replace("µm pk-pk", unit);
    return Plotly.react(place, traces, layout, options);
  }

  function write(cell) {
    const factor = units[amplitude.value][1];
    const value = factor * cell.dataset.value;
    if (cell.dataset.deviation === undefined) {
      cell.textContent = Number(value.toPrecision(4)).toString();
      return;
    }
    const deviation = factor * cell.dataset.deviation;
    const digits = deviation > 0 ? Math.min(Math.max(1 - Math.floor(Math.log10(deviation)), 0), 8) : 4;
    cell.textContent = `${value.toFixed(digits)} ± ${deviation.toFixed(digits)}`;
  }

  async function show() {
    document.querySelectorAll("td.amplitude").forEach(write);
    document.querySelectorAll("th, caption, figcaption").forEach((one) => {
      one.dataset.text ??= one.textContent;
      one.textContent = one.dataset.text.replace("µm pk-pk", units[amplitude.value][0]);
    });
    for (const panel of panels) await draw(panel);
    document.body.dataset.drawn = panels.length;
  }

  // On paper a page is narrower than on a screen: A4 and Letter have room for this.
  const turn = (on) => () => { document.body.classList.toggle("paper", on); panels.forEach(draw); };
  addEventListener("beforeprint", turn(true));
  addEventListener("afterprint", turn(false));
  addEventListener("resize", show);
  amplitude.addEventListener("change", show);
  phase.addEventListener("change", show);
  show();
})();
