// The scene of a moment: from above what an agent senses, maps, plans and does, with the truth; below that from the side.
import { HULL_RADIUS_M, circle, ellipse, gap, halfWidth, hullOutline, obstacleOutline, tankOutline } from "./view.mjs";

/** What can be switched off, in the legend's order: name, colour of the palette, words, mark, and whether it is shown at first. */
export const LAYERS = [
  ["truth", "mover", "true obstacles (static: grey)", "thin ring", true],
  ["static", "static", "mapped", "", true],
  ["dynamic", "dynamic", "mapped, dynamic", "", true],
  ["tracks", "dynamic", "tracked, 2 sigma", "ring", true],
  ["futures", "mover", "forecasts", "dot", true],
  ["route", "route", "route", "line", true],
  ["path", "", "path driven", "line", true],
  ["echoes", "echo", "sonar", "dot", true],
  ["ghosts", "grey", "other agents", "line", true],
  ["clearance", "intersection", "clearance field", "", false],
  ["around", "ink", "around the vehicle", "ring", false],
  ["camera", "ink", "camera, if recorded: what is near stands out", "", false],
];
export const AROUND_PX = 132;
const AROUND_M = 6;

/** Draws a scene into a 2D context of CSS pixels. `look`: colours by name, colours of the agents, layers that are on. */
export class Painter {
  constructor(context, view, look) {
    Object.assign(this, { context, view, look });
  }

  scene(source, agent, time) {
    const { context, view, look } = this;
    const frame = source.frame(agent, time);
    const places = source.places(time);
    context.fillStyle = look.paper;
    context.fillRect(0, 0, view.width, view.height);
    context.save();
    context.beginPath();
    context.rect(view.left - 2, view.top - 2, view.wide + 4, view.high + 4);
    context.clip();
    this.polygon(tankOutline(source.scene.tank), look.water);
    this.map(frame.map);
    if (look.on.truth) this.truth(source, places, frame.pose[2], source.agents[agent]);
    if (look.on.futures) this.futures(frame.futures);
    this.goal(source.scene);
    if (look.on.route) this.route(frame);
    if (look.on.ghosts) this.others(source, agent, time);
    this.path(source.history(agent), frame.step, look.agents[agent], 2.5, 2.5);
    if (look.on.echoes) for (const [x, y] of frame.echoes) this.dot(x, y, 1.7, look.echo);
    if (look.on.tracks) this.tracks(frame.tracks);
    this.vehicle(frame.pose, look.agents[agent]);
    if (ended(source.agents[agent], time) && source.agents[agent].failed) this.cross(frame.pose);
    this.walls(source.scene.tank);
    context.restore();
    this.ruler();
    this.side(source, agent, time, frame, places);
  }

  /** One tank of many: the truth, the path and the vehicle. */
  small(source, time) {
    const { context, view, look } = this;
    const [frame, [about]] = [source.frame(0, time), source.agents];
    context.fillStyle = look.paper;
    context.fillRect(0, 0, view.width, view.height);
    this.polygon(tankOutline(source.scene.tank), look.water);
    this.truth(source, source.places(time), frame.pose[2], about);
    this.goal(source.scene);
    this.path(source.history(0), frame.step, look.agents[0], 1.6);
    this.vehicle(frame.pose, look.agents[0]);
    if (about.failed) this.cross(frame.pose);
    this.outline(tankOutline(source.scene.tank), look.ink, 2);
  }

  // -------------------------------------------------------------------------------------------- what stands in the scene

  map(map) {
    if (!map) return;
    for (const [name, most, power, share] of [["clearance", 40, 1, 0.55], ["static", 31, 0.8, 0.92], ["dynamic", 31, 0.8, 0.95]]) {
      if (this.look.on[name]) this.cells(map, map.layers[name], this.look[name === "clearance" ? "intersection" : name], most, power, share);
    }
  }

