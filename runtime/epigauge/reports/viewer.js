"use strict";
// Points and cameras in space on a plain canvas: 22,000 points are drawn in a few milliseconds.

// On a dark page the dark end of the ramp would not be seen.
const DARK = typeof matchMedia === "function" && matchMedia("(prefers-color-scheme: dark)").matches;
const RAMP = DARK
  ? ["#6a5cff", "#8a4dff", "#b04be0", "#d14fa8", "#e8637c", "#f5835a", "#fba83f", "#fdd45c"]
  : ["#0d0887", "#46039f", "#7201a8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a"];
const [PAPER, INK, GRID, CAMERA, SEEN, PATH, SURE] = DARK
  ? ["#14171a", "#ffffff", "#2b3238", "#ff9a3d", "#6db3dc", "#8a6a48", "#9d9dff"]
  : ["#ffffff", "#000000", "#e4e7ea", "#c25e00", "#2a6f97", "#e0a26a", "#3b3b8f"];
const SHADES = 64, FOGS = 5, NEAR = 0.02, SNAP = 12, FIELD = 1.25;
const AXES = [["x", "#c1121f"], ["y", "#2d6a4f"], ["z", "#2a6f97"]];

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function quantile(sorted, share) {
  return sorted.length ? sorted[clamp(Math.round(share * (sorted.length - 1)), 0, sorted.length - 1)] : 0;
}

function mixed(from, to, share) {
  const channel = (text, at) => parseInt(text.slice(at, at + 2), 16);
  const parts = [1, 3, 5].map((at) => Math.round(channel(from, at) * (1 - share) + channel(to, at) * share));
  return "#" + parts.map((value) => value.toString(16).padStart(2, "0")).join("");
}

// Colours of the ramp, each in some degrees of haze.
function palette() {
  return Array.from({ length: SHADES }, (_, k) => {
    const at = (k / (SHADES - 1)) * (RAMP.length - 1), step = Math.min(Math.floor(at), RAMP.length - 2);
    const pure = mixed(RAMP[step], RAMP[step + 1], at - step);
    return Array.from({ length: FOGS }, (_, haze) => mixed(pure, PAPER, (0.5 * haze) / FOGS));
  });
}

// Right, up and away of a viewer who looks down by `pitch` after turning by `yaw`; z is up.
function axesOf(yaw, pitch) {
  const sa = Math.sin(yaw), ca = Math.cos(yaw), se = Math.sin(pitch), ce = Math.cos(pitch);
  return { right: [ca, -sa, 0], up: [sa * se, ca * se, ce], away: [sa * ce, ca * ce, -se] };
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// Returns what maps a point to (x, y) on the screen and its distance.
function projector(view, width, height) {
  const { right, up, away } = axesOf(view.yaw, view.pitch);
  const focal = FIELD * Math.min(width, height), c = view.centre;
  return (p) => {
    const d = [p[0] - c[0], p[1] - c[1], p[2] - c[2]];
    const z = dot(d, away) + view.distance;
    return [width / 2 + (focal * dot(d, right)) / z, height / 2 - (focal * dot(d, up)) / z, z];
  };
}

// The half-axes of an ellipse with the covariance (a, b; b, c), and the angle of the first.
function ellipseOf(a, b, c) {
  const middle = (a + c) / 2, apart = Math.hypot((a - c) / 2, b);
  return [Math.sqrt(middle + apart), Math.sqrt(Math.max(middle - apart, 0)), 0.5 * Math.atan2(2 * b, a - c)];
}

// Largest and least eigenvalue of a symmetric matrix, given by its upper triangle.
function extremes([xx, xy, xz, yy, yz, zz]) {
  const mean = (xx + yy + zz) / 3, a = xx - mean, b = yy - mean, c = zz - mean;
  const size = Math.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6);
  if (!(size > 0)) return [mean, mean];
  const det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
  const angle = Math.acos(clamp(det / (2 * size ** 3), -1, 1)) / 3;
  return [mean + 2 * size * Math.cos(angle), mean + 2 * size * Math.cos(angle + (2 * Math.PI) / 3)];
}

// The part of a segment in front of the viewer, projected, or null.
function segment(project, a, b) {
  const p = project(a), q = project(b);
  if (p[2] <= NEAR && q[2] <= NEAR) return null;
  if (p[2] > NEAR && q[2] > NEAR) return [p, q];
  const share = (NEAR * 1.01 - p[2]) / (q[2] - p[2]);
  const cut = project(a.map((value, i) => value + share * (b[i] - value)));
  return p[2] > NEAR ? [p, cut] : [cut, q];
}

