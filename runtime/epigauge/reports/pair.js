"use strict";
// The epipolar line of the point under the pointer, with the band of its uncertainty.

const DEVIATIONS = 2;
const SNAP = 12; // pixels of the screen

// Line (3) in the other image of point x in image `view`: F x, or F^T x from the second to the first.
function epipolarLine(F, x, view) {
  const h = [x[0], x[1], 1];
  return [0, 1, 2].map((i) => h.reduce((sum, value, j) => sum + (view ? F[j][i] : F[i][j]) * value, 0));
}

// Covariance (3x3) of that line, from the covariance (9x9) of F row by row.
function lineCovariance(covariance, x, view) {
  const h = [x[0], x[1], 1];
  const at = (i, j) => (view ? 3 * j + i : 3 * i + j);
  return [0, 1, 2].map((i) => [0, 1, 2].map((k) => {
    let sum = 0;
    for (let j = 0; j < 3; j++) for (let l = 0; l < 3; l++) sum += covariance[at(i, j)][at(k, l)] * h[j] * h[l];
    return sum;
  }));
}

// Ends of the part of a line in an image of that size, or null.
function clip(line, size) {
  const [a, b, c] = line, [width, height] = size;
  const ends = [];
  if (b) for (const x of [-0.5, width - 0.5]) ends.push([x, -(a * x + c) / b]);
  if (a) for (const y of [-0.5, height - 0.5]) ends.push([-(b * y + c) / a, y]);
  const slack = 1e-9 * (width + height);
  const inside = ends.filter(([x, y]) =>
    x >= -0.5 - slack && x <= width - 0.5 + slack && y >= -0.5 - slack && y <= height - 0.5 + slack);
  if (inside.length < 2) return null;
  const distance = (p) => Math.hypot(p[0] - inside[0][0], p[1] - inside[0][1]);
  return [inside[0], inside.reduce((far, p) => (distance(p) > distance(far) ? p : far))];
}

// Standard deviation, across the line, of where it passes point y.
function deviation(line, covariance, y) {
  const h = [y[0], y[1], 1];
  let variance = 0;
  for (let i = 0; i < 3; i++) for (let k = 0; k < 3; k++) variance += h[i] * covariance[i][k] * h[k];
  return Math.sqrt(Math.max(variance, 0)) / Math.hypot(line[0], line[1]);
}

// Outline of the band along the line between two ends.
function band(line, covariance, ends) {
  const norm = Math.hypot(line[0], line[1]), steps = 40;
  const sides = [[], []];
  for (let k = 0; k <= steps; k++) {
    const y = [0, 1].map((i) => ends[0][i] + (ends[1][i] - ends[0][i]) * k / steps);
    const reach = DEVIATIONS * deviation(line, covariance, y) / norm;
    sides[0].push([y[0] + reach * line[0], y[1] + reach * line[1]]);
    sides[1].unshift([y[0] - reach * line[0], y[1] - reach * line[1]]);
  }
  return sides[0].concat(sides[1]);
}

function start() {
  const data = JSON.parse(document.getElementById("data").textContent);
  const said = document.getElementById("said");
  const views = [...document.querySelectorAll(".views svg")];
  const make = (svg, name, attributes) => {
    const node = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    return svg.appendChild(node);
  };
  const radius = (view) => Math.max(...data.sizes[view]) / 160;
  const marks = views.map((svg, view) => {
    const [width, height] = data.sizes[view];
    svg.setAttribute("viewBox", `-0.5 -0.5 ${width} ${height}`);
    data.x[view].forEach(([cx, cy], k) => make(svg, "circle", { cx, cy, r: radius(view), fill: data.colour[k] }));
    return {
      band: make(svg, "polygon", { class: "band", points: "" }),
      line: make(svg, "polyline", { class: "line", points: "" }),
      ring: make(svg, "circle", { class: "mark", r: 0 }),
    };
  });

  function clear() {
    for (const mark of marks) {
      mark.band.setAttribute("points", "");
      mark.line.setAttribute("points", "");
      mark.ring.setAttribute("r", 0);
    }
    said.textContent = "\u00a0";
  }

  function ring(view, x) {
    const node = marks[view].ring;
    node.setAttribute("cx", x[0]);
    node.setAttribute("cy", x[1]);
    node.setAttribute("r", 2 * radius(view));
  }

  function show(view, x, snap) {
    clear();
    const near = data.x[view].map((p) => Math.hypot(p[0] - x[0], p[1] - x[1]));
    const nearest = near.reduce((best, value, k) => (value < near[best] ? k : best), 0);
    const match = near[nearest] <= snap ? nearest : -1;
    if (match >= 0) x = data.x[view][match];
    const other = 1 - view;
    const line = epipolarLine(data.F, x, view);
    const ends = clip(line, data.sizes[other]);
    ring(view, x);
    let text = `(${x[0].toFixed(1)}, ${x[1].toFixed(1)}) in image ${view + 1}`;
    if (match >= 0) {
      ring(other, data.x[other][match]);
      text += `: match ${data.rows[match]}, distance ${Math.abs(data.distance[match]).toPrecision(3)} px`;
    }
    if (ends) {
      marks[other].line.setAttribute("points", ends.join(" "));
      if (data.covariance) {
        const covariance = lineCovariance(data.covariance, x, view);
        marks[other].band.setAttribute("points", band(line, covariance, ends).join(" "));
        const middle = match >= 0 ? data.x[other][match] : ends[0].map((value, i) => (value + ends[1][i]) / 2);
        text += `; epipolar line known to ${deviation(line, covariance, middle).toPrecision(2)} px (one standard deviation)`;
      }
    } else text += "; its epipolar line passes outside the other image";
    said.textContent = text;
  }

  views.forEach((svg, view) => {
    const follow = (event) => {
      const matrix = svg.getScreenCTM();
      const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix.inverse());
      show(view, [point.x, point.y], SNAP / matrix.a);
    };
    svg.addEventListener("pointermove", follow);
    svg.addEventListener("pointerdown", follow);
    svg.addEventListener("pointerleave", clear);
  });
}

if (typeof document !== "undefined") start();
