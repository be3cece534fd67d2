// The status line, the alarms and the log.
import { micro, number, put } from "/page/page.js";

function chip(id, text, level, title = "") {
  const box = document.getElementById(id);
  const value = box.querySelector("dd");
  if (value.textContent !== text) value.textContent = text;
  box.className = level;
  box.title = title;
}

export function showStatus(s) {
  if (s.sample === undefined) return;
  const silent = s.silent_s > 1.0;
  put("identity", `plant ${s.plant} · model ${s.model_id.slice(0, 8)} · configuration ${s.config_id.slice(0, 8)}`);
  if (s.read_only) chip("s-rig", "recording", "", "Nothing can be sent.");
  else chip("s-rig", silent ? `silent for ${Math.round(s.silent_s)} s` : "connected", silent ? "bad" : "good");
  chip("s-control", s.control_on === null ? "unknown" : s.control_on ? "on" : "off", s.control_on ? "good" : "warn");
  const p = s.performance;
  chip("s-motion", p && p.displacement_m !== null ? `${micro(p.displacement_m)} µm at ${number(s.excitation_hz, 4)} Hz` : "–", "",
    p ? `without control ${micro(p.passive_m)} µm, physical limit ${micro(p.limit_m)} µm` : "");
  const over = p && p.power_w > 1.15 * s.goal.budget_w;
  chip("s-power", p && p.power_w !== null ? `${number(p.power_w)} / ${number(s.goal.budget_w)} W` : "–", p ? (over ? "bad" : "good") : "",
    p ? `mean Joule ${number(p.joule_mean_w)} W, peak Joule ${number(p.joule_peak_w)} W, mean electrical ${number(p.electrical_mean_w)} W` : "");
  const h = s.health, fine = h.verdict === "consistent";
  chip("s-model", fine ? "consistent" : `${h.verdict}${h.channel ? `: ${h.channel}` : ""}`, fine ? "good" : h.verdict === "drifting" ? "warn" : "bad", h.reason);
  const l = s.learner;
  if (l) chip("s-learner", `${l.status} ${Math.round(100 * (l.progress ?? 0))} %`, l.status === "estimated" ? "good" : l.status === "invalid" ? "bad" : "warn", l.reason);
  const w = s.wire;
  chip("s-blocks", `${w.lost} lost, ${w.late} late`, w.lost + w.late ? "warn" : "good", `${w.repeated} repeated, ${w.reordered} reordered, ${w.malformed} malformed, rig began anew ${w.restarts} times`);
  chip("s-clock", w.drift_ppm === null ? "–" : `${number(w.drift_ppm, 2)} ppm`, "");
  const margin = s.load > 0 ? 1 / s.load : null;
  chip("s-load", margin === null ? "–" : `${number(margin, 2)}×`, s.load > 0.7 ? "bad" : s.load > 0.4 ? "warn" : "good", "time of a block over the time the loop needs for it");
  const alarms = silent && !s.read_only ? ["The rig is silent; the station waits for it.", ...s.alarms] : s.alarms;
  const box = document.getElementById("alarms");
  if (box.dataset.text !== alarms.join("|")) {
    box.dataset.text = alarms.join("|");
    box.replaceChildren(...alarms.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
  }
  put("unseen", s.unseen ? `${s.unseen} frames the viewer could not take` : "");
}

export function addRows(rows) {
  const body = document.getElementById("rows");
  for (const row of rows) {
    const line = document.createElement("tr");
    const cells = [`${row.time_s.toFixed(1)} s`, row.level, row.text, row.model_id.slice(0, 8), row.config_id.slice(0, 8)];
    cells.forEach((text, k) => {
      const cell = line.insertCell();
      cell.textContent = text;
      if (k === 1) cell.className = `lvl lvl-${row.level}`;
      if (k > 2) cell.className = "id";
    });
    body.prepend(line);
    if (row.level === "error" || row.level === "decision") put("said", row.text);
  }
  while (body.rows.length > 300) body.deleteRow(-1);
}
