// The attitude as a block on a compass.

import { COLORS } from "./plots.js";
import { cleared, el } from "./util.js";

const BLOCK_SIZE = 300;
const BODY = [1.0, 0.7, 0.18]; // half edges along x, y, z of the device
const CAMERA = { azimuth: -2.3, elevation: 0.5 }; // view from the south-west, from above
const GROUND = -1.6; // height of the compass
const QUARTERS = [["E", 1, 0], ["N", 0, 1], ["W", -1, 0], ["S", 0, -1]];
const DEGREES = { E: "0°", N: "90°", W: "180°", S: "−90°" }; // names without a compass heading
const GRAVITY_M_S2 = 9.80665;
const FACES = [[0, 1], [0, -1], [1, 1], [1, -1], [2, 1], [2, -1]];

/** Rotate a vector by a quaternion [w, x, y, z]. */
export function rotate([w, x, y, z], [a, b, c]) {
  const [u, v, t] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
  return [a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u];
}

/** Return what an accelerometer at rest measures with this attitude, in the axes of the device. */
export function gravityOf([w, x, y, z], frame) {
  return rotate([w, -x, -y, -z], [0, 0, frame.startsWith("NED") ? -GRAVITY_M_S2 : GRAVITY_M_S2]);
}

export class AttitudeView {
  constructor() {
    this.canvas = el("canvas", { class: "block", role: "img", "aria-label": "attitude of the device" });
    this.frame = "ENU";
    this.isCompass = false; // whether yaw is a compass heading
    this.quaternion = null;
  }

  /** frame: the navigation frame of the quaternion (member of `status`). */
  set(quaternion, frame) {
    this.frame = frame.slice(0, 3);
    this.quaternion = quaternion;
    this.draw();
  }

  /** Remove the block: the attitude is not known now. */
  clear() {
    if (!this.quaternion) return;
    this.quaternion = null;
    this.draw();
  }

  /** Return a vector of the device in east, north, up. */
  toEnu(vector) {
    const [a, b, c] = rotate(this.quaternion, vector);
    if (this.frame === "NED") return [b, a, -c];
    return this.frame === "NWU" ? [-b, a, c] : [a, b, c];
  }

  /** Return the position on the canvas of east, north, up: x, y, and depth (larger is nearer). */
  project([e, n, u]) {
    const { azimuth, elevation } = CAMERA;
    const right = e * -Math.sin(azimuth) + n * Math.cos(azimuth);
    const away = e * -Math.cos(azimuth) + n * -Math.sin(azimuth);
    const up = u * Math.cos(elevation) + away * Math.sin(elevation);
    const near = u * Math.sin(elevation) - away * Math.cos(elevation);
    const scale = (BLOCK_SIZE * 0.225) / (1 - near * 0.12);
    return [BLOCK_SIZE / 2 + right * scale, BLOCK_SIZE * 0.41 - up * scale, near];
  }

  draw() {
    const context = cleared(this.canvas, BLOCK_SIZE);
    const style = getComputedStyle(this.canvas);
    context.font = "13px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineJoin = context.lineCap = "round"; // otherwise the corner of a thin face has a long spike
    this.drawCompass(context, style);
    if (this.quaternion) {
      this.drawAxes(context, false); // axes that point away are behind the block
      this.drawBody(context, style);
      this.drawAxes(context, true);
    }
    this.drawNames(context, style);
  }

  drawNames(context, style) {
    const quiet = style.getPropertyValue("--mute");
    const names = QUARTERS.map(([name, e, n]) => [this.isCompass ? name : DEGREES[name], quiet, [1.85 * e, 1.85 * n, GROUND]]);
    if (this.quaternion) names.push(...this.axes().map(({ colour, name, end }) => [name, colour, end.map((one) => one * 1.12)]));
    context.strokeStyle = style.getPropertyValue("--card");
    context.lineWidth = 4;
    for (const [name, colour, place] of names) {
      const at = this.project(place).slice(0, 2);
      context.fillStyle = colour;
      context.strokeText(name, ...at);
      context.fillText(name, ...at);
    }
  }

  drawCompass(context, style) {
    context.strokeStyle = style.getPropertyValue("--line");
    context.lineWidth = 1;
    for (const radius of [0.8, 1.6]) {
      context.beginPath();
      for (let step = 0; step <= 60; step += 1) {
        const angle = (step / 30) * Math.PI;
        context.lineTo(...this.project([radius * Math.cos(angle), radius * Math.sin(angle), GROUND]).slice(0, 2));
      }
      context.stroke();
    }
    for (const [, e, n] of QUARTERS) this.line(context, [0, 0, GROUND], [1.6 * e, 1.6 * n, GROUND]);
  }

  drawBody(context, style) {
    const faces = FACES.map(([axis, side]) => {
      const [p, q] = [(axis + 1) % 3, (axis + 2) % 3];
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => {
        const corner = [0, 0, 0];
        corner[axis] = side * BODY[axis];
        corner[p] = a * BODY[p];
        corner[q] = b * BODY[q];
        return this.project(this.toEnu(corner));
      });
      const middle = [0, 0, 0];
      middle[axis] = side;
      const light = this.toEnu(middle)[2];
      return { corners, light, near: corners.reduce((sum, corner) => sum + corner[2], 0) };
    });
    faces.sort((a, b) => a.near - b.near);
    context.strokeStyle = style.getPropertyValue("--ink");
    context.lineWidth = 2;
    for (const { corners, light } of faces) {
      context.fillStyle = `hsl(212 38% ${Math.round(52 + 20 * light)}%)`;
      context.beginPath();
      corners.forEach(([x, y]) => context.lineTo(x, y));
      context.closePath();
      context.fill();
      context.stroke();
    }
  }

  axes() {
    return COLORS.map((colorOf, axis) => {
      const end = [0, 0, 0];
      end[axis] = 1.5;
      const start = [0, 0, 0];
      start[axis] = BODY[axis];
      return { colour: colorOf(), name: "xyz"[axis], start: this.toEnu(start), end: this.toEnu(end) };
    });
  }

  drawAxes(context, isNear) {
    context.lineWidth = 3;
    for (const { colour, start, end } of this.axes()) {
      if (this.project(end)[2] > 0 !== isNear) continue;
      context.strokeStyle = colour;
      this.line(context, start, end);
    }
  }

  line(context, from, to) {
    context.beginPath();
    context.moveTo(...this.project(from).slice(0, 2));
    context.lineTo(...this.project(to).slice(0, 2));
    context.stroke();
  }
}
