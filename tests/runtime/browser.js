"use strict";
// A browser of paper for test_viewer.py: elements that remember, a canvas that counts what is drawn
// on it and takes finite numbers only, and events on request. Usage: node browser.js PAGE.

const fs = require("fs");

const page = fs.readFileSync(process.argv[2], "utf8");
const [, json, script] = page.match(/id="data">([^]*?)<\/script>\s*<script>([^]*?)<\/script>/);
const counts = {}, elements = {}, frames = [];

const pen = new Proxy({}, {
  set: () => true,
  get: (_, name) => (...values) => {
    counts[name] = (counts[name] || 0) + 1;
    if (values.some((value) => typeof value === "number" && !Number.isFinite(value))) {
      throw new Error(`${name}(${values})`);
    }
  },
});

function element(id) {
  const listeners = {};
  return {
    style: {},
    classList: { add() {}, remove() {} },
    clientWidth: 800,
    clientHeight: 600,
    offsetWidth: 120,
    offsetHeight: 60,
    checked: true,
    value: { colour: "rms", size: "1", scale: "1", magnify: "0" }[id],
    textContent: id === "data" ? json : "",
    parts: [],
    getContext: () => pen,
    setPointerCapture() {},
    getBoundingClientRect: () => ({ left: 0, top: 0 }),
    replaceChildren(...parts) { this.parts = parts.map((part) => part.textContent ?? part); },
    addEventListener: (name, act) => { listeners[name] = act; },
    fire: (name, event = {}) =>
      listeners[name]({ pointerId: 1, pointerType: "mouse", preventDefault() {}, ...event }),
  };
}

global.document = {
  getElementById: (id) => (elements[id] ??= element(id)),
  createElement: (name) => element(name),
};
global.window = { devicePixelRatio: 2, addEventListener() {} };
global.requestAnimationFrame = (act) => frames.push(act);

function paint() {
  for (const name in counts) delete counts[name];
  while (frames.length) frames.shift()();
  return { ...counts };
}

const exported = "{ axesOf, projector, farToNear, segment, ellipseOf, extremes }";
const { axesOf, projector, farToNear, segment, ellipseOf, extremes } = new Function(`${script}; return ${exported};`)();
const by = document.getElementById, canvas = by("scene"), tip = by("tip"), said = {};

said.first = paint();

// Somewhere under the pointer is a point.
search: for (let y = 0; y < 600; y += 3) {
  for (let x = 0; x < 800; x += 3) {
    canvas.fire("pointermove", { clientX: x, clientY: y });
    if (tip.style.display === "block" && tip.parts[0].startsWith("point")) {
      canvas.fire("dblclick", { clientX: x, clientY: y });
      break search;
    }
  }
}
said.tip = tip.parts;
paint();

const finger = { pointerType: "touch", clientX: 400, clientY: 300 };
for (const [name, event] of [
  ["pointerdown", { clientX: 400, clientY: 300 }],
  ["pointermove", { clientX: 500, clientY: 250, buttons: 1 }],
  ["pointermove", { clientX: 400, clientY: 260, buttons: 1, shiftKey: true }],
  ["pointerup", {}],
  ["pointerdown", finger],
  ["pointerdown", { ...finger, pointerId: 2, clientX: 500 }],
  ["pointermove", { ...finger, pointerId: 2, clientX: 600 }],
  ["pointerup", {}],
  ["pointercancel", { pointerId: 2 }],
  ["pointerleave", {}],
  ["wheel", { deltaY: -3e4, deltaMode: 0 }],
  ["wheel", { deltaY: 300, deltaMode: 1 }],
  ["keydown", { key: "ArrowLeft" }],
  ["keydown", { key: "+" }],
  ["keydown", { key: "q" }],
  ["contextmenu", {}],
]) {
  canvas.fire(name, event);
  paint();
}
for (const id of ["above", "front", "side", "reset"]) {
  by(id).fire("click");
  paint();
}
for (const kind of ["views", "height", "rms"]) {
  by("colour").value = kind;
  by("colour").fire("change");
  said[kind] = [by("what").textContent, by("low").textContent, by("high").textContent];
  paint();
}
said.times = by("times").textContent;
for (const id of ["cameras", "path", "grid", "ellipsoids"]) by(id).checked = false;
by("grid").fire("change");
said.bare = paint();

said.axes = axesOf(0.3, 0.4);
const look = projector({ yaw: 0, pitch: 0, centre: [0, 0, 0], distance: 5 }, 800, 600);
said.places = [look([0, 0, 0]), look([1, 0, 0]), look([0, 0, 1]), look([0, 1, 0])];
said.cut = [segment(look, [0, 0, 0], [0, -20, 0]), segment(look, [0, -9, 0], [0, -20, 0])];
said.order = [...farToNear(new Float32Array([3, -1, 9, 5, 0.001]), 0.02).order];
said.ellipse = ellipseOf(3, 1, 2);
said.extremes = extremes([3, 1, 0.5, 2, 0.2, 1]);
console.log(JSON.stringify(said));