// Orders numbers coarsely, the largest first, in linear time; those not above `least` are left out.
function farToNear(depth, least, bins = 512) {
  let low = Infinity, high = -Infinity, count = 0;
  for (const z of depth) if (z > least) { low = Math.min(low, z); high = Math.max(high, z); count++; }
  const scale = high > low ? (bins - 1) / (high - low) : 0;
  const start = new Uint32Array(bins + 1), order = new Uint32Array(count);
  const bin = (z) => bins - 1 - Math.floor((z - low) * scale);
  for (const z of depth) if (z > least) start[bin(z) + 1]++;
  for (let k = 0; k < bins; k++) start[k + 1] += start[k];
  for (let k = 0; k < depth.length; k++) if (depth[k] > least) order[start[bin(depth[k])]++] = k;
  return { order, low, high };
}

// What the points can be coloured by: values, whether the scale is logarithmic, words, numbers.
function colourings(data) {
  const decimals = (value) => (value >= 100 ? value.toFixed(0) : value.toPrecision(2));
  return {
    rms: { values: data.rms, log: true, words: "RMS residual of a point (px)", shown: decimals },
    views: { values: data.views, log: true, words: "views that see a point", shown: (v) => v.toFixed(0) },
    height: { values: data.points.filter((_, k) => k % 3 === 2), log: false, words: "height (no unit)", shown: (v) => v.toFixed(1) },
  };
}

// Shade of each value between the 2nd and the 98th percentile.
function shades(colouring) {
  const sorted = Float64Array.from(colouring.values).sort();
  const low = quantile(sorted, 0.02), high = quantile(sorted, 0.98);
  const scaled = (value) => (colouring.log ? Math.log(Math.max(value, 1e-6)) : value);
  const span = scaled(high) - scaled(low);
  const of = (value) => (span > 0 ? clamp((scaled(value) - scaled(low)) / span, 0, 1) : 0.5);
  return { low, high, shade: Uint8Array.from(colouring.values, (value) => Math.round(of(value) * (SHADES - 1))) };
}

