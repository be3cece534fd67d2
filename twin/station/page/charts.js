// The charts: lines differ by dash and marker as well as by colour.
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const LOOK = {
  passive: { color: "--passive", dash: "dashdot", name: "without control" },
  use: { color: "--use", dash: "solid", symbol: "circle", name: "in use" },
  new: { color: "--new", dash: "dash", symbol: "diamond", name: "proposed" },
  limit: { color: "--limit", dash: "dot", name: "physical limit" },
};
const OPTIONS = { displayModeBar: false, responsive: true };

function line(kind, x, y) {
  const look = LOOK[kind];
  const trace = { x, y, name: look.name, mode: look.symbol ? "lines+markers" : "lines", line: { color: css(look.color), dash: look.dash, width: 2.5 } };
  if (look.symbol) trace.marker = { symbol: look.symbol, size: 8 };
  return trace;
}

function layout(x, y, log) {
  const axis = { gridcolor: "#2c3e4f", zeroline: false, linecolor: "#5a748c", automargin: true };
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: css("--text"), size: 13 }, showlegend: false,
    margin: { l: 58, r: 12, t: 8, b: 40 }, hovermode: "x unified", hoverlabel: { bgcolor: "#0b121a" },
    xaxis: { ...axis, title: { text: x, standoff: 4 } },
    yaxis: { ...axis, title: { text: y, standoff: 4 }, ...(log ? { type: "log", dtick: 1 } : { rangemode: "tozero" }) },
  };
}

const um = (v) => (v === null || v === undefined ? null : Math.max(1e6 * v, 0.01));
let now = null;

// Axes keep still while a line moves: they change in steps, and only where the lines leave them or fill little of them.
const drawn = { motion: null, power: null, damping: "" };
function decades(values, shown) {
  const logs = values.filter((v) => v > 0).map(Math.log10);
  if (!logs.length) return shown ?? [-2, 3];
  const low = Math.floor(2 * Math.min(...logs)) / 2, high = Math.ceil(2 * Math.max(...logs) + 0.2) / 2;
  return shown && shown[0] <= low && shown[1] >= high && shown[1] - shown[0] <= high - low + 1 ? shown : [low - 0.1, high];
}
function upward(values, shown) {
  const high = 1.04 * Math.max(...values.filter((v) => v > 0), 1e-6);
  if (shown && shown[1] >= high && shown[1] <= 5 * high) return shown;
  const decade = 10 ** Math.floor(Math.log10(high));
  return [0, decade * [1, 2, 5, 10].find((step) => step * decade >= high)];
}

// Plotly lays a chart out anew only where its axes change; else it moves the lines, which takes a twentieth of the time.
function draw(name, traces, axes, y) {
  const before = drawn[name], y0 = before?.range, flat = traces.flatMap((t) => t.y);
  const range = y === "log" ? decades(flat, y0) : upward(flat, y0);
  const form = JSON.stringify([range, traces.map((t) => [t.name, t.marker?.size]), traces[0].x]);
  if (before?.form === form) {
    const data = traces.map((t) => (t.marker ? { x: t.x, y: t.y, marker: t.marker } : { x: t.x, y: t.y }));
    const at_once = { transition: { duration: 0 }, frame: { duration: 0, redraw: false }, mode: "immediate" };
    Plotly.animate(`chart-${name}`, { data, traces: traces.map((_, k) => k) }, at_once).catch(() => {}); // a newer one came
    return;
  }
  drawn[name] = { form, range };
  axes.yaxis = { ...axes.yaxis, range: [...range], autorange: false };
  Plotly.react(`chart-${name}`, traces, { ...axes, uirevision: form, datarevision: performance.now() }, OPTIONS);
}

