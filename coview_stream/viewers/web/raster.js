// Picture of the map from above: the highest point of each cell, shaded as if lit from the north-west.

const MAX_SIDE = 2000; // cells
const LIGHT = [-0.5, 0.5, 0.707]; // towards the light: x east, y north, z up
const PALETTES = {
  light: { ground: [232, 235, 228], low: [176, 186, 194], high: [96, 108, 120], depth: 0.55 },
  dark: { ground: [38, 45, 50], low: [70, 84, 96], high: [150, 170, 188], depth: 0.6 },
};

// Returns {canvas, west, north, cell, bounds}: metres in the map's frame.
export function drawMap(map, theme) {
  const { points, step_m: step, origin, count, ground } = map;
  let [minX, minY, maxX, maxY] = [Infinity, Infinity, -Infinity, -Infinity];
  for (let k = 0; k < 3 * count; k += 3) {
    minX = Math.min(minX, points[k]); maxX = Math.max(maxX, points[k]);
    minY = Math.min(minY, points[k + 1]); maxY = Math.max(maxY, points[k + 1]);
  }
  const [width, height] = [(maxX - minX) * step, (maxY - minY) * step];
  const cell = Math.max(Math.max(width, height) / MAX_SIDE, 0.95 * Math.sqrt((width * height) / Math.max(count, 1)), 0.2);
  const [columns, rows] = [Math.ceil(width / cell) + 1, Math.ceil(height / cell) + 1];
  const top = new Float32Array(columns * rows).fill(NaN);
  const kind = new Uint8Array(columns * rows); // 0 nothing, 1 ground, 2 structure
  for (let n = 0; n < count; n++) {
    const column = Math.floor(((points[3 * n] - minX) * step) / cell);
    const row = Math.floor(((maxY - points[3 * n + 1]) * step) / cell);
    const at = row * columns + column;
    const z = points[3 * n + 2] * step;
    if (!(top[at] >= z)) {
      top[at] = z;
      kind[at] = n < ground ? 1 : 2;
    }
  }
  for (let pass = 0; pass < 2; pass++) fillHoles(top, kind, columns, rows);
  const floor = groundLevels(top, kind, columns, rows);
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [columns, rows];
  paint(canvas, top, kind, floor, cell, PALETTES[theme]);
  const [west, north] = [origin[0] + minX * step, origin[1] + maxY * step];
  return { canvas, west, north, cell, bounds: [west, north - height, west + width, north] };
}

function fillHoles(top, kind, columns, rows) {
  const found = [];
  for (let row = 1; row < rows - 1; row++) {
    for (let column = 1; column < columns - 1; column++) {
      const at = row * columns + column;
      if (kind[at]) continue;
      let [sum, known, structure] = [0, 0, 0];
      for (const offset of [-columns - 1, -columns, -columns + 1, -1, 1, columns - 1, columns, columns + 1]) {
        if (!kind[at + offset]) continue;
        sum += top[at + offset]; known++; structure += kind[at + offset] === 2;
      }
      if (known >= 3) found.push(at, sum / known, 2 * structure > known ? 2 : 1);
    }
  }
  for (let k = 0; k < found.length; k += 3) {
    top[found[k]] = found[k + 1];
    kind[found[k]] = found[k + 2];
  }
}

// Height of the ground in blocks of cells, taken from around where a block has none.
function groundLevels(top, kind, columns, rows) {
  const block = 16;
  const [across, down] = [Math.ceil(columns / block), Math.ceil(rows / block)];
  const level = new Float32Array(across * down).fill(NaN);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      const at = row * columns + column;
      const of = Math.floor(row / block) * across + Math.floor(column / block);
      if (kind[at] === 1 && !(level[of] <= top[at])) level[of] = top[at];
    }
  }
  for (let pass = 0; pass < across + down && level.some(Number.isNaN); pass++) {
    const before = level.slice();
    let filled = 0;
    for (let of = 0; of < level.length; of++) {
      if (!Number.isNaN(before[of])) continue;
      const near = [of - across, of + across, of % across ? of - 1 : -1, (of + 1) % across ? of + 1 : -1];
      const known = near.map((k) => before[k]).filter((z) => z !== undefined && !Number.isNaN(z));
      if (known.length) { level[of] = Math.min(...known); filled++; }
    }
    if (!filled) break;
  }
  return (row, column) => level[Math.floor(row / block) * across + Math.floor(column / block)];
}

function paint(canvas, top, kind, floor, cell, palette) {
  const [columns, rows] = [canvas.width, canvas.height];
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  const height = (at, other) => (kind[other] ? top[other] : top[at]);
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      const at = row * columns + column;
      if (!kind[at]) continue;
      const [left, right] = [column ? at - 1 : at, column < columns - 1 ? at + 1 : at];
      const [above, below] = [row ? at - columns : at, row < rows - 1 ? at + columns : at];
      const east = (height(at, right) - height(at, left)) / (2 * cell);
      const northward = (height(at, above) - height(at, below)) / (2 * cell);
      const steep = Math.hypot(east, northward, 1);
      const lit = (-east * LIGHT[0] - northward * LIGHT[1] + LIGHT[2]) / steep;
      const shade = 1 + palette.depth * (Math.max(-0.35, Math.min(1.2, lit)) - LIGHT[2]);
      let colour = palette.ground;
      if (kind[at] === 2) {
        const over = top[at] - floor(row, column);
        const share = Math.max(0, Math.min(1, (Number.isNaN(over) ? 4 : over) / 14));
        colour = palette.low.map((c, k) => c + (palette.high[k] - c) * share);
      }
      for (let k = 0; k < 3; k++) image.data[4 * at + k] = Math.max(0, Math.min(255, colour[k] * shade));
      image.data[4 * at + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
}
