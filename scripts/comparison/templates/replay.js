"use strict";
// The replay: one canvas, drawn anew for each frame; metres are east and north of the plan's origin.
(() => {
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("stage"), context = canvas.getContext("2d"), slider = $("time"), tip = $("tip");
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
const NEVER = 65535, RADIUS = 0.25, POSE = 0.05, ANGLE = 1e-4;

const plan = data.plan;
const walls = [], outline = new Path2D();
for (const ring of plan.rings) {
  for (let i = 0; i < ring.length; i += 2) {
    const j = (i + 2) % ring.length;
    walls.push([ring[i] / 100, ring[i + 1] / 100, ring[j] / 100, ring[j + 1] / 100]);
    if (i) outline.lineTo(ring[i] / 100, ring[i + 1] / 100); else outline.moveTo(ring[i] / 100, ring[i + 1] / 100);
  }
  outline.closePath();
}
const blocks = plan.blocks.map((ring) => {
  const path = new Path2D();
  for (let i = 0; i < ring.length; i += 2) path.lineTo(ring[i] / 100, ring[i + 1] / 100);
  path.closePath();
  return path;
});
const cells = new Uint32Array(bytes(plan.cells));
const runs = data.runs.map((run) => ({
  ...run,
  poses: new Int16Array(bytes(run.poses)),
  beliefs: run.beliefs && new Int16Array(bytes(run.beliefs)),
  coverage: new Uint16Array(bytes(run.coverage)),
  seen: new Uint16Array(bytes(run.seen)),
}));
for (const run of runs) run.order = Uint32Array.from(run.seen.keys()).sort((a, b) => run.seen[a] - run.seen[b]);

// What has been seen: a small picture with a pixel for each cell, changed only where the frames differ.
const seen = document.createElement("canvas");
seen.width = plan.columns; seen.height = plan.rows;
const seenContext = seen.getContext("2d"), seenPixels = seenContext.createImageData(plan.columns, plan.rows);
let shown = 0;

const view = { x: 0, y: 0, scale: 1, width: 1, height: 1, ratio: 1 };
const state = { run: runs[0], frame: 0, playing: false, speed: 20, hover: null, drawMs: [] };

function clearSeen() {
  seenPixels.data.fill(0);
  shown = 0;
}
function paint(cell, alpha) {
  const flat = cells[cell], row = plan.rows - 1 - Math.floor(flat / plan.columns), at = 4 * (row * plan.columns + (flat % plan.columns));
  seenPixels.data.set([0xdf, 0xf0, 0xd8, alpha], at);
}
function updateSeen(frame) {
  const { order, seen: first } = state.run, before = shown;
  while (shown < order.length && first[order[shown]] <= frame && first[order[shown]] !== NEVER) paint(order[shown++], 255);
  while (shown > 0 && first[order[shown - 1]] > frame) paint(order[--shown], 0);
  if (shown !== before || frame === 0) seenContext.putImageData(seenPixels, 0, 0);
}

function poseAt(array, frame) {
  return [array[3 * frame] * POSE, array[3 * frame + 1] * POSE, array[3 * frame + 2] * ANGLE];
}
function beamsFrom([x, y, heading]) {
  const { range, first, spacing, count } = state.run.laser, ends = [];
  const near = walls.filter(([a, b, c, d]) => Math.min(a, c) < x + range && Math.max(a, c) > x - range && Math.min(b, d) < y + range && Math.max(b, d) > y - range);
  const step = Math.max(1, Math.round(count / 90));
  for (let beam = 0; beam < count; beam += step) {
    const angle = heading + first + beam * spacing, ux = Math.cos(angle), uy = Math.sin(angle);
    let reach = range;
    for (const [a, b, c, d] of near) {
      const ex = c - a, ey = d - b, cross = ux * ey - uy * ex;
      if (cross === 0) continue;
      const along = ((a - x) * ey - (b - y) * ex) / cross, share = ((a - x) * uy - (b - y) * ux) / cross;
      if (along > 0 && along < reach && share >= 0 && share <= 1) reach = along;
    }
    ends.push(x + reach * ux, y + reach * uy);
  }
  return ends;
}
function strokeWay(array, last, color, width, dash) {
  context.beginPath();
  for (let frame = 0; frame <= last; frame++) context.lineTo(array[3 * frame] * POSE, array[3 * frame + 1] * POSE);
  context.strokeStyle = color; context.lineWidth = width / view.scale;
  context.setLineDash(dash.map((length) => length / view.scale));
  context.stroke();
  context.setLineDash([]);
}
function drawRobot([x, y, heading], color, filled) {
  const radius = Math.max(RADIUS, 5 / view.scale);
  context.beginPath(); context.arc(x, y, radius, 0, 2 * Math.PI);
  context.moveTo(x, y); context.lineTo(x + 2 * radius * Math.cos(heading), y + 2 * radius * Math.sin(heading));
  context.strokeStyle = color; context.lineWidth = 2 / view.scale; context.stroke();
  if (filled) { context.fillStyle = color; context.fill(); }
}
function visibleClaims() {
  return state.run.claims.filter((claim) => claim[0] <= state.frame);
}
function drawClaims() {
  const radius = 4 / view.scale;
  for (const [frame, , correct] of visibleClaims()) {
    const [x, y] = poseAt(state.run.poses, frame);
    context.beginPath(); context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fillStyle = correct ? "#1a9850" : "#c51b7d"; context.fill();
  }
  if (!state.hover) return;
  const [frame, match] = state.hover;
  context.beginPath();
  for (let i = match; i <= frame; i++) context.lineTo(state.run.poses[3 * i] * POSE, state.run.poses[3 * i + 1] * POSE);
  context.closePath();
  context.strokeStyle = "#fdae61"; context.lineWidth = 5 / view.scale; context.stroke();
}
function closedBlocks() {
  const closed = new Set();
  for (const claim of visibleClaims()) if (claim[3]) claim[7].forEach((winding, block) => winding && closed.add(block));
  return closed;
}
function draw() {
  const began = performance.now(), { run, frame } = state;
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#eceff2"; context.fillRect(0, 0, canvas.width, canvas.height);
  const scale = view.scale * view.ratio;
  context.setTransform(scale, 0, 0, -scale, view.ratio * (view.width / 2) - scale * view.x, view.ratio * (view.height / 2) + scale * view.y);
  context.fillStyle = "#fff"; context.fill(outline, "evenodd");
  updateSeen(frame);
  context.save(); context.clip(outline, "evenodd"); context.scale(1, -1); context.imageSmoothingEnabled = false;
  context.drawImage(seen, plan.west, -plan.south - plan.rows * plan.size, plan.columns * plan.size, plan.rows * plan.size);
  context.restore();
  context.fillStyle = "#c7e0f4";
  for (const block of closedBlocks()) context.fill(blocks[block]);
  context.strokeStyle = "#555c66"; context.lineWidth = 1 / view.scale; context.stroke(outline);
  const pose = poseAt(run.poses, frame), ends = beamsFrom(pose);
  context.beginPath();
  for (let i = 0; i < ends.length; i += 2) { context.moveTo(pose[0], pose[1]); context.lineTo(ends[i], ends[i + 1]); }
  context.strokeStyle = "rgba(31,119,180,0.28)"; context.lineWidth = 1 / view.scale; context.stroke();
  strokeWay(run.poses, frame, "#1f77b4", 1.6, []);
  if (run.beliefs) { strokeWay(run.beliefs, frame, "#d95f02", 1.4, [5, 4]); drawRobot(poseAt(run.beliefs, frame), "#d95f02", false); }
  drawClaims();
  drawRobot(pose, "#1f77b4", true);
  writeStatus();
  state.drawMs.push(performance.now() - began);
  if (state.drawMs.length > 500) state.drawMs.shift();
}
function writeStatus() {
  const { run, frame } = state, claims = visibleClaims();
  const cycles = claims.filter((claim) => claim[3]).length, wrong = claims.filter((claim) => !claim[2]).length;
  const seconds = frame * run.every * data.dt;
  const clock = `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
  $("status").textContent = [clock, `seen ${(run.coverage[frame] / 100).toFixed(1)} %`, `cycles closed ${cycles} of ${plan.blocks.length}`, `claims ${claims.length}, ${wrong} of them false`].join(" \u00b7 ");
  slider.value = frame;
}
function seek(frame) {
  state.frame = Math.max(0, Math.min(state.run.frames - 1, Math.round(frame)));
  if ($("follow").checked) [view.x, view.y] = poseAt(state.run.poses, state.frame);
  draw();
}
function choose(index) {
  state.run = runs[index]; state.hover = null; clearSeen();
  slider.max = state.run.frames - 1; $("run").value = index;
  seek(Math.min(state.frame, state.run.frames - 1));
}
function fit() {
  view.x = plan.west + (plan.columns * plan.size) / 2; view.y = plan.south + (plan.rows * plan.size) / 2;
  view.scale = Math.min(view.width / (plan.columns * plan.size), view.height / (plan.rows * plan.size));
  draw();
}
function resize() {
  const box = canvas.getBoundingClientRect(), first = view.width === 1;
  view.ratio = window.devicePixelRatio || 1; view.width = box.width; view.height = box.height;
  canvas.width = Math.round(box.width * view.ratio); canvas.height = Math.round(box.height * view.ratio);
  if (first) fit(); else draw();
}
function toMetres(px, py) {
  return [view.x + (px - view.width / 2) / view.scale, view.y - (py - view.height / 2) / view.scale];
}
function zoom(factor, px, py) {
  const [x, y] = toMetres(px, py);
  view.scale = Math.max(0.5, Math.min(200, view.scale * factor));
  view.x = x - (px - view.width / 2) / view.scale; view.y = y + (py - view.height / 2) / view.scale;
  draw();
}
function play(on) {
  state.playing = on;
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  if (state.frame >= state.run.frames - 1) state.frame = 0;
  let last = performance.now(), exact = state.frame;
  const step = (now) => {
    if (!state.playing) return;
    if (Math.round(exact) !== state.frame) exact = state.frame;
    exact += ((now - last) / 1000) * state.speed / (state.run.every * data.dt); last = now;
    seek(exact);
    if (state.frame >= state.run.frames - 1) play(false); else requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
}
function pointAt(px, py) {
  let best = null, least = 9;
  for (const claim of visibleClaims()) {
    const [x, y] = poseAt(state.run.poses, claim[0]);
    const away = Math.hypot((x - view.x) * view.scale + view.width / 2 - px, -(y - view.y) * view.scale + view.height / 2 - py);
    if (away < least) { least = away; best = claim; }
  }
  if (best !== state.hover) { state.hover = best; draw(); }
  tip.style.display = best ? "block" : "none";
  if (!best) return;
  const [, , correct, fresh, step, match, error, windings] = best;
  tip.textContent = `step ${step}: back at step ${match}\n${correct ? "right" : "false"}, ${error} m off` + (correct ? `\nwinding numbers ${windings.join(" ") || "-"}` : "") + (fresh ? "\ncloses a cycle" : "");
}

const pointers = new Map();
const local = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
canvas.addEventListener("pointerdown", (event) => {
  try { canvas.setPointerCapture(event.pointerId); } catch { /* a pointer that is gone already */ }
  pointers.set(event.pointerId, local(event));
});
canvas.addEventListener("pointermove", (event) => {
  const now = local(event), before = pointers.get(event.pointerId);
  if (!before) {
    pointAt(...now);
    tip.style.left = `${Math.min(event.clientX + 14, window.innerWidth - 190)}px`; tip.style.top = `${event.clientY + 14}px`;
    return;
  }
  if (pointers.size === 1) {
    view.x -= (now[0] - before[0]) / view.scale; view.y += (now[1] - before[1]) / view.scale;
    pointers.set(event.pointerId, now); draw();
  } else {
    const [id] = [...pointers.keys()].filter((key) => key !== event.pointerId), other = pointers.get(id);
    const distance = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    pointers.set(event.pointerId, now);
    zoom(distance(now) / Math.max(1, distance(before)), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  }
});
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => {
  pointers.delete(event.pointerId);
  if (kind === "pointerup" && !pointers.size) pointAt(...local(event));
});
canvas.addEventListener("pointerleave", () => { tip.style.display = "none"; if (state.hover) { state.hover = null; draw(); } });
canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY / 400), ...local(event)); }, { passive: false });
document.addEventListener("keydown", (event) => {
  if (["SELECT", "BUTTON"].includes(event.target.tagName) || (event.target.tagName === "INPUT" && event.target !== slider)) return;
  const middle = [view.width / 2, view.height / 2];
  const keys = {
    " ": () => play(!state.playing), ArrowRight: () => seek(state.frame + (event.shiftKey ? 50 : 5)), ArrowLeft: () => seek(state.frame - (event.shiftKey ? 50 : 5)),
    Home: () => seek(0), End: () => seek(state.run.frames - 1), "+": () => zoom(1.3, ...middle), "=": () => zoom(1.3, ...middle), "-": () => zoom(1 / 1.3, ...middle), 0: fit,
  };
  if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
});
$("play").addEventListener("click", () => play(!state.playing));
$("fit").addEventListener("click", fit);
$("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
$("run").addEventListener("change", (event) => choose(Number(event.target.value)));
slider.addEventListener("input", () => seek(Number(slider.value)));
runs.forEach((run, index) => $("run").add(new Option(`${run.agent}${run.privileged ? " (privileged)" : ""}, ${run.tier}`, index)));
window.addEventListener("resize", resize);
window.replay = { state, view, seek, choose, fit, zoom, medianDrawMs: () => [...state.drawMs].sort((a, b) => a - b)[Math.floor(state.drawMs.length / 2)] };
choose(0);
resize();
})();
