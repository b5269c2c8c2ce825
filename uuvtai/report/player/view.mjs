// Places: from the world [m] to the pixels of a canvas, and the shapes of what is drawn there.

const LEAST_M = 1.5; // of a window

/** Where the tank, or a window of it around a place, is drawn: from above, and below that from the side. */
export class View {
  /** `zoom`: x, y [m] in the middle of a window so many metres wide, null = the whole tank. `bare`: from above and without a ruler. */
  constructor(tank, width, zoom, bare = false) {
    const [x, y, z] = [tank.x_m, tank.y_m, tank.z_m];
    this.star = bare ? 6 : 11; // [px]
    this.left = bare ? 3 : 34;
    this.top = bare ? 3 : 14;
    const across = width - this.left - (bare ? 3 : 12);
    const most = Math.max(260, Math.min(0.62 * width, 560));
    this.scale = zoom ? across / zoom.metres : Math.min(across / (x[1] - x[0]), most / (y[1] - y[0]));
    this.high = zoom ? Math.min(most, (y[1] - y[0]) * this.scale) : (y[1] - y[0]) * this.scale;
    this.wide = Math.min(across, (x[1] - x[0]) * this.scale);
    this.left += 0.5 * (across - this.wide);
    this.x0 = zoom ? within(zoom.x - 0.5 * (this.wide / this.scale), x[0], x[1] - this.wide / this.scale) : x[0];
    this.y1 = zoom ? within(zoom.y + 0.5 * (this.high / this.scale), y[0] + this.high / this.scale, y[1]) : y[1];
    this.z = z;
    this.deep = Math.min(Math.max((z[1] - z[0]) * this.scale, 64), 150);
    this.side = this.top + this.high + 40;
    this.width = width;
    this.height = bare ? this.top + this.high + 3 : this.side + this.deep + 26;
  }

  x(x) {
    return this.left + (x - this.x0) * this.scale;
  }

  y(y) {
    return this.top + (this.y1 - y) * this.scale;
  }

  /** [x, y] in the world of a pixel. */
  world({ x, y }) {
    return [this.x0 + (x - this.left) / this.scale, this.y1 - (y - this.top) / this.scale];
  }

  /** The zoom of a view so many times as large, in which what is at pixel `from` here is at `to`; null = the whole tank. */
  zoomed(tank, factor, from, to) {
    const metres = Math.max((this.width - 46) / (this.scale * factor), LEAST_M);
    const next = (x, y) => new View(tank, this.width, { x, y, metres });
    if (next(0, 0).scale <= new View(tank, this.width, null).scale) return null;
    const [x, y] = this.world(from);
    const trial = next(x, y);
    const [u, v] = trial.world(to);
    return { x: trial.x0 + 0.5 * (trial.wide / trial.scale) + x - u, y: trial.y1 - 0.5 * (trial.high / trial.scale) + y - v, metres };
  }

  /** Of a height, in the view from the side. */
  depth(z) {
    return this.side + ((this.z[1] - z) / (this.z[1] - this.z[0])) * this.deep;
  }
}

function within(value, low, high) {
  return Math.min(Math.max(value, low), Math.max(low, high));
}

/** Distance of the ticks of a ruler over so many metres, at most about so many of them. */
export function gap(metres, most = 14) {
  return [0.5, 1, 2, 5, 10, 20, 50, 100, 1000].find((step) => metres / step <= most) ?? 1000;
}

/** Corners [m] of the tank from above. */
export function tankOutline(tank) {
  const [[x0, x1], [y0, y1]] = [tank.x_m, tank.y_m];
  if (tank.shape !== "circle") return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
  return circle((x0 + x1) / 2, (y0 + y1) / 2, tank.radius_m, 180);
}

export function circle(x, y, radius, n = 48) {
  return Array.from({ length: n }, (_, i) => [x + radius * Math.cos((2 * Math.PI * i) / n), y + radius * Math.sin((2 * Math.PI * i) / n)]);
}

/** Corners [m] of an obstacle from above. */
export function obstacleOutline(obstacle, x, y) {
  if (obstacle.kind !== "box") return circle(x, y, obstacle.size[0]);
  const [a, b] = obstacle.size;
  return turned([[a, b], [-a, b], [-a, -b], [a, -b]], obstacle.yaw, x, y);
}

/** Half its width [m] along x, as the view from the side shows it. */
export function halfWidth(obstacle) {
  if (obstacle.kind !== "box") return obstacle.size[0];
  return Math.abs(obstacle.size[0] * Math.cos(obstacle.yaw)) + Math.abs(obstacle.size[1] * Math.sin(obstacle.yaw));
}

const HULL = [[0.5, 0], [0.22, 0.5], [-0.42, 0.5], [-0.5, 0.36], [-0.5, -0.36], [-0.42, -0.5], [0.22, -0.5]];
export const HULL_RADIUS_M = 0.17;

/** Corners [m] of the hull from above, at least 14 pixels long, so that it can be seen. */
export function hullOutline([x, y, , yaw], scale) {
  const grow = Math.max(1, 14 / (0.54 * scale));
  return turned(HULL.map(([a, b]) => [0.54 * grow * a, 0.34 * grow * b]), yaw, x, y);
}

/** Corners of the ellipse of two standard deviations of a place. */
export function ellipse(x, y, [xx, xy, yy]) {
  const middle = 0.5 * (xx + yy);
  const spread = Math.hypot(0.5 * (xx - yy), xy);
  const [a, b] = [middle + spread, middle - spread].map((variance) => 2 * Math.sqrt(Math.max(variance, 0)));
  return turned(circle(0, 0, 1, 32).map(([u, v]) => [a * u, b * v]), 0.5 * Math.atan2(2 * xy, xx - yy), x, y);
}

function turned(points, yaw, x, y) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return points.map(([a, b]) => [x + c * a - s * b, y + s * a + c * b]);
}
