// The canvas: the map from above, north up, and what is drawn on it; pan and zoom.

import { drawMap } from "./raster.js";

const MIN_SCALE = 0.05; // pixels per metre
const MAX_SCALE = 2000;
const ROBOT_SIZE = 13; // pixels
const SCAN_MAX_AGE_MS = 3000;

export class View {
  constructor(canvas, session) {
    this.canvas = canvas;
    this.session = session;
    this.camera = { x: 0, y: 0, scale: 4 };
    this.placed = false; // whether the camera has been put somewhere
    this.follow = null; // name of a robot
    this.show = { scan: true, trail: true, hypotheses: true };
    this.theme = "light";
    this.cursor = null;
    this.listen();
  }

  // ---- coordinates

  toScreen(x, y) {
    const { width, height } = this.size;
    return [width / 2 + (x - this.camera.x) * this.camera.scale, height / 2 - (y - this.camera.y) * this.camera.scale];
  }

  toMap(px, py) {
    const { width, height } = this.size;
    return [this.camera.x + (px - width / 2) / this.camera.scale, this.camera.y - (py - height / 2) / this.camera.scale];
  }

  get size() {
    return { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
  }

  // ---- moving about

  fit(bounds) {
    const { width, height } = this.size;
    const [west, south, east, north] = bounds;
    const scale = 0.94 * Math.min(width / Math.max(east - west, 1), height / Math.max(north - south, 1));
    this.camera = { x: (west + east) / 2, y: (south + north) / 2, scale: clamp(scale) };
    this.placed = true;
    this.session.changed = true;
  }

  fitAll() {
    const entry = this.map();
    if (entry) this.fit(this.raster(entry).bounds);
    else {
      const poses = [...this.session.robots.values()].map((robot) => robot.pose).filter(Boolean);
      if (poses.length) {
        const [xs, ys] = [poses.map((p) => p.x), poses.map((p) => p.y)];
        this.fit([Math.min(...xs) - 30, Math.min(...ys) - 30, Math.max(...xs) + 30, Math.max(...ys) + 30]);
      }
    }
  }

  zoom(factor, px = this.size.width / 2, py = this.size.height / 2) {
    const [x, y] = this.toMap(px, py);
    this.camera.scale = clamp(this.camera.scale * factor);
    if (this.follow === null) {
      const [nx, ny] = this.toMap(px, py);
      this.camera.x += x - nx;
      this.camera.y += y - ny;
    }
    this.session.changed = true;
  }

  pan(dx, dy) {
    this.camera.x -= dx / this.camera.scale;
    this.camera.y += dy / this.camera.scale;
    this.session.changed = true;
  }

  listen() {
    const canvas = this.canvas;
    const held = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      held.set(event.pointerId, [event.offsetX, event.offsetY]);
      canvas.classList.add("held");
    });
    canvas.addEventListener("pointermove", (event) => {
      this.cursor = [event.offsetX, event.offsetY];
      this.session.changed = true;
      const before = held.get(event.pointerId);
      if (!before) return;
      const other = [...held].find(([id]) => id !== event.pointerId);
      const now = [event.offsetX, event.offsetY];
      if (other) {
        const apart = (at) => Math.hypot(at[0] - other[1][0], at[1] - other[1][1]);
        this.zoom(apart(now) / Math.max(apart(before), 1), other[1][0], other[1][1]);
      } else if (now[0] !== before[0] || now[1] !== before[1]) {
        this.setFollow(null);
        this.pan(now[0] - before[0], now[1] - before[1]);
      }
      held.set(event.pointerId, now);
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        held.delete(event.pointerId);
        if (!held.size) canvas.classList.remove("held");
      });
    }
    canvas.addEventListener("pointerleave", () => { this.cursor = null; this.session.changed = true; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-Math.max(-240, Math.min(240, event.deltaY)) / 400), event.offsetX, event.offsetY);
    }, { passive: false });
    new ResizeObserver(() => { this.session.changed = true; }).observe(canvas);
  }

  setFollow(name) {
    if (this.follow !== name) {
      this.follow = name;
      this.onFollow?.(name);
      this.session.changed = true;
    }
  }

  // ---- the map

  // That of the robot that is followed, else of any robot, else the newest.
  map() {
    const { maps, robots } = this.session;
    const wanted = [robots.get(this.follow), ...robots.values()].map((robot) => robot?.status.map_sha256);
    return maps.get(wanted.find((sha256) => maps.has(sha256))) || [...maps.values()].pop();
  }

  raster(entry) {
    entry.rasters ??= {};
    return (entry.rasters[this.theme] ??= drawMap(entry.map, this.theme));
  }

  // ---- drawing

  draw(now) {
    const { width, height } = this.size;
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== w || this.canvas.height !== h) [this.canvas.width, this.canvas.height] = [w, h];
    const context = this.canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    this.colours = colours();
    const followed = this.session.robots.get(this.follow);
    if (followed?.pose) [this.camera.x, this.camera.y] = [followed.pose.x, followed.pose.y];
    this.drawBase(context);
    const robots = [...this.session.robots.values()];
    if (this.show.trail) for (const robot of robots) this.drawTrail(context, robot, now);
    if (this.show.scan) for (const robot of robots) this.drawScan(context, robot, now);
    if (this.show.hypotheses) for (const robot of robots) this.drawHypotheses(context, robot, now);
    const drawn = {};
    for (const robot of robots) {
      const at = this.drawRobot(context, robot, now);
      if (at) drawn[robot.name] = [Math.round(at[0] * ratio), Math.round(at[1] * ratio), robot.state(now)];
    }
    this.drawScale(context, width, height);
    this.canvas.dataset.drawn = JSON.stringify(drawn);
  }

  drawBase(context) {
    const entry = this.map();
    if (!entry) return;
    const { canvas, west, north, cell } = this.raster(entry);
    const [px, py] = this.toScreen(west, north);
    const scale = cell * this.camera.scale;
    context.imageSmoothingQuality = "high";
    context.drawImage(canvas, px, py, canvas.width * scale, canvas.height * scale);
  }

  drawTrail(context, robot, now) {
    context.beginPath();
    let down = false;
    for (const point of robot.trail) {
      if (!point) { down = false; continue; }
      const [px, py] = this.toScreen(point[0], point[1]);
      if (down) context.lineTo(px, py); else context.moveTo(px, py);
      down = true;
    }
    if (down && robot.located(now)) context.lineTo(...this.toScreen(robot.pose.x, robot.pose.y));
    context.strokeStyle = robot.colour;
    context.lineWidth = 3;
    context.lineJoin = context.lineCap = "round";
    context.globalAlpha = 0.85;
    context.stroke();
    context.globalAlpha = 1;
  }

  drawScan(context, robot, now) {
    const scan = robot.scan;
    if (!scan?.in_map || now - robot.scanAt > SCAN_MAX_AGE_MS) return;
    context.fillStyle = this.colours.scan;
    const [cx, cy] = this.toScreen(scan.centre[0], scan.centre[1]);
    const step = scan.step * this.camera.scale;
    const size = Math.max(2, Math.min(4, 0.1 * this.camera.scale));
    for (const ground of [true, false]) { // what stands is what the robot is found by: on top, and larger
      const side = ground ? 0.6 * size : size;
      context.globalAlpha = ground ? 0.35 : 1;
      for (let k = 0; k < scan.points.length; k += 3) {
        if (scan.points[k + 2] < scan.low !== ground) continue;
        context.fillRect(cx + scan.points[k] * step - side / 2, cy - scan.points[k + 1] * step - side / 2, side, side);
      }
    }
    context.globalAlpha = 1;
  }

  drawHypotheses(context, robot, now) {
    if (!robot.hypotheses || robot.located(now)) return;
    const colour = this.colours[robot.state(now)] || this.colours.SEARCHING;
    const places = robot.hypotheses.places.map((place) => [place, ...this.toScreen(place.x, place.y)]);
    for (const [place, px, py] of [...places].reverse()) { // the most probable on top
      const radius = 5 + 13 * Math.sqrt(place.probability);
      context.globalAlpha = 0.35 + 0.6 * Math.sqrt(place.probability);
      disc(context, px, py, radius, colour, this.colours.card);
      line(context, px, py, px + 1.9 * radius * Math.cos(place.yaw), py - 1.9 * radius * Math.sin(place.yaw), colour);
    }
    context.globalAlpha = 1;
    const labelled = [];
    for (const [place, px, py] of places) {
      if (place.probability < 0.05 || labelled.some(([qx, qy]) => Math.hypot(px - qx, py - qy) < 50)) continue;
      labelled.push([px, py]);
      this.label(context, `${Math.round(100 * place.probability)} %`, px + 24, py + 5);
    }
  }

  // Returns where the robot was drawn, pixels.
  drawRobot(context, robot, now) {
    const pose = robot.pose;
    if (!pose) return null;
    const located = robot.located(now);
    const [px, py] = this.toScreen(pose.x, pose.y);
    const colour = located ? this.colours.TRACKING : this.colours[robot.state(now)] || this.colours.silent;
    if (located && pose.protection) ring(context, px, py, pose.protection.horizontal_m * this.camera.scale, colour);
    context.save();
    context.translate(px, py);
    context.rotate(-pose.yaw);
    context.globalAlpha = located ? 1 : 0.75;
    context.beginPath();
    const s = ROBOT_SIZE;
    context.moveTo(s, 0); context.lineTo(-0.8 * s, 0.68 * s); context.lineTo(-0.4 * s, 0); context.lineTo(-0.8 * s, -0.68 * s);
    context.closePath();
    context.lineWidth = 2;
    context.strokeStyle = located ? this.colours.card : colour;
    context.fillStyle = located ? colour : this.colours.card;
    context.fill();
    context.stroke();
    context.restore();
    if (located && pose.cov) ellipse(context, px, py, pose.cov, this.camera.scale, colour);
    this.label(context, located ? robot.name : `${robot.name}: last known`, px + s + 6, py - 8);
    return [px, py];
  }

  label(context, text, px, py) {
    context.font = "600 13px system-ui, 'DejaVu Sans', sans-serif";
    context.lineWidth = 4;
    context.lineJoin = "round";
    context.strokeStyle = this.colours.card;
    context.strokeText(text, px, py);
    context.fillStyle = this.colours.ink;
    context.fillText(text, px, py);
  }

  drawScale(context, width, height) {
    const metres = round125(110 / this.camera.scale);
    const length = metres * this.camera.scale;
    const [px, py] = [16, height - 18];
    context.strokeStyle = context.fillStyle = this.colours.ink;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(px, py - 6); context.lineTo(px, py); context.lineTo(px + length, py); context.lineTo(px + length, py - 6);
    context.stroke();
    this.label(context, metres >= 1 ? `${metres} m` : `${Math.round(100 * metres)} cm`, px + length + 8, py + 2);
  }
}

