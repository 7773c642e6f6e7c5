// One card for each robot: its state and why, its pose, how good it is, and how fast it comes.

const MAX_PLACES = 5;

export class Cards {
  constructor(parent, onFollow) {
    this.parent = parent;
    this.onFollow = onFollow;
    this.cards = new Map();
  }

  update(robots, now, follow) {
    for (const robot of [...robots.values()].sort((a, b) => a.name.localeCompare(b.name))) {
      let card = this.cards.get(robot.name);
      if (!card) {
        card = this.make(robot);
        this.cards.set(robot.name, card);
      }
      this.fill(card, robot, now, follow);
    }
  }

  make(robot) {
    const card = element("article", "card");
    card.setAttribute("aria-label", robot.name);
    const head = element("header");
    const name = element("h2");
    const swatch = element("i", "swatch");
    swatch.style.background = robot.colour;
    name.append(swatch, robot.name);
    const follow = element("button", "follow", "follow");
    follow.type = "button";
    follow.addEventListener("click", () => this.onFollow(robot.name));
    head.append(name, element("span", "state"), follow);
    const figure = element("figure", "body-scan");
    figure.append(element("canvas"), element("figcaption", "", "newest scan in the robot's own frame"));
    card.append(head, element("p", "reason"), element("dl"), element("ol", "places"), figure, element("ul", "notes"));
    this.parent.append(card);
    return card;
  }

  fill(card, robot, now, follow) {
    const { status, pose } = robot;
    const state = robot.state(now);
    card.dataset.state = state;
    text(card.querySelector(".state"), state === "silent" ? `silent for ${Math.round((now - robot.heard) / 1000)} s` : state);
    text(card.querySelector(".reason"), status.reason || "");
    card.querySelector(".follow").setAttribute("aria-pressed", String(follow === robot.name));
    const located = robot.located(now);
    rows(card.querySelector("dl"), [
      ...(located ? poseRows(pose) : []),
      ...(located ? [["rate, age", `${robot.rate(now).toFixed(1)} Hz, ${number(pose.age_s, 2, " s")}`]] : []),
      ["frame to fix", `p50 ${number(status.latency_ms?.p50, 0)}, p99 ${number(status.latency_ms?.p99, 0, " ms")}`],
      ["frames", `${number(status.counters?.received, 0)} received, ${number(status.counters?.dropped, 0)} dropped`],
    ]);
    places(card.querySelector(".places"), robot, located);
    const figure = card.querySelector(".body-scan");
    figure.hidden = located || !robot.scan || robot.scan.in_map || now - robot.scanAt > 3000;
    if (!figure.hidden) drawBodyScan(figure.querySelector("canvas"), robot.scan);
    list(card.querySelector(".notes"), [...(status.says || []), ...(status.errors || [])]);
  }
}

function poseRows(pose) {
  const sigma = pose.sigma;
  const protection = pose.protection;
  const found = [
    ["x, y, z", `${pose.x.toFixed(2)}, ${pose.y.toFixed(2)}, ${pose.z.toFixed(2)} m`],
    ["heading", `${((pose.yaw * 180) / Math.PI).toFixed(1)}\u00b0 from east`],
  ];
  if (protection) found.push(["protection", `${number(protection.m, 2, " m")}, ${number(protection.deg, 2, "\u00b0")}`]);
  if (sigma) found.push(["one sigma", `${sigma.slice(0, 3).map((s) => (100 * s).toFixed(1)).join(", ")} cm`]);
  if (pose.confidence !== null) found.push(["wrong place", odds(1 - pose.confidence)]);
  return found;
}

function odds(wrong) {
  if (wrong < 1e-6) return "less than 1 in 1,000,000";
  return wrong < 0.5 ? `1 in ${round2(1 / wrong).toLocaleString("en")}` : "likely";
}

function round2(value) {
  const power = 10 ** Math.max(0, Math.floor(Math.log10(value)) - 1);
  return Math.round(value / power) * power;
}

function places(parent, robot, located) {
  const found = located || !robot.hypotheses ? [] : robot.hypotheses.places.slice(0, MAX_PLACES);
  const wanted = found.map((place) => [share(place.probability), place.probability, `${place.x.toFixed(0)}, ${place.y.toFixed(0)}`]);
  if (found.length) wanted.push([share(robot.hypotheses.none), robot.hypotheses.none, "none of them"]);
  while (parent.children.length > wanted.length) parent.lastChild.remove();
  wanted.forEach(([told, value, where], k) => {
    let item = parent.children[k];
    if (!item) {
      item = element("li");
      const meter = element("meter");
      [meter.min, meter.max] = [0, 1];
      item.append(element("span"), meter, element("span"));
      parent.append(item);
    }
    text(item.children[0], told);
    item.children[1].value = value ?? 0;
    item.children[1].setAttribute("aria-label", `probability of ${where}`);
    text(item.children[2], where);
  });
}

function share(value) {
  if (value === null || value === undefined) return "-";
  return value >= 0.001 ? `${(100 * value).toFixed(1)} %` : "< 0.1 %";
}

function drawBodyScan(canvas, scan) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  const style = getComputedStyle(document.documentElement);
  context.clearRect(0, 0, width, height);
  context.fillStyle = style.getPropertyValue("--scan");
  const reaches = [];
  for (let k = 0; k < scan.points.length; k += 3) reaches.push(Math.hypot(scan.points[k], scan.points[k + 1]));
  const reach = reaches.sort((a, b) => a - b)[Math.floor(0.9 * reaches.length)] || 1;
  const scale = Math.min(height / 2.1 / reach, height * scan.step / 20); // most of it, and 20 m at least
  for (let k = 0; k < scan.points.length; k += 3) {
    context.fillRect(width / 2 + scan.points[k] * scale, height / 2 - scan.points[k + 1] * scale, 1.3, 1.3);
  }
  context.fillStyle = style.getPropertyValue("--ink");
  context.beginPath();
  context.moveTo(width / 2 + 7, height / 2);
  context.lineTo(width / 2 - 5, height / 2 + 5);
  context.lineTo(width / 2 - 5, height / 2 - 5);
  context.fill();
}

function rows(parent, wanted) {
  while (parent.children.length > 2 * wanted.length) parent.lastChild.remove();
  wanted.forEach(([name, value], k) => {
    if (!parent.children[2 * k]) parent.append(element("dt"), element("dd"));
    text(parent.children[2 * k], name);
    text(parent.children[2 * k + 1], value);
  });
}

function list(parent, wanted) {
  while (parent.children.length > wanted.length) parent.lastChild.remove();
  wanted.forEach((each, k) => {
    if (!parent.children[k]) parent.append(element("li"));
    text(parent.children[k], each);
  });
}

function element(name, className = "", content = "") {
  const found = document.createElement(name);
  if (className) found.className = className;
  if (content) found.textContent = content;
  return found;
}

// Nothing is touched that is the same: screen readers and selections stay where they are.
function text(node, content) {
  if (node.textContent !== content) node.textContent = content;
}

function number(value, digits, unit = "") {
  return typeof value === "number" && Number.isFinite(value) ? value.toFixed(digits) + unit : "-";
}