  /** Cells of a layer as an image of its own, kept until its map or its colour changes. */
  cells(map, layer, colour, most, power, share) {
    const key = `${layer.version} ${colour}`;
    if (layer.version < 0) return;
    const kept = (this.look.images[colour] ??= document.createElement("canvas"));
    if (kept.key !== key || kept.of !== layer.cells) {
      [kept.width, kept.height] = [map.columns, map.rows];
      const image = new ImageData(map.columns, map.rows);
      const rgb = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
      layer.cells.forEach((value, i) => {
        const place = 4 * ((map.rows - 1 - Math.floor(i / map.columns)) * map.columns + (i % map.columns));
        image.data.set(rgb, place);
        image.data[place + 3] = 255 * share * Math.min(value / most, 1) ** power;
      });
      kept.getContext("2d").putImageData(image, 0, 0);
      [kept.key, kept.of] = [key, layer.cells];
    }
    const { context, view } = this;
    const [left, top] = [view.x(map.x), view.y(map.y + map.rows * map.cell_m)];
    context.imageSmoothingEnabled = false;
    context.drawImage(kept, left, top, map.columns * map.cell_m * view.scale, map.rows * map.cell_m * view.scale);
  }

  /** Outlines of the true obstacles, dashed while wholly above or below the vehicle; what was hit is filled. */
  truth({ scene }, places, z, { slot }) {
    scene.obstacles.forEach((obstacle, i) => {
      const outline = obstacleOutline(obstacle, places[2 * i], places[2 * i + 1]);
      const away = Math.abs(obstacle.at[2] - z) > obstacle.size[2] + HULL_RADIUS_M;
      if (obstacle.slot === slot && slot >= 0) this.polygon(outline, this.look.failed + "55");
      this.outline(outline, obstacle.moves ? this.look.mover : this.look.grey, 1.4, away ? [4, 4] : []);
    });
  }

  futures(futures) {
    const { context, look } = this;
    for (const { weight, points } of futures) {
      context.globalAlpha = 0.25 + 0.6 * weight;
      this.line(points, look.mover, 1.5);
      for (let i = 1; i < points.length; i++) this.dot(points[i][0], points[i][1], 1.8, look.mover);
    }
    context.globalAlpha = 1;
  }

  goal({ goal, goal_radius_m }) {
    const { context, view, look } = this;
    this.outline(circle(goal[0], goal[1], goal_radius_m, 72), look.ink, 1, [5, 4]);
    context.beginPath();
    for (let i = 0; i < 10; i++) {
      const [angle, reach] = [-Math.PI / 2 + (i * Math.PI) / 5, (i % 2 ? 0.42 : 1) * view.star];
      context.lineTo(view.x(goal[0]) + reach * Math.cos(angle), view.y(goal[1]) + reach * Math.sin(angle));
    }
    context.closePath();
    this.inked(look.goal, look.ink, 1);
  }

  route({ route, ahead }) {
    this.line(route, this.look.paper, 5);
    this.line(route, this.look.route, 2);
    if (ahead) this.dot(ahead[0], ahead[1], 6, this.look.paper), this.dot(ahead[0], ahead[1], 4.4, this.look.route);
  }

  tracks(tracks) {
    for (const { x, y, radius, vx, vy, cov } of tracks) {
      this.outline(circle(x, y, radius + 0.06), this.look.dynamic, 2);
      this.outline(ellipse(x, y, cov), this.look.dynamic, 1, [2, 2]);
      if (Math.hypot(vx, vy) > 0.03) this.line([[x, y], [x + vx, y + vy]], this.look.dynamic, 1.2);
    }
  }

  /** The other agents at the same moment: their paths and hulls, pale; a cross where one failed. */
  others(source, agent, time) {
    const { context, look } = this;
    source.agents.forEach((other, i) => {
      if (i === agent) return;
      const { step, pose } = source.frame(i, time);
      context.globalAlpha = 0.45;
      this.path(source.history(i), step, look.agents[i], 1.6);
      context.globalAlpha = 0.65;
      this.vehicle(pose, look.agents[i]);
      if (ended(other, time) && other.failed) this.cross(pose);
    });
    context.globalAlpha = 1;
  }

  /** From a ring at the start; `halo`: [px] of paper around it. */
  path({ pose }, step, colour, width, halo = 0) {
    const { context, view, look } = this;
    if (!look.on.path) return;
    context.beginPath();
    for (let i = 0; i <= step; i++) context.lineTo(view.x(pose[4 * i]), view.y(pose[4 * i + 1]));
    if (halo) this.stroked(look.paper, width + halo);
    this.stroked(colour, width);
    if (halo) this.dot(pose[0], pose[1], 5, look.ink), this.dot(pose[0], pose[1], 2.8, look.paper);
  }