function disc(context, px, py, radius, fill, edge) {
  context.beginPath();
  context.arc(px, py, radius, 0, 2 * Math.PI);
  context.fillStyle = fill;
  context.fill();
  context.lineWidth = 1.5;
  context.strokeStyle = edge;
  context.stroke();
}

function line(context, px, py, qx, qy, colour) {
  context.beginPath();
  context.moveTo(px, py); context.lineTo(qx, qy);
  context.lineWidth = 3;
  context.strokeStyle = colour;
  context.stroke();
}

function ring(context, px, py, radius, colour) {
  context.beginPath();
  context.arc(px, py, Math.max(radius, 1), 0, 2 * Math.PI);
  context.setLineDash([6, 4]);
  context.lineWidth = 1.5;
  context.strokeStyle = colour;
  context.stroke();
  context.setLineDash([]);
}

// Three sigma of a covariance [xx, xy, yy], m2.
function ellipse(context, px, py, [xx, xy, yy], scale, colour) {
  const middle = (xx + yy) / 2;
  const off = Math.hypot((xx - yy) / 2, xy);
  const [major, minor] = [middle + off, Math.max(middle - off, 0)].map((v) => 3 * Math.sqrt(v) * scale);
  context.beginPath();
  context.ellipse(px, py, Math.max(major, 0.5), Math.max(minor, 0.5), -0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
  context.lineWidth = 1.5;
  context.strokeStyle = colour;
  context.globalAlpha = 0.3;
  context.fillStyle = colour;
  context.fill();
  context.globalAlpha = 1;
  context.stroke();
}

function colours() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    TRACKING: of("tracking"), AMBIGUOUS: of("ambiguous"), SEARCHING: of("searching"), LOST: of("lost"),
    silent: of("silent"), card: of("card"), ink: of("ink"), scan: of("scan"),
  };
}

function clamp(scale) {
  return Math.max(MIN_SCALE, Math.min(MAX_SCALE, scale));
}

function round125(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].filter((k) => k * power <= value * 1.0001).pop();
}
