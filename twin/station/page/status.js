// The status line, what it adds up to, the alarms and the log.
import { micro, number, put, watts } from "/page/page.js";

const RANK = { "": 0, good: 0, warn: 1, bad: 2 };
const KIND = { joule_mean: "mean Joule", joule_peak: "peak Joule", electrical: "mean electrical" };
let found = [];

function chip(id, text, level, words = "") {
  const box = document.getElementById(id), value = box.querySelector("dd");
  if (value.textContent !== text) value.textContent = text;
  box.className = level;
  box.title = words;
  found.push({ name: box.querySelector("dt").textContent, text, level, words });
}

export function showStatus(s) {
  if (s.sample === undefined) return;
  found = [];
  const silent = s.silent_s > 1.0 && !s.read_only;
  if (s.over) chip("s-rig", "the run is over", "warn", "What was is still shown; nothing can be sent.");
  else if (s.read_only) chip("s-rig", "recording", "", "Nothing can be sent.");
  else chip("s-rig", silent ? `silent for ${Math.round(s.silent_s)} s` : "connected", silent ? "bad" : "good");
  chip("s-control", s.control_on === null ? "not told" : s.control_on ? "on" : "off", s.control_on ? "good" : s.read_only ? "" : "warn");
  const p = s.performance;
  chip("s-motion", p && p.displacement_m !== null ? `${micro(p.displacement_m)} µm, ${number(s.excitation_hz, 4)} Hz` : "–", "",
    p ? `peak; without control ${micro(p.passive_m)} µm, the least any linear controller could reach ${micro(p.limit_m)} µm` : "no excitation is tracked");
  const over = p && p.power_w > 1.15 * s.goal.budget_w;
  chip("s-power", p && p.power_w !== null ? `${watts(p.power_w)} / ${number(s.goal.budget_w)} W` : "–", p ? (over ? "bad" : "good") : "",
    p ? `budget of ${KIND[s.goal.budget_kind]} power; now mean Joule ${watts(p.joule_mean_w)} W, peak Joule ${watts(p.joule_peak_w)} W, mean electrical ${watts(p.electrical_mean_w)} W` : "");
  const h = s.health, fine = h.verdict === "consistent";
  chip("s-model", fine ? "consistent" : `${h.verdict}${h.channel ? `: ${h.channel}` : ""}`, fine ? "good" : ["diverged", "no data"].includes(h.verdict) ? "bad" : "warn", h.reason);
  const l = s.learner;
  if (l) chip("s-learner", `${l.status} ${Math.round(100 * (l.progress ?? 0))} %`, l.status === "estimated" ? "good" : l.status === "invalid" ? "bad" : "warn", l.reason || "share of the control band that is learned");
  else chip("s-learner", "–", "", "nothing to learn from in this block");
  const w = s.wire;
  if (s.player) {
    chip("s-blocks", "–", "", "of a recording; masked values are in the log");
    chip("s-clock", "–", "");
  } else {
    chip("s-blocks", `${w.lost}${w.late ? `, ${w.late} late` : ""}`, w.lately ? "warn" : "good", `${w.lost} lost, ${w.late} late, ${w.repeated} repeated, ${w.reordered} put back in order, ${w.malformed} malformed, rig began anew ${w.restarts} times`);
    chip("s-clock", drift(w.drift_ppm), "", "rig's clock against the station's");
  }
  const margin = s.load > 0 ? 1 / s.load : null;
  chip("s-load", margin === null ? "–" : `${number(margin, 2)}×`, s.load > 0.7 ? "bad" : s.load > 0.4 ? "warn" : "good", "time of a block over the time the loop needs for it");
  chip("s-viewer", s.unseen ? `${s.unseen} dropped` : "0 dropped", "", "frames the viewer could not take; the recording has them");
  const alarms = silent ? ["The rig is silent; the station waits for it. Its controller goes off by itself.", ...s.alarms] : s.alarms;
  chip("s-alarms", alarms.length ? String(alarms.length) : "none", alarms.length ? "bad" : "good");
  const notices = s.notices ?? [];
  if (notices.length) found.push({ name: "Notice", text: notices[0], level: "warn", words: "" });
  lines("alarms", alarms);
  lines("notices", notices);
  sum(s, alarms);
}

const drift = (ppm) => (ppm === null ? "–" : Math.abs(ppm) < 1e4 ? `${number(ppm, 2)} ppm` : `${number(ppm / 1e4, 2)} %`);

function lines(id, texts) {
  const box = document.getElementById(id), all = texts.join("|");
  if (box.dataset.text === all) return;
  box.dataset.text = all;
  box.replaceChildren(...texts.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
}

function sum(s, alarms) {
  const worst = found.reduce((a, c) => (RANK[c.level] > RANK[a] ? c.level : a), "good");
  const why = found.filter((c) => c.level === worst && c.name !== "Alarms").map((c) => `${c.name}: ${c.text}`);
  const box = document.getElementById("verdict");
  if (box.className !== worst) box.className = worst;
  put("verdict-word", { good: "All well", warn: "Look here", bad: alarms.length ? "Alarm" : "Trouble" }[worst]);
  if (worst === "bad" && alarms.length) why.unshift(alarms[0]);
  put("verdict-why", worst === "good" ? `plant ${s.plant} · model ${s.model_id.slice(0, 8)} · configuration ${s.config_id.slice(0, 8)}` : why.join(" · "));
  const list = document.getElementById("in-words");
  if (!list.parentElement.open) return;
  const words = [...found, { name: "Identity", text: `plant ${s.plant}, model ${s.model_id}, configuration ${s.config_id}`, words: "", level: "" }];
  words.forEach((c, k) => {
    const text = `${c.text}${c.level && c.level !== "good" ? ` (${c.level === "bad" ? "trouble" : "worth a look"})` : ""}${c.words ? `; ${c.words}` : ""}`;
    if (!list.children[2 * k]) list.append(document.createElement("dt"), document.createElement("dd"));
    if (list.children[2 * k].textContent !== c.name) list.children[2 * k].textContent = c.name;
    if (list.children[2 * k + 1].textContent !== text) list.children[2 * k + 1].textContent = text;
  });
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
