// The page's centre: calls to the station, the stream of states, and the what-if that follows the controls.
import { drawBranch, showNow } from "/page/charts.js";
import { redraw } from "/page/curves.js";
import { follow, start } from "/page/orders.js";
import { showPlayer, start as startPlayer } from "/page/player.js";
import { addRows, showStatus } from "/page/status.js";

const $ = (id) => document.getElementById(id);
export const number = (v, digits = 3) => (v === null || v === undefined || !Number.isFinite(v) ? "–" : String(Number(v.toPrecision(digits))));
// Where digits no longer mean anything they are not shown.
const least = (v, digits) => (v !== null && v !== undefined && Math.abs(v) < 0.01 ? (v === 0 ? "0" : "<0.01") : number(v, digits));
export const micro = (metres, digits = 3) => least(metres === null || metres === undefined ? null : 1e6 * metres, digits);
export const watts = (w, digits = 3) => least(w, digits);
export const put = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
export const drop = (element, text) => { if (element.textContent !== text) { element.textContent = text; delete element.dataset.number; } };

let state = {};
export const seen = () => state.sample ?? 0;

export async function post(path, body, signal) {
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body), signal });
  if (!answer.ok) {
    const reason = await answer.json().then((r) => r.reason, () => answer.statusText);
    throw new Error(reason);
  }
  return answer;
}
export const call = async (path, body, signal) => (await post(path, body, signal)).json();

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
  put("budget-out", `${number(touched.has("budget_w") || !state.goal ? budget() : state.goal.budget_w)} W`);
  put("margin-out", Number($("margin").value).toFixed(2));
}

function fromGoal(goal) {
  $("budget").value = String(Math.log10(goal.budget_w));
  $("kind").value = goal.budget_kind;
  $("margin").value = String(goal.modulus_margin);
  showSettings();
}

let branchNumber = 0, branchShown = [];
function showBranch(b, measured) {
  branchShown = [b, measured];
  drawBranch(b, measured, $("with-passive").checked);
}

async function branch() {
  const mine = ++branchNumber;
  $("branch").disabled = true;
  $("branches").hidden = false;
  put("branch-state", "Running the twin forward …");
  try {
    const b = await call("/api/branch", { changes: settings(), seconds: 1.0 });
    $("branch").disabled = false;
    showBranch(b, []);
    $("branches").scrollIntoView({ block: "nearest" });
    const stops = b.traces.filter((r) => r.stopped).map((r) => ` ${r.name}: ${r.stopped}.`).join("");
    const all = b.traces[0].displacement_m.length;
    for (let shown = -1; mine === branchNumber && shown < all; ) {
      const answer = await fetch(`/api/trace?from_sample=${b.from_sample}&seconds=${b.seconds}`);
      const measured = (await answer.json()).displacement_m;
      if (measured.length !== shown) showBranch(b, measured);
      shown = measured.length;
      const waits = state.player && !state.player.playing && shown < all ? " Play on to see what was measured." : "";
      put("branch-state", `${shown} of ${all} ms measured since the instant; band: one sigma of the gains in use.${stops}${waits}`);
      if (shown < all) await new Promise((go) => setTimeout(go, 200));
    }
  } catch (error) {
    put("branch-state", error.message);
  }
  $("branch").disabled = false;
}

// --- Rerun's viewer ---
// Browsers keep its cookie for the host it was set by: it is asked for under the name this page was.
function viewerUrl() {
  const url = new URL(state.viewer_url);
  if (location.hostname === "localhost") url.hostname = "localhost";
  return url.href;
}

function openViewer(open) {
  const button = $("show-viewer");
  if (open === (button.getAttribute("aria-expanded") === "true")) return;
  button.setAttribute("aria-expanded", String(open));
  button.textContent = open ? "Hide the signals" : "Show the signals here";
  $("viewer-frame").replaceChildren();
  if (open) $("viewer-frame").append(Object.assign(document.createElement("iframe"), { src: viewerUrl(), title: "Rerun viewer: signals of rig and twin" }));
}

// Drawn by a graphics processor the viewer is there from the start; drawn by the processor that runs the loop only on demand.
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl?.getExtension("WEBGL_debug_renderer_info");
  const renderer = about ? String(gl.getParameter(about.UNMASKED_RENDERER_WEBGL)) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return !gl || /swiftshader|llvmpipe|software|basic render/i.test(renderer);
}

function offerViewer() {
  const url = viewerUrl();
  $("viewer").hidden = false;
  $("viewer-link").href = url;
  const local = (host) => ["127.0.0.1", "localhost", "[::1]"].includes(host);
  if (local(new URL(url).hostname) && !local(location.hostname)) {
    put("viewer-note", "Only on the station's own machine.");
    $("show-viewer").hidden = $("viewer-link").hidden = true;
  } else if (drawnInSoftware()) put("viewer-note", "This browser draws without a graphics processor: it will be slow.");
  else openViewer(true);
}

// --- the stream ---
let goalShown = "", basis = "";
function take(s) {
  state = s;
  document.body.classList.toggle("read-only", Boolean(s.read_only));
  document.body.dataset.sample = String(s.sample ?? "");
  addRows(s.log);
  showPlayer(s.player);
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
  const now = `${goal} ${s.sent?.state === "acknowledged" ? s.sent.command_id : ""} ${s.player && !s.player.playing ? s.time_s : Math.floor((s.time_s ?? 0) / 5)}`;
  if (s.what_if && now !== basis) {
    basis = now;
    redraw();
  }
  if (s.excitation) {
    put("excitation-label", `Peak drive [${s.excitation.unit}]`);
    const now = `now ${number(s.excitation.peak)}`;
    if ($("excitation").placeholder !== now) $("excitation").placeholder = now;
  }
  if (s.viewer_url && $("viewer").hidden) offerViewer();
}

$("controls").addEventListener("input", (event) => {
  touched.add(event.target.name);
  showSettings();
  if (state.what_if) redraw(event.timeStamp);
});
$("controls").addEventListener("reset", (event) => setTimeout(() => { touched = new Set(); if (state.goal) fromGoal(state.goal); if (state.what_if) redraw(event.timeStamp); }));
$("branch").addEventListener("click", branch);
$("with-passive").addEventListener("change", () => branchShown.length && showBranch(...branchShown));
$("show-viewer").addEventListener("click", () => openViewer($("show-viewer").getAttribute("aria-expanded") !== "true"));
start();
startPlayer();
const stream = new EventSource("/api/stream");
let heard = performance.now();
stream.onmessage = (event) => {
  heard = performance.now();
  take(JSON.parse(event.data));
};
// What is on the screen must not pass for the present when nothing comes any more.
setInterval(() => {
  const quiet_s = (performance.now() - heard) / 1000, stale = quiet_s > 2;
  document.body.classList.toggle("stale", stale);
  const text = !stale ? "" : stream.readyState === EventSource.CLOSED
    ? "The station refuses this page: open the address it printed at its start."
    : `The station does not answer: what is shown is ${Math.round(quiet_s)} s old. Without a station the rig switches its control off.`;
  if ($("stale").textContent === text) return;
  $("stale").replaceChildren(...(text ? [Object.assign(document.createElement("p"), { textContent: text })] : []));
  if (!stale) return;
  $("verdict").className = "bad";
  put("verdict-word", "No station");
  put("verdict-why", `nothing heard for ${Math.round(quiet_s)} s`);
}, 500);
