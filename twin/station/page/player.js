// The player of a recording: play, pause, step, speed, and a jump to any instant.
import { call, put } from "/page/page.js";

const $ = (id) => document.getElementById(id);
let wanted = null, playing = true;

const wish = (action, value = 0) => call("/api/player", { action, value }).catch((error) => put("position", error.message));

export function start() {
  $("play").addEventListener("click", () => wish(playing ? "pause" : "play"));
  $("step").addEventListener("click", () => wish("step"));
  $("speed").addEventListener("change", () => wish("speed", Number($("speed").value)));
  $("seek").addEventListener("input", () => {
    wanted = Number($("seek").value);
    put("position", `to ${wanted.toFixed(1)} s`);
  });
  $("seek").addEventListener("change", () => wish("seek", Number($("seek").value)).then(() => { wanted = null; }));
}

export function showPlayer(p) {
  $("player").hidden = !p;
  if (!p) return;
  playing = p.playing;
  put("play", playing ? "Pause" : p.ended ? "Play again" : "Play");
  const seek = $("seek");
  seek.min = String(p.begin_s);
  seek.max = String(p.length_s);
  seek.disabled = !p.seekable;
  seek.setAttribute("aria-valuetext", `${p.position_s.toFixed(1)} of ${p.length_s.toFixed(1)} seconds`);
  if (wanted === null && !p.seeking) seek.value = String(p.position_s);
  if (wanted === null) put("position", p.seeking ? `going there, at ${p.position_s.toFixed(1)} s` : `${p.position_s.toFixed(1)} / ${p.length_s.toFixed(1)} s`);
  const speed = String(p.speed);
  if (document.activeElement !== $("speed") && [...$("speed").options].some((o) => o.value === speed)) $("speed").value = speed;
  document.body.dataset.playing = String(playing);
}