function start() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const by = (id) => document.getElementById(id);
  if (data.colours) {
    by("colour").add(new Option("colours of the photographs", "photo"), 0);
    by("colour").value = "photo";
  }
  const canvas = by("scene"), tip = by("tip"), pen = canvas.getContext("2d");
  const colours = palette(), count = data.rms.length;
  const pictures = data.pictures.map((picture) => {
    const image = new Image();
    image.addEventListener("load", draw);
    image.setAttribute("src", "data:image/jpeg;base64," + picture);
    return image;
  });
  const xs = new Float32Array(count), ys = new Float32Array(count), zs = new Float32Array(count);
  const home = { yaw: (-28 * Math.PI) / 180, pitch: (24 * Math.PI) / 180 };
  const view = { ...home, centre: [...data.middle], distance: 1 };
  let width = 0, height = 0, marked = null, pending = false, painted = null, touched = false;

  // Moves the viewer to where all that is to be seen fills the picture.
  function fit() {
    const { right, up, away } = axesOf(view.yaw, view.pitch), focal = FIELD * Math.min(width, height);
    view.centre = [...data.middle];
    const step = () => {
      view.distance = 4 * NEAR;
      for (const p of data.bounds) {
        const d = p.map((value, i) => value - view.centre[i]);
        const side = Math.max(Math.abs(dot(d, right)) / (0.46 * width), Math.abs(dot(d, up)) / (0.44 * height));
        view.distance = Math.max(view.distance, side * focal - dot(d, away));
      }
    };
    for (let round = 0; round < 12; round++) {
      step();
      const seen = data.bounds.map(projector(view, width, height));
      const off = [width, height].map((size, i) => {
        const values = seen.map((p) => p[i]);
        return size / 2 - (Math.min(...values) + Math.max(...values)) / 2;
      });
      // Near things move more than far ones: not all the way at once.
      pan(off[0] / 2, off[1] / 2);
    }
    step();
  }

  function turn(yaw, pitch) {
    Object.assign(view, { yaw, pitch });
    unmark();
    fit();
    draw();
  }

  function colour() {
    const photo = by("colour").value === "photo";
    by("legend").hidden = photo;
    if (photo) {
      painted = null;
      draw();
      return;
    }
    const colouring = colourings(data)[by("colour").value];
    painted = shades(colouring);
    by("what").textContent = colouring.words;
    by("ramp").style.background = `linear-gradient(to right, ${RAMP.join(", ")})`;
    by("low").textContent = "\u2264 " + colouring.shown(painted.low);
    by("high").textContent = "\u2265 " + colouring.shown(painted.high);
    draw();
  }

  function draw() {
    if (pending) return;
    pending = true;
    requestAnimationFrame(() => { pending = false; paint(); });
  }

  function line(project, a, b) {
    const ends = segment(project, a, b);
    if (!ends) return;
    pen.moveTo(ends[0][0], ends[0][1]);
    pen.lineTo(ends[1][0], ends[1][1]);
  }

  function strokes(style, thick, add) {
    pen.strokeStyle = style;
    pen.lineWidth = thick;
    pen.beginPath();
    add();
    pen.stroke();
  }

  function rim(camera) {
    const length = data.pyramid * Number(by("scale").value);
    return camera.corners.map((corner) => corner.map((value, i) => camera.centre[i] + length * value));
  }

  function paint() {
    const ratio = window.devicePixelRatio || 1;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = "round";
    const project = projector(view, width, height);
    if (by("grid").checked) paintGrid(project);
    paintPoints(project);
    if (by("path").checked) strokes(PATH, 1.2, () => {
      for (let k = 1; k < data.cameras.length; k++) line(project, data.cameras[k - 1].centre, data.cameras[k].centre);
    });
    if (by("lines").checked) strokes(SEEN, 1.4, () => { for (const ends of data.lines) line(project, ends.slice(0, 3), ends.slice(3)); });
    if (by("cameras").checked && by("pictures").checked) paintPictures(project);
    if (by("cameras").checked) strokes(CAMERA, 1.2, () => { for (const camera of data.cameras) pyramid(project, camera); });
    if (data.spread && by("ellipsoids").checked) paintEllipsoids(project);
    paintMarked(project);
    paintAxes();
  }

  const magnified = () => data.spread.times * 10 ** Number(by("magnify").value);
  const block = (name, k) => data.spread[name].slice(6 * k, 6 * k + 6);

  // Outlines of the ellipsoids, as from far away: the covariance across the line of sight.
  function paintEllipsoids(project) {
    const { right, up } = axesOf(view.yaw, view.pitch), focal = FIELD * Math.min(width, height), times = magnified();
    const along = ([xx, xy, xz, yy, yz, zz], u, v) =>
      u[0] * (xx * v[0] + xy * v[1] + xz * v[2]) + u[1] * (xy * v[0] + yy * v[1] + yz * v[2]) + u[2] * (xz * v[0] + yz * v[1] + zz * v[2]);
    const outline = (p, C) => {
      const scale = (times * focal) / p[2];
      const [a, b, angle] = ellipseOf(along(C, right, right), along(C, right, up), along(C, up, up));
      if (!(p[2] > NEAR) || !(a * scale > 0.6) || a * scale > 4 * width) return;
      pen.moveTo(p[0] + a * scale * Math.cos(angle), p[1] - a * scale * Math.sin(angle));
      pen.ellipse(p[0], p[1], a * scale, b * scale, -angle, 0, 2 * Math.PI);
    };
    by("times").textContent = "\u00d7 " + (times >= 100 ? times.toFixed(0) : times.toPrecision(2));
    pen.globalAlpha = count > 2000 ? 0.25 : 0.55;
    strokes(SURE, 0.8, () => { for (let k = 0; k < count; k++) outline([xs[k], ys[k], zs[k]], block("points", k)); });
    pen.globalAlpha = 0.9;
    if (by("cameras").checked) strokes(CAMERA, 1, () => data.cameras.forEach((camera, k) => outline(project(camera.centre), block("cameras", k))));
    pen.globalAlpha = 1;
  }

  // Largest and least standard deviation in the unit of the scene, in words.
  function sureness(name, k) {
    if (!data.spread) return [];
    const [high, low] = extremes(block(name, k)).map((value) => data.spread.unit * Math.sqrt(Math.max(value, 0)));
    return high > 0 ? [`sigma ${low.toPrecision(2)} to ${high.toPrecision(2)} (unit of the scene)`] : [];
  }

  function paintGrid(project) {
    const [low, high, floor] = data.grid;
    strokes(GRID, 1, () => {
      for (let x = low[0]; x <= high[0]; x++) line(project, [x, low[1], floor], [x, high[1], floor]);
      for (let y = low[1]; y <= high[1]; y++) line(project, [low[0], y, floor], [high[0], y, floor]);
    });
  }

  function paintPoints(project) {
    for (let k = 0; k < count; k++) {
      const p = project([data.points[3 * k], data.points[3 * k + 1], data.points[3 * k + 2]]);
      xs[k] = p[0]; ys[k] = p[1]; zs[k] = p[2];
    }
    const { order, low, high } = farToNear(zs, NEAR);
    const usual = data.dot * Number(by("size").value) * clamp(Math.min(width, height) / 600, 0.6, 2);
    const haze = high > low ? FOGS / (high - low) : 0;
    for (const k of order) {
      const size = clamp((usual * view.distance) / zs[k], 0.25 * usual, 4 * usual);
      pen.fillStyle = painted === null ? data.colours[k] : colours[painted.shade[k]][clamp(Math.floor((zs[k] - low) * haze), 0, FOGS - 1)];
      if (size < 3.5) pen.fillRect(xs[k] - size / 2, ys[k] - size / 2, size, size);
      else {
        pen.beginPath();
        pen.arc(xs[k], ys[k], size / 2, 0, 2 * Math.PI);
        pen.fill();
      }
    }
  }

  function pyramid(project, camera) {
    const base = rim(camera);
    base.forEach((corner, k) => {
      line(project, camera.centre, corner);
      line(project, corner, base[(k + 1) % 4]);
    });
  }

  // Photographs in the bases of the pyramids, the farthest first: nearly parallelograms there.
  function paintPictures(project) {
    const bases = pictures.map((image, k) => ({ image, at: rim(data.cameras[k]).map(project) }))
      .filter(({ image, at }) => image.complete && image.naturalWidth && at.every((p) => p[2] > NEAR));
    bases.sort((a, b) => b.at[0][2] + b.at[2][2] - a.at[0][2] - a.at[2][2]);
    for (const { image, at: [p, q, , r] } of bases) {
      pen.save();
      const w = image.naturalWidth, h = image.naturalHeight;
      pen.transform((q[0] - p[0]) / w, (q[1] - p[1]) / w, (r[0] - p[0]) / h, (r[1] - p[1]) / h, p[0], p[1]);
      pen.globalAlpha = 0.85;
      pen.drawImage(image, 0, 0);
      pen.restore();
    }
  }

  function paintMarked(project) {
    if (!marked) return;
    if (marked.point === undefined) {
      strokes(SEEN, 2.5, () => pyramid(project, data.cameras[marked.camera]));
      return;
    }
    const p = data.points.slice(3 * marked.point, 3 * marked.point + 3);
    strokes(SEEN, 0.9, () => { for (const k of seenBy(marked.point)) line(project, p, data.cameras[k].centre); });
    strokes(INK, 1.8, () => { const [x, y] = project(p); pen.arc(x, y, 6, 0, 2 * Math.PI); });
  }

  function paintAxes() {
    const { right, up } = axesOf(view.yaw, view.pitch), x0 = 42, y0 = height - 42;
    pen.font = "12px system-ui, sans-serif";
    AXES.forEach(([name, style], k) => {
      const x = x0 + 26 * right[k], y = y0 - 26 * up[k];
      strokes(style, 2, () => { pen.moveTo(x0, y0); pen.lineTo(x, y); });
      pen.fillStyle = style;
      pen.fillText(name, x0 + 34 * right[k] - 3, y0 - 34 * up[k] + 4);
    });
  }

  const seenBy = (k) => data.seen.slice(data.first[k], data.first[k + 1]);

  // The nearest thing under a place on the screen, or null.
  function under(x, y) {
    let found = null, best = SNAP * SNAP, nearest = Infinity;
    for (let k = 0; k < count; k++) {
      if (zs[k] <= NEAR) continue;
      const away = (xs[k] - x) ** 2 + (ys[k] - y) ** 2;
      // Of two points under the pointer the one in front counts.
      if (away < best || (away < 16 && zs[k] < nearest)) { best = Math.max(away, 16); nearest = zs[k]; found = { point: k }; }
    }
    if (found || !by("cameras").checked) return found;
    const project = projector(view, width, height);
    data.cameras.forEach((camera, k) => {
      const p = project(camera.centre), away = (p[0] - x) ** 2 + (p[1] - y) ** 2;
      if (p[2] > NEAR && away < best) { best = away; found = { camera: k }; }
    });
    return found;
  }

  function describe(thing) {
    if (thing.point === undefined) {
      const camera = data.cameras[thing.camera];
      return [camera.name || `view ${camera.number}`, `${camera.points} points` + (camera.rms === null ? "" : `, RMS ${camera.rms.toPrecision(3)} px`), ...sureness("cameras", thing.camera)];
    }
    const k = thing.point, at = data.points.slice(3 * k, 3 * k + 3).map((value) => value.toFixed(3));
    const views = seenBy(k).map((i) => data.cameras[i].name || data.cameras[i].number);
    const listed = views.slice(0, 12).join(", ") + (views.length > 12 ? ", \u2026" : "");
    return [`point ${data.number[k]}`, `RMS ${data.rms[k].toPrecision(3)} px in ${views.length} views: ${listed}`, `(${at.join(", ")})`, ...sureness("points", k)];
  }

  function hover(x, y) {
    marked = under(x, y);
    tip.style.display = marked ? "block" : "none";
    if (marked) {
      const [title, ...rest] = describe(marked);
      const head = document.createElement("b");
      head.textContent = title;
      tip.replaceChildren(head, "\n" + rest.join("\n"));
      if (marked.point === undefined && pictures.length) tip.append(pictures[marked.camera]);
      const room = 16, wide = tip.offsetWidth, tall = tip.offsetHeight;
      tip.style.left = clamp(x + room, 0, Math.max(width - wide, 0)) + "px";
      tip.style.top = (y + room + tall > height ? Math.max(y - room - tall, 0) : y + room) + "px";
    }
    draw();
  }

  function unmark() {
    marked = null;
    tip.style.display = "none";
  }

  function pan(dx, dy) {
    const { right, up } = axesOf(view.yaw, view.pitch), unit = view.distance / (FIELD * Math.min(width, height));
    view.centre = view.centre.map((value, i) => value - unit * (dx * right[i] - dy * up[i]));
  }

  function zoom(factor) {
    view.distance = clamp(view.distance * factor, 4 * NEAR, 1e4);
  }

  function orbit(dx, dy) {
    view.yaw += dx * 0.008;
    view.pitch = clamp(view.pitch + dy * 0.008, -Math.PI / 2, Math.PI / 2);
  }

  const fingers = new Map();
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, place(event));
    canvas.classList.add("moving");
    by("help").style.display = "none";
    touched = true;
    if (event.pointerType !== "mouse") hover(...place(event));
  });
  canvas.addEventListener("pointermove", (event) => {
    const now = place(event), before = fingers.get(event.pointerId);
    if (!before) { hover(...now); return; }
    const dx = now[0] - before[0], dy = now[1] - before[1];
    if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(Math.max(apart(before), 1) / Math.max(apart(now), 1));
      pan(dx / 2, dy / 2);
    } else if (event.shiftKey || (event.buttons & 2)) pan(dx, dy);
    else orbit(dx, dy);
    fingers.set(event.pointerId, now);
    if (Math.hypot(dx, dy) > 1) unmark();
    draw();
  });
  const release = (event) => {
    fingers.delete(event.pointerId);
    if (!fingers.size) canvas.classList.remove("moving");
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", () => {
    if (fingers.size) return;
    unmark();
    draw();
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    touched = true;
    unmark();
    zoom(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -300, 300) * 0.0015));
    draw();
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => {
    const thing = under(...place(event));
    if (!thing) return;
    const k = thing.point;
    view.centre = k === undefined ? [...data.cameras[thing.camera].centre] : data.points.slice(3 * k, 3 * k + 3);
    draw();
  });
  const keys = {
    ArrowLeft: () => orbit(-12, 0), ArrowRight: () => orbit(12, 0),
    ArrowUp: () => orbit(0, -12), ArrowDown: () => orbit(0, 12),
    "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
  };
  canvas.addEventListener("keydown", (event) => {
    const act = keys[event.key];
    if (!act) return;
    event.preventDefault();
    touched = true;
    unmark();
    act();
    draw();
  });

  for (const id of ["cameras", "pictures", "lines", "path", "grid", "ellipsoids"]) by(id).addEventListener("change", draw);
  for (const id of ["size", "scale", "magnify"]) by(id).addEventListener("input", draw);
  by("colour").addEventListener("change", colour);
  by("reset").addEventListener("click", () => turn(home.yaw, home.pitch));
  by("above").addEventListener("click", () => turn(0, Math.PI / 2));
  by("front").addEventListener("click", () => turn(0, 0));
  by("side").addEventListener("click", () => turn(-Math.PI / 2, 0));

  by("path").checked = data.sequence;
  by("edges").style.display = data.lines.length ? "" : "none";
  by("photos").style.display = pictures.length ? "" : "none";
  by("sure").style.display = data.spread ? "" : "none";
  const resize = () => {
    const ratio = window.devicePixelRatio || 1;
    width = Math.max(canvas.clientWidth, 1);
    height = Math.max(canvas.clientHeight, 1);
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    if (!touched) fit();
    draw();
  };
  window.addEventListener("resize", resize);
  resize();
  colour();
}

if (typeof document !== "undefined") start();
