// The page's centre: calls to the station, the stream of states, and the what-if that follows the controls.
import { drawBranch, drawCurves, showNow } from "/page/charts.js";
import { follow, start } from "/page/orders.js";
import { addRows, showStatus } from "/page/status.js";

const $ = (id) => document.getElementById(id);
export const number = (v, digits = 3) => (v === null || v === undefined || !Number.isFinite(v) ? "–" : String(Number(v.toPrecision(digits))));
export const micro = (metres) => (metres === null || metres === undefined ? "–" : number(1e6 * metres));
export const put = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
export const drop = (element, text) => { if (element.textContent !== text) { element.textContent = text; delete element.dataset.number; } };

let state = {};
export const seen = () => state.sample ?? 0;

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  if (!answer.ok) {
    const reason = await answer.json().then((r) => r.reason, () => answer.statusText);
    throw new Error(reason);
  }
  return answer;
}
export const call = async (path, body) => (await post(path, body)).json();

// --- what-if ---
const budget = () => 10 ** Number($("budget").value);
let touched = new Set();
export function settings() {
  const found = {};
  if (touched.has("budget_w")) found.budget_w = Number(budget().toPrecision(3));
  if (touched.has("budget_kind")) found.budget_kind = $("kind").value;
  if (touched.has("modulus_margin")) found.modulus_margin = Number($("margin").value);
  for (const input of $("controls").querySelectorAll("input[type=number]")) {
    if (input.value !== "" && input.checkValidity()) found[input.name] = Number(input.value) * (input.name === "displacement_m" ? 1e-6 : 1);
  }
  return found;
}

function showSettings() {
  put("budget-out", `${number(budget())} W`);
  put("margin-out", Number($("margin").value).toFixed(2));
}

function fromGoal(goal) {
  $("budget").value = String(Math.log10(goal.budget_w));
  $("kind").value = goal.budget_kind;
  $("margin").value = String(goal.modulus_margin);
  showSettings();
}

let curves = null, busy = false, wanted = false, since = 0;
async function redraw() {
  wanted = true;
  if (busy || !state.what_if) return;
  busy = true;
  while (wanted) {
    wanted = false;
    const began = since || performance.now();
    since = 0;
    try {
      await follow_curves(await post("/api/whatif", { changes: settings() }), began);
    } catch (error) {
      put("whatif-state", error.message);
    }
  }
  busy = false;
}

async function follow_curves(answer, began) {
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "", first = null, drawn = 0, whole = false;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    const lines = (text + value).split("\n");
    text = lines.pop();
    for (const line of lines.map((l) => JSON.parse(l))) {
      if (line.points) {
        const old = curves;
        curves = line;
        if (old && old.points.length === line.points.length) line.points.forEach((p, k) => { p.proposed = old.points[k].proposed; });
      } else if (line.point) curves.points[line.k] = line.point;
      else if (line.reason) put("whatif-state", line.reason);
    }
    if (!curves) continue;
    const due = performance.now();
    if (first === null || due - drawn > 120) { // drawing costs as much as an answer
      drawCurves(curves, first === null);
      first ??= performance.now() - began;
      drawn = performance.now();
      whole = false;
    } else whole = true;
    if (wanted) { await reader.cancel(); break; } // a newer setting: the rest of this one is of no use
  }
  if (whole) drawCurves(curves, false);
  const without = curves ? curves.points.filter((p) => p.reason).length : 0;
  put("whatif-state", without ? `No gains at ${without} of ${curves.points.length} frequencies: ${curves.points.find((p) => p.reason).reason}` : "");
  if (first !== null) {
    document.body.dataset.redrawMs = first.toFixed(1);
    document.body.dataset.completeMs = (performance.now() - began).toFixed(1);
    document.body.dataset.redraws = String(Number(document.body.dataset.redraws ?? 0) + 1);
  }
}

async function branch() {
  $("branch").disabled = true;
  $("branches").hidden = false;
  put("branch-state", "Running the twin forward …");
  try {
    const b = await call("/api/branch", { changes: settings(), seconds: 1.0 });
    drawBranch(b, []);
    for (const r of b.traces) if (r.stopped) put("said", `${r.name}: ${r.stopped}`);
    for (let k = 0; k < 50; k += 1) {
      const answer = await fetch(`/api/trace?from_sample=${b.from_sample}&seconds=${b.seconds}`);
      const measured = (await answer.json()).displacement_m;
      drawBranch(b, measured);
      put("branch-state", `${measured.length} of ${b.traces[0].displacement_m.length} ms measured since the instant; band: one sigma of the gains in use.`);
      if (measured.length >= b.traces[0].displacement_m.length) break;
      await new Promise((go) => setTimeout(go, 150));
    }
  } catch (error) {
    put("branch-state", error.message);
  }
  $("branch").disabled = false;
}

// --- the stream ---
let goalShown = "", basis = "";
function take(s) {
  state = s;
  document.body.classList.toggle("read-only", Boolean(s.read_only));
  document.body.dataset.sample = String(s.sample ?? "");
  addRows(s.log);
  if (s.sample === undefined) return;
  showStatus(s);
  showNow(s);
  follow(s);
  const goal = JSON.stringify(s.goal);
  if (goal !== goalShown) {
    goalShown = goal;
    touched = new Set();
    fromGoal(s.goal);
  }
  // The curves follow the gains in use and what is learned, without being asked.
  const now = `${goal} ${s.sent?.state === "acknowledged" ? s.sent.command_id : ""} ${Math.floor((s.time_s ?? 0) / 5)}`;
  if (s.what_if && now !== basis) {
    basis = now;
    redraw();
  }
  if (s.viewer_url && $("viewer").hidden) {
    $("viewer").hidden = false;
    $("viewer-link").href = s.viewer_url;
  }
}

$("controls").addEventListener("input", (event) => {
  touched.add(event.target.name);
  since = performance.now();
  showSettings();
  redraw();
});
$("controls").addEventListener("reset", () => setTimeout(() => { touched = new Set(); if (state.goal) fromGoal(state.goal); redraw(); }));
$("branch").addEventListener("click", branch);
$("show-viewer").addEventListener("click", () => {
  const open = $("show-viewer").getAttribute("aria-expanded") === "true";
  $("show-viewer").setAttribute("aria-expanded", String(!open));
  $("show-viewer").textContent = open ? "Show the signals here" : "Hide the signals";
  $("viewer-frame").replaceChildren();
  if (!open) $("viewer-frame").append(Object.assign(document.createElement("iframe"), { src: state.viewer_url, title: "Rerun viewer: signals of rig and twin" }));
});
start();
const stream = new EventSource("/api/stream");
stream.onmessage = (event) => take(JSON.parse(event.data));
stream.onerror = () => {
  const dd = $("s-rig").querySelector("dd");
  dd.textContent = "station does not answer";
  $("s-rig").className = "bad";
};