  vehicle(pose, colour) {
    const outline = hullOutline(pose, this.view.scale);
    this.polygon(outline, colour);
    this.outline(outline, this.look.paper, 1);
  }

  cross([x, y]) {
    const { context, view, look } = this;
    for (const [colour, width] of [[look.paper, 7], [look.failed, 4]]) {
      for (const sign of [-1, 1]) {
        context.beginPath();
        context.moveTo(view.x(x) - 8, view.y(y) - 8 * sign);
        context.lineTo(view.x(x) + 8, view.y(y) + 8 * sign);
        this.stroked(colour, width);
      }
    }
  }

  walls(tank) {
    this.outline(tankOutline(tank), this.look.ink, 3);
  }

  // ------------------------------------------------------------------------------------------------------ from the side

  side(source, agent, time, frame, places) {
    const { context, view, look } = this;
    const [top, bottom] = [view.side, view.side + view.deep];
    this.text("from the side", view.left, top - 8, "left");
    context.save();
    context.beginPath();
    context.rect(view.left - 2, top - 2, view.wide + 4, view.deep + 4);
    context.clip();
    context.fillStyle = look.water;
    context.fillRect(view.left, top, view.wide, view.deep);
    if (look.on.truth) {
      source.scene.obstacles.forEach((obstacle, i) => {
        const [x, z] = [places[2 * i], obstacle.at[2]];
        const [half, high] = [halfWidth(obstacle), obstacle.size[2]];
        context.beginPath();
        if (obstacle.kind === "sphere") context.ellipse(view.x(x), view.depth(z), half * view.scale, view.depth(z - high) - view.depth(z), 0, 0, 7);
        else context.rect(view.x(x - half), view.depth(z + high), 2 * half * view.scale, view.depth(z - high) - view.depth(z + high));
        this.inked(obstacle.moves ? look.mover + "22" : look.grey + "1c", obstacle.moves ? look.mover : look.grey, 1.2);
      });
    }
    const [x, , z] = source.scene.goal;
    context.fillStyle = look.goal;
    context.fillRect(view.x(x) - 3, view.depth(z) - 3, 6, 6);
    source.agents.forEach((_, i) => {
      if (i !== agent && look.on.ghosts) this.fromSide(source, i, time, 0.4);
    });
    this.fromSide(source, agent, time, 1);
    context.restore();
    context.strokeStyle = look.ink;
    context.lineWidth = 1;
    context.strokeRect(view.left, top, view.wide, view.deep);
    for (const depth of [view.z[1], view.z[0]]) this.text(`${-depth}`.slice(0, 4), view.left - 6, view.depth(depth) + 4, "right");
    this.text("depth [m]", view.left, bottom + 18, "left");
  }

  fromSide(source, agent, time, alpha) {
    const { context, view, look } = this;
    const { pose } = source.history(agent);
    const { step } = source.frame(agent, time);
    context.globalAlpha = alpha;
    context.beginPath();
    for (let i = 0; i <= step; i++) context.lineTo(view.x(pose[4 * i]), view.depth(pose[4 * i + 2]));
    this.stroked(look.agents[agent], 1.6);
    const half = Math.max(0.27 * view.scale, 6);
    context.beginPath();
    context.roundRect(view.x(pose[4 * step]) - half, view.depth(pose[4 * step + 2]) - 0.45 * half, 2 * half, 0.9 * half, 3);
    this.inked(look.agents[agent], look.paper, 1);
    context.globalAlpha = 1;
  }

  // --------------------------------------------------------------------------------------------------------------- pens

  ruler() {
    const { view } = this;
    const bottom = view.top + view.high;
    const step = gap(view.wide / view.scale, view.wide < 500 ? 7 : 14);
    for (let x = Math.ceil(view.x0 / step) * step; x <= view.x0 + view.wide / view.scale + 1e-6; x += step) {
      this.text(`${x}`, view.x(x), bottom + 15, "center");
    }
    for (let y = Math.ceil((view.y1 - view.high / view.scale) / step) * step; y <= view.y1 + 1e-6; y += step) {
      this.text(`${y}`, view.left - 6, view.y(y) + 4, "right");
    }
    this.text("m", view.left + view.wide, bottom + 30, "right");
  }