export function drawCurves(c) {
  const f = c.points.map((p) => p.frequency_hz);
  const of = (which, key) => c.points.map((p) => p[which]?.[key] ?? null);
  const open = c.points.map((p) => (p.provisional ? "diamond-open" : "diamond"));
  const proposed = (y) => {
    const trace = line("new", f, y);
    return { ...trace, marker: { ...trace.marker, symbol: open } };
  };
  const motion = [
    line("passive", f, c.points.map((p) => um(p.passive_m))),
    line("limit", f, c.points.map((p) => um(p.limit_m))),
    line("use", f, of("in_use", "displacement_m").map(um)),
    proposed(of("proposed", "displacement_m").map(um)),
  ];
  const power = [line("use", f, of("in_use", "power_w")), proposed(of("proposed", "power_w"))];
  power.push({ x: [f[0], f.at(-1)], y: [c.budget_w, c.budget_w], mode: "lines", name: "budget", line: { color: "#fff", width: 1, dash: "longdash" } });
  const cross = { mode: "markers", name: "measured now", marker: { symbol: "cross-thin", size: 14, line: { width: 2.5, color: "#fff" } } };
  motion.push({ x: [now?.f ?? null], y: [um(now?.x)], ...cross });
  power.push({ x: [now?.f ?? null], y: [now?.p ?? null], ...cross });
  draw("motion", motion, layout("excitation [Hz]", "table motion |x1|, peak [µm]", true), "log");
  draw("power", power, layout("excitation [Hz]", "coil power [W]"), "linear");
}

export function drawDamping(c) {
  const f = c.points.map((p) => p.frequency_hz), form = JSON.stringify([c.learned, f, c.points.map((p) => p.damping_ns_m)]);
  if (form === drawn.damping) return;
  drawn.damping = form;
  const damping = [];
  if (c.learned) {
    const l = c.learned, up = l.damping_ns_m.map((v, k) => v + l.std_ns_m[k]), down = l.damping_ns_m.map((v, k) => v - l.std_ns_m[k]);
    damping.push({ x: [...l.frequency_hz, ...l.frequency_hz.toReversed()], y: [...up, ...down.toReversed()], fill: "toself", mode: "lines", line: { width: 0 }, fillcolor: "rgba(108,184,240,.22)", name: "one sigma", hoverinfo: "skip" });
    damping.push({ ...line("use", l.frequency_hz, l.in_use_ns_m), mode: "lines", name: "in use" });
  }
  damping.push({ ...line("new", f, c.points.map((p) => p.damping_ns_m)), name: "in this what-if" });
  Plotly.react("chart-damping", damping, layout("excitation [Hz]", "c2 [Ns/m]"), OPTIONS);
}

export function showNow(state) {
  const p = state.performance;
  now = p && p.displacement_m !== null ? { f: state.excitation_hz, x: p.displacement_m, p: p.power_w } : null;
}

export function drawBranch(b, measured, passive) {
  const t = b.traces[0].displacement_m.map((_, k) => 1e3 * b.step_s * (k + 1));
  const kinds = { passive: "passive", "in use": "use", proposed: "new" };
  const traces = b.traces.filter((r) => passive || r.name !== "passive").map((r) => ({ ...line(kinds[r.name], t, r.displacement_m.map((v) => 1e6 * v)), mode: "lines" }));
  const used = b.traces.find((r) => r.name === "in use");
  if (used) {
    const up = used.displacement_m.map((v, k) => 1e6 * (v + used.displacement_std_m[k])), down = used.displacement_m.map((v, k) => 1e6 * (v - used.displacement_std_m[k]));
    traces.unshift({ x: [...t, ...t.toReversed()], y: [...up, ...down.toReversed()], fill: "toself", mode: "lines", line: { width: 0 }, fillcolor: "rgba(108,184,240,.22)", name: "one sigma", hoverinfo: "skip" });
  }
  if (measured.length) traces.push({ x: t.slice(0, measured.length), y: measured.map((v) => 1e6 * v), name: "measured", mode: "lines", line: { color: "#fff", width: 1.2 } });
  const l = layout("time from the instant [ms]", "table displacement [µm]");
  l.yaxis.rangemode = "normal";
  Plotly.react("chart-branch", traces, { ...l, showlegend: true, legend: { orientation: "h", y: 1.15 } }, OPTIONS);
}
