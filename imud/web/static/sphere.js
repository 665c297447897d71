// Sphere of a calibration: 48 cells of equal area. A cell is a sixth of an octant, by the order of |x|, |y|, |z|.

import { rotate } from "./attitude.js";
import { cleared, el } from "./util.js";

const SIZE = 240;
const RADIUS = SIZE * 0.4;
const TILT = [0.4508, 0.0999, 0.1919, -0.866]; // −125° about z, then 25° about the horizontal axis: x, y and z point to the front
const ORDERS = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
const SIZES = [0.85, 0.48, 0.2];
const NONE = 255;
const CIRCLE_STEPS = 90;
const NEAR_OPACITY = 220; // of 255
const FAR_OPACITY = 60;
const NEXT_OPACITY = 200;

/** Return the center of cell 0 … 47: the octant by signs (bit 0: x < 0), then the order of the absolute values. */
export function cellDirection(cell) {
  const octant = Math.floor(cell / ORDERS.length);
  const direction = [0, 0, 0];
  ORDERS[cell % ORDERS.length].forEach((axis, rank) => (direction[axis] = (octant >> axis) & 1 ? -SIZES[rank] : SIZES[rank]));
  return direction;
}

/** Return the cells in a mask of 48 bits in hexadecimal. */
export function coveredCells(mask) {
  const bits = BigInt(`0x${mask || "0"}`);
  return Array.from({ length: 48 }, (_, cell) => Boolean((bits >> BigInt(cell)) & 1n));
}

/** Return the cell of a direction. */
export function cellOf(direction) {
  const octant = direction.reduce((bits, value, axis) => bits | ((value < 0) << axis), 0);
  const sizes = direction.map(Math.abs);
  const order = ORDERS.findIndex(([a, b, c]) => sizes[a] >= sizes[b] && sizes[b] >= sizes[c]);
  return octant * ORDERS.length + order;
}

/** Return a direction on the canvas: x, y, and depth (larger is nearer). */
export function onSphere(direction) {
  const [x, away, z] = rotate(TILT, direction);
  return [SIZE / 2 + x * RADIUS, SIZE / 2 - z * RADIUS, -away];
}

/** Return the front cell and the back cell of each pixel; NONE outside of the sphere. */
function cellMap(pixels) {
  const back = [TILT[0], -TILT[1], -TILT[2], -TILT[3]];
  const near = new Uint8Array(pixels * pixels).fill(NONE);
  const far = new Uint8Array(pixels * pixels).fill(NONE);
  const scale = pixels / SIZE;
  for (let index = 0; index < near.length; index += 1) {
    const x = (((index % pixels) + 0.5) / scale - SIZE / 2) / RADIUS;
    const z = (SIZE / 2 - (Math.floor(index / pixels) + 0.5) / scale) / RADIUS;
    const depth = Math.sqrt(1 - x * x - z * z);
    if (!(depth >= 0)) continue;
    near[index] = cellOf(rotate(back, [x, -depth, z]));
    far[index] = cellOf(rotate(back, [x, depth, z]));
  }
  return { pixels, near, far };
}

/** Return the great circles between the cells, in pieces. */
function edges() {
  const pieces = [];
  for (const normal of [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1], [0, 1, -1]]) {
    const length = Math.hypot(...normal);
    const [a, b, c] = normal.map((value) => value / length);
    const u = Math.abs(c) < 0.9 ? [b, -a, 0] : [1, 0, 0];
    const size = Math.hypot(...u);
    const [p, q] = [u[0] / size, u[1] / size];
    const v = [-c * q, c * p, a * q - b * p];
    pieces.push(Array.from({ length: CIRCLE_STEPS + 1 }, (_, step) => {
      const angle = (step / CIRCLE_STEPS) * 2 * Math.PI;
      const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
      return onSphere([p * cos + v[0] * sin, q * cos + v[1] * sin, v[2] * sin]);
    }));
  }
  return pieces;
}

export class CoverageSphere {
  constructor() {
    this.canvas = el("canvas", { class: "sphere", role: "img", "aria-label": "covered directions" });
    this.edges = edges();
    this.draw("0");
  }

  draw(mask, next = []) {
    const covered = coveredCells(mask);
    this.canvas.dataset.covered = covered.filter(Boolean).length;
    const context = cleared(this.canvas, SIZE);
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name) || "#888";
    if (this.map?.pixels !== this.canvas.width) this.map = cellMap(this.canvas.width);
    context.putImageData(this.filled(context, covered, next, colour("--ok"), colour("--accent")), 0, 0);
    context.strokeStyle = colour("--faint");
    context.lineWidth = 1;
    context.beginPath();
    for (const circle of this.edges) {
      circle.forEach(([x, y, near], step) => {
        if (near >= 0 && step && circle[step - 1][2] >= 0) context.lineTo(x, y);
        else context.moveTo(x, y);
      });
    }
    context.stroke();
    context.lineWidth = 2;
    context.beginPath();
    context.arc(SIZE / 2, SIZE / 2, RADIUS, 0, 2 * Math.PI);
    context.stroke();
    context.fillStyle = colour("--ink");
    context.font = "13px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const [axis, name] of ["x", "y", "z"].entries()) {
      const direction = [0, 0, 0];
      direction[axis] = 1.14;
      context.fillText(name, ...onSphere(direction).slice(0, 2));
    }
  }

  filled(context, covered, next, colour, nextColour) {
    const { pixels, near, far } = this.map;
    const image = context.createImageData(pixels, pixels);
    const [done, wanted] = [colour, nextColour].map((one) => {
      context.fillStyle = one;
      return [1, 3, 5].map((at) => parseInt(context.fillStyle.slice(at, at + 2), 16)); // format of the canvas: "#rrggbb"
    });
    for (let index = 0; index < near.length; index += 1) {
      if (near[index] === NONE) continue;
      const opacity = covered[near[index]] ? NEAR_OPACITY : covered[far[index]] ? FAR_OPACITY : 0;
      if (opacity) image.data.set([...done, opacity], 4 * index);
      if (next.includes(near[index])) image.data.set([...wanted, NEXT_OPACITY], 4 * index);
    }
    return image;
  }
}
