// What is known of the robots and the map, by the events of the node. No drawing here.

const GAP_M = 0.25; // metres between points of a trail
const TRAIL = 4000; // points of a trail
const WINDOW_MS = 5000; // over which the rate of poses is measured
export const STALE_MS = 2000; // without a pose: the last one is only where the robot was
export const SILENT_MS = 5000; // without any message: a node sends one every second
const GROUND_M = 0.6; // metres above the lowest points of a scan: its ground, which is drawn fainter
const TRAIL_COLOURS = ["#0072B2", "#CC79A7", "#009E73", "#D55E00", "#E69F00", "#56B4E9", "#8C6BB1", "#7F7F00"];

export class Robot {
  constructor(name, number) {
    this.name = name;
    this.colour = TRAIL_COLOURS[number % TRAIL_COLOURS.length];
    this.pose = null;
    this.poseAt = -Infinity;
    this.status = {};
    this.statusAt = -Infinity;
    this.hypotheses = null;
    this.scan = null;
    this.scanAt = -Infinity;
    this.trail = [];
    this.arrivals = [];
    this.heard = -Infinity;
  }

  // The state in words; of a robot of which nothing comes: silent.
  state(now) {
    if (now - this.heard > SILENT_MS) return "silent";
    const told = this.status.state;
    if (this.poseAt > this.statusAt && now - this.poseAt < STALE_MS) return "TRACKING";
    return told || (this.pose ? "TRACKING" : "SEARCHING");
  }

  // Whether the pose holds now.
  located(now) {
    return this.pose !== null && now - this.poseAt < STALE_MS && this.state(now) === "TRACKING";
  }

  rate(now) {
    while (this.arrivals.length && this.arrivals[0] < now - WINDOW_MS) this.arrivals.shift();
    const span = now - this.arrivals[0];
    return this.arrivals.length > 1 && span > 0 ? (1000 * (this.arrivals.length - 1)) / span : 0;
  }

  extendTrail(x, y, interrupted) {
    const last = this.trail[this.trail.length - 1];
    if (interrupted && last) this.trail.push(null);
    if (!last || interrupted || Math.hypot(x - last[0], y - last[1]) >= GAP_M) this.trail.push([x, y]);
    if (this.trail.length > TRAIL) this.trail.splice(0, this.trail.length - TRAIL);
  }
}

export class Session {
  constructor() {
    this.robots = new Map();
    this.maps = new Map(); // sha256 -> {map, raster by theme}
    this.changed = true; // since the last picture
  }

  robot(name) {
    let found = this.robots.get(name);
    if (!found) {
      found = new Robot(name, this.robots.size);
      this.robots.set(name, found);
    }
    return found;
  }

  take(kind, data, now) {
    this.changed = true;
    if (kind === "trail") {
      this.robot(data.robot).trail = data.points;
      return;
    }
    const robot = this.robot(data.robot);
    if (kind !== "scan") robot.heard = now;
    if (kind === "pose") {
      robot.extendTrail(data.x, data.y, robot.pose !== null && now - robot.poseAt > STALE_MS);
      robot.pose = data;
      robot.poseAt = now;
      robot.arrivals.push(now);
      robot.hypotheses = null;
    } else if (kind === "status") {
      robot.status = data;
      robot.statusAt = now;
      if (data.state === "TRACKING") robot.hypotheses = null;
    } else if (kind === "hypotheses") {
      robot.hypotheses = robot.located(now) ? null : data;
    } else if (kind === "scan") {
      const points = unpack(data.points);
      robot.scan = { ...data, points, low: lowest(points) + GROUND_M / data.step };
      robot.scanAt = now;
    }
  }
}

// Height below which a twentieth of a scan's points lie, in its steps.
function lowest(points) {
  const heights = [];
  for (let k = 2; k < points.length; k += 3) heights.push(points[k]);
  return heights.sort((a, b) => a - b)[Math.floor(0.05 * heights.length)] ?? 0;
}

// base64 of little-endian int16 -> Int16Array
function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  return Int16Array.from({ length: bytes.length >> 1 }, (_, k) => view.getInt16(2 * k, true));
}

// The map as the node packs it: length of the header, header, points.
export function readMap(buffer) {
  const view = new DataView(buffer);
  const length = view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const points = new Int16Array(buffer, 4 + length, 3 * header.count);
  return { ...header, points };
}
