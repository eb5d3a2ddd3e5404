"use strict";
// Player of recorded runs: decodes what report/playback.py packs and draws it on canvases, side by side.

const CHANNELS = ["x", "y", "yaw", "hitch", "speed", "target_speed", "alpha"];

/** Tracks of one run from its int16 bytes: per channel one Float32Array over all samples. */
function decodeRun(run, steps, bytes) {
  const deltas = new Int16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
  const channels = {};
  CHANNELS.forEach((name, c) => {
    const values = new Float32Array(run.samples);
    let at = 0;
    for (const [, , , , count, head] of run.tracks) {
      let sum = head[c];
      for (let i = 0; i < count; i++, at++) {
        sum += deltas[c * run.samples + at];
        values[at] = sum * steps[name];
      }
    }
    channels[name] = values;
  });
  let offset = 0;
  const tracks = run.tracks.map(([id, type, shape, first, count]) => {
    const track = { id, type, shape: run.shapes[shape], first, count, offset };
    offset += count;
    return track;
  });
  return { tracks, channels, collisions: run.collisions };
}

/** Inflate base64 text (zlib), as every current browser can without a library. */
async function inflate(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Vehicles at a frame number that may lie between two frames; channels are interpolated. */
function vehiclesAt(run, frame) {
  const found = [];
  for (const track of run.tracks) {
    const at = frame - track.first;
    if (at < 0 || at > track.count - 1) continue;
    const i = track.offset + Math.min(Math.floor(at), Math.max(track.count - 2, 0));
    const j = track.count > 1 ? i + 1 : i;
    const w = track.offset + at - i;
    const vehicle = { id: track.id, type: track.type, shape: track.shape };
    for (const name of CHANNELS) {
      const values = run.channels[name];
      vehicle[name] = values[i] + w * (values[j] - values[i]);
    }
    const alpha = run.channels.alpha[w < 0.5 ? i : j];
    vehicle.phase = alpha > 0;
    vehicle.alpha = alpha;
    vehicle.target_speed = run.channels.target_speed[w < 0.5 ? i : j];
    vehicle.accel = (run.channels.speed[j] - run.channels.speed[i]) / run.period;
    found.push(vehicle);
  }
  return found;
}

/** Boxes of a vehicle as [rear, front, width, yaw] about its rear axle: body, then trailer. */
function bodies(vehicle) {
  const [length, width, , overhang, trailer, trailerWidth, , setback] = vehicle.shape;
  const parts = [[-overhang, length - overhang, width, vehicle.yaw]];
  if (trailer > 0) parts.push([setback - trailer, setback, trailerWidth, vehicle.yaw - vehicle.hitch]);
  return parts;
}

/** The vehicle with a box within `reach` metres of a point, nearest first; null if there is none. */
function vehicleNear(vehicles, x, y, reach) {
  let best = null, nearest = reach;
  for (const vehicle of vehicles) {
    for (const [rear, front, width, yaw] of bodies(vehicle)) {
      const dx = x - vehicle.x, dy = y - vehicle.y;
      const ahead = dx * Math.cos(yaw) + dy * Math.sin(yaw), aside = dy * Math.cos(yaw) - dx * Math.sin(yaw);
      const distance = Math.hypot(
        Math.max(rear - ahead, 0, ahead - front), Math.max(Math.abs(aside) - width / 2, 0));
      if (distance < nearest) { nearest = distance; best = vehicle; }
    }
  }
  return best;
}

/** Path2Ds of the road, in metres. */
function roadPaths(road) {
  const draw = (lines, close) => {
    const path = new Path2D();
    for (const line of lines) {
      path.moveTo(line[0] / 10, line[1] / 10);
      for (let i = 2; i < line.length; i += 2) path.lineTo(line[i] / 10, line[i + 1] / 10);
      if (close) path.closePath();
    }
    return path;
  };
  return { surface: draw(road.surface, true), dashed: draw(road.dashed), solid: draw(road.solid) };
}

/** World to screen: centre in m, scale in px/m, the direction `yaw` points to the right, y up. */
function toScreen(view, width, height, x, y) {
  const c = Math.cos(view.yaw), s = Math.sin(view.yaw), dx = x - view.x, dy = y - view.y;
  return [width / 2 + view.scale * (dx * c + dy * s), height / 2 - view.scale * (dy * c - dx * s)];
}
function toWorld(view, width, height, px, py) {
  const c = Math.cos(view.yaw), s = Math.sin(view.yaw);
  const u = (px - width / 2) / view.scale, v = -(py - height / 2) / view.scale;
  return [view.x + u * c - v * s, view.y + u * s + v * c];
}

/** Draw one run's frame; sizes in CSS pixels, `ratio` device pixels each. */
function drawScene(context, size, view, paths, vehicles, state, colours) {
  const { width, height, ratio } = size;
  const k = view.scale * ratio, c = Math.cos(view.yaw), s = Math.sin(view.yaw);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = colours.ground;
  context.fillRect(0, 0, width * ratio, height * ratio);
  context.setTransform(
    k * c, k * s, k * s, -k * c,
    (width * ratio) / 2 - k * (view.x * c + view.y * s), (height * ratio) / 2 + k * (view.y * c - view.x * s));
  context.fillStyle = colours.asphalt;
  context.fill(paths.surface, "evenodd");
  context.lineWidth = Math.max(0.15, 1 / view.scale);
  context.strokeStyle = colours.kerb;
  context.stroke(paths.surface);
  if (view.scale > 0.8) {
    context.strokeStyle = colours.marking;
    context.stroke(paths.solid);
    context.setLineDash([3, 6]);
    context.stroke(paths.dashed);
    context.setLineDash([]);
  }
  const least = 3 / view.scale; // a vehicle stays visible from afar
  for (const vehicle of vehicles) {
    const colour = vehicle.phase ? colours.phase : colours.sumo;
    bodies(vehicle).forEach(([rear, front, width, yaw], part) => {
      const w = Math.max(width, least);
      context.save();
      context.translate(vehicle.x, vehicle.y);
      context.rotate(yaw);
      context.fillStyle = part ? colours.trailer(colour) : colour;
      context.fillRect(rear, -w / 2, front - rear, w);
      if (!part && view.scale > 2) {
        context.fillStyle = colours.glass;
        context.fillRect(front - 0.3 * (front - rear), -0.4 * w, 0.14 * (front - rear), 0.8 * w);
      }
      if (vehicle.id === state.followed) {
        context.strokeStyle = colours.ink;
        context.lineWidth = Math.max(0.3, 2 / view.scale);
        context.strokeRect(rear - 0.3, -w / 2 - 0.3, front - rear + 0.6, w + 0.6);
      }
      context.restore();
    });
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.strokeStyle = colours.collision;
  context.lineWidth = 2.5;
  for (const [time, x, y] of state.collisions) {
    const age = state.time - time;
    if (age < -0.2 || age > 3) continue;
    const [px, py] = toScreen(view, width, height, x, y);
    context.beginPath();
    context.arc(px, py, 12 + 4 * Math.max(age, 0), 0, 2 * Math.PI);
    context.stroke();
  }
  const bar = [10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((m) => m * view.scale > 60) || 5000;
  context.fillStyle = colours.ink;
  context.fillRect(width - 16 - bar * view.scale, height - 12, bar * view.scale, 2.5);
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "right";
  context.fillText(bar >= 1000 ? `${bar / 1000} km` : `${bar} m`, width - 16, height - 17);
}

/** What the panel says about a vehicle. */
function describe(vehicle) {
  const text = [
    `${vehicle.id} (${vehicle.type})`,
    vehicle.phase ? "driven by PHASE" : "driven by SUMO",
    `${vehicle.speed.toFixed(1)} m/s`,
    `${vehicle.accel >= 0 ? "+" : "−"}${Math.abs(vehicle.accel).toFixed(1)} m/s²`,
    `target ${vehicle.target_speed.toFixed(1)} m/s`,
  ];
  if (vehicle.phase) text.push(`α ${vehicle.alpha.toFixed(2)}`);
  if (vehicle.shape[4] > 0) text.push(`hitch ${((vehicle.hitch * 180) / Math.PI).toFixed(1)}°`);
  return text.join(" · ");
}

async function startPlayback(root, data) {
  const element = (name) => root.querySelector(`[data-part="${name}"]`);
  const runs = {};
  for (const [name, run] of Object.entries(data.runs)) {
    runs[name] = decodeRun(run, data.steps, await inflate(run.data));
    runs[name].period = data.period;
  }
  const paths = roadPaths(data.road);
  const home = () => ({ x: 0, y: 0, yaw: data.yaw, scale: Math.max(root.clientWidth, 300) / 230 });
  let view = home(), time = data.moment, playing = false, followed = null, master = 0, last = null, drag = null;
  const panels = [...root.querySelectorAll("[data-panel]")].map((panel) => ({
    canvas: panel.querySelector("canvas"),
    select: panel.querySelector("select"),
    text: panel.querySelector("output"),
  }));
  const slider = element("time");
  slider.min = data.begin;
  slider.max = data.end;

  function colours() {
    const style = getComputedStyle(document.documentElement);
    const read = (name) => style.getPropertyValue(`--${name}`).trim();
    const names = ["ground", "asphalt", "kerb", "marking", "ink", "glass", "phase", "sumo", "collision"];
    const palette = Object.fromEntries(names.map((name) => [name, read(name)]));
    palette.trailer = (colour) => `color-mix(in srgb, ${colour} 62%, ${palette.asphalt})`;
    return palette;
  }

  function draw() {
    const palette = colours(), frame = (time - data.begin) / data.period;
    const scenes = panels.map((panel) => vehiclesAt(runs[panel.select.value], frame));
    const lead = scenes[master] && scenes[master].find((v) => v.id === followed);
    if (lead) { view.x = lead.x; view.y = lead.y; }
    panels.forEach((panel, p) => {
      const ratio = window.devicePixelRatio || 1, width = panel.canvas.clientWidth, height = panel.canvas.clientHeight;
      if (panel.canvas.width !== Math.round(width * ratio) || panel.canvas.height !== Math.round(height * ratio)) {
        panel.canvas.width = Math.round(width * ratio);
        panel.canvas.height = Math.round(height * ratio);
      }
      const state = { time, followed, collisions: runs[panel.select.value].collisions };
      drawScene(panel.canvas.getContext("2d"), { width, height, ratio }, view, paths, scenes[p], state, palette);
      const own = scenes[p].find((v) => v.id === followed);
      const phase = scenes[p].filter((v) => v.phase).length;
      panel.text.textContent = own ? describe(own)
        : `${scenes[p].length} vehicles on the observed road, ${phase} PHASE` + (followed ? ` · ${followed} is not here now` : "");
    });
    slider.value = time;
    element("clock").textContent = `${time.toFixed(1)} s`;
    element("play").textContent = playing ? "Pause" : "Play";
  }

  function tick(now) {
    if (!playing) { last = null; return; }
    if (last !== null) time += ((now - last) / 1000) * Number(element("pace").value);
    last = now;
    if (time >= data.end) { time = data.end; playing = false; }
    draw();
    requestAnimationFrame(tick);
  }
  function play(wanted) {
    if (wanted && time >= data.end) time = data.begin;
    if (wanted && !playing) { playing = true; requestAnimationFrame(tick); }
    playing = wanted;
    draw();
  }
  function zoom(factor, panel, px, py) {
    const width = panel.canvas.clientWidth, height = panel.canvas.clientHeight;
    const before = toWorld(view, width, height, px, py);
    view.scale = Math.min(Math.max(view.scale * factor, 0.02), 60);
    const after = toWorld(view, width, height, px, py);
    view.x += before[0] - after[0];
    view.y += before[1] - after[1];
    draw();
  }

  element("play").onclick = () => play(!playing);
  element("reset").onclick = () => { view = home(); followed = null; draw(); };
  for (const [name, factor] of [["in", 1.4], ["out", 1 / 1.4]]) {
    element(name).onclick = () => {
      const { canvas } = panels[0];
      zoom(factor, panels[0], canvas.clientWidth / 2, canvas.clientHeight / 2);
    };
  }
  slider.oninput = () => { time = Number(slider.value); draw(); };
  panels.forEach((panel, p) => {
    panel.select.onchange = draw;
    panel.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY), panel, event.offsetX, event.offsetY);
    }, { passive: false });
    panel.canvas.onpointerdown = (event) => {
      drag = { x: event.offsetX, y: event.offsetY, moved: 0 };
      panel.canvas.setPointerCapture(event.pointerId);
    };
    panel.canvas.onpointermove = (event) => {
      if (!drag) return;
      const width = panel.canvas.clientWidth, height = panel.canvas.clientHeight;
      const from = toWorld(view, width, height, drag.x, drag.y), to = toWorld(view, width, height, event.offsetX, event.offsetY);
      drag.moved += Math.hypot(event.offsetX - drag.x, event.offsetY - drag.y);
      drag.x = event.offsetX;
      drag.y = event.offsetY;
      if (drag.moved < 4) return;
      followed = null;
      view.x += from[0] - to[0];
      view.y += from[1] - to[1];
      draw();
    };
    panel.canvas.onpointerup = (event) => {
      if (drag && drag.moved < 4) {
        const at = toWorld(view, panel.canvas.clientWidth, panel.canvas.clientHeight, event.offsetX, event.offsetY);
        const scene = vehiclesAt(runs[panel.select.value], (time - data.begin) / data.period);
        const hit = vehicleNear(scene, at[0], at[1], Math.max(1.5, 10 / view.scale));
        followed = hit && hit.id;
        master = p;
        draw();
      }
      drag = null;
    };
  });
  root.addEventListener("keydown", (event) => {
    if (event.key === " " && !["SELECT", "BUTTON"].includes(event.target.tagName)) { event.preventDefault(); play(!playing); }
  });
  for (const link of document.querySelectorAll("[data-moment]")) {
    link.onclick = () => {
      const { moment, x, y, model } = link.dataset;
      if (!panels.some((panel) => panel.select.value === model)) panels[0].select.value = model;
      time = Math.max(Number(moment) - 2, data.begin);
      followed = null;
      view = { ...home(), x: x - data.origin[0], y: y - data.origin[1] };
      root.scrollIntoView({ behavior: "smooth" });
      play(true);
    };
  }
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  root.dataset.ready = "yes";
  draw();
}

if (typeof module !== "undefined") {
  module.exports = { decodeRun, inflate, vehiclesAt, bodies, vehicleNear, roadPaths, toScreen, toWorld, drawScene, describe };
}