  dot(x, y, radius, colour) {
    const { context, view } = this;
    context.beginPath();
    context.arc(view.x(x), view.y(y), radius, 0, 7);
    context.fillStyle = colour;
    context.fill();
  }

  line(points, colour, width) {
    const { context, view } = this;
    context.beginPath();
    for (const [x, y] of points) context.lineTo(view.x(x), view.y(y));
    this.stroked(colour, width);
  }

  outline(points, colour, width, dash = []) {
    this.context.setLineDash(dash);
    this.line([...points, points[0]], colour, width);
    this.context.setLineDash([]);
  }

  polygon(points, colour) {
    const { context, view } = this;
    context.beginPath();
    for (const [x, y] of points) context.lineTo(view.x(x), view.y(y));
    context.fillStyle = colour;
    context.fill();
  }

  inked(fill, edge, width) {
    this.context.fillStyle = fill;
    this.context.fill();
    this.stroked(edge, width);
  }

  stroked(colour, width) {
    this.context.strokeStyle = colour;
    this.context.lineWidth = width;
    this.context.lineJoin = "round";
    this.context.stroke();
  }

  text(words, x, y, align) {
    const { context, look } = this;
    context.font = `12px ${look.font}`;
    context.textAlign = align;
    context.fillStyle = look.grey;
    context.fillText(words, x, y);
  }
}

/** What the vehicle senses around it, its bow up, as a sonar's display shows it: returns, tracks, the point it steers at, the goal's way. */
export function paintAround(context, { pose: [x, y, , yaw], echoes, tracks, ahead }, goal, colour, look) {
  const [middle, scale, [c, s]] = [AROUND_PX / 2, (AROUND_PX / 2 - 9) / AROUND_M, [Math.cos(yaw), Math.sin(yaw)]];
  const place = (u, v) => [middle + (s * (u - x) - c * (v - y)) * scale, middle - (c * (u - x) + s * (v - y)) * scale];
  const round = ([u, v], radius, fill, edge, width = 1.5) => {
    context.beginPath();
    context.arc(u, v, radius, 0, 7);
    context.fillStyle = fill;
    context.fill();
    if (!edge) return;
    context.strokeStyle = edge;
    context.lineWidth = width;
    context.stroke();
  };
  context.fillStyle = look.paper;
  context.fillRect(0, 0, AROUND_PX, AROUND_PX);
  round([middle, middle], AROUND_M * scale, look.water, look.ink);
  for (const ring of [2, 4]) round([middle, middle], ring * scale, "transparent", look.faint, 1);
  const far = (u, v) => Math.hypot(u - x, v - y) > AROUND_M;
  for (const [u, v] of echoes) if (!far(u, v)) round(place(u, v), 1.6, look.echo);
  for (const track of tracks) if (!far(track.x, track.y)) round(place(track.x, track.y), track.radius * scale, "transparent", look.dynamic);
  if (ahead && !far(...ahead)) round(place(...ahead), 3, look.route);
  const share = Math.min(AROUND_M / (Math.hypot(goal[0] - x, goal[1] - y) || 1), 1);
  round(place(x + share * (goal[0] - x), y + share * (goal[1] - y)), 4, look.goal, look.ink, 1);
  context.fillStyle = colour;
  context.beginPath();
  for (const [u, v] of [[0, -7], [5, 5], [-5, 5]]) context.lineTo(middle + u, middle + v);
  context.fill();
  context.font = `10px ${look.font}`;
  context.textAlign = "right";
  context.fillStyle = look.grey;
  context.fillText(`${AROUND_M} m`, AROUND_PX, AROUND_PX - 2);
}

/** What the camera sees: of the water's colour what is far, of the ink's what is near. */
export function paintCamera(canvas, cells, look) {
  [canvas.width, canvas.height] = [64, 36];
  const image = new ImageData(64, 36);
  const [far, near] = [look.water, look.ink].map((colour) => [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16)));
  cells.forEach((cell, i) => image.data.set([...near.map((part, k) => part + (far[k] - part) * (cell / 31)), 255], 4 * i));
  canvas.getContext("2d").putImageData(image, 0, 0);
}

export function ended(agent, time) {
  return time >= agent.end - 1e-6;
}
