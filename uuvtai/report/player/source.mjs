// Where frames come from. The player knows a Source and nothing else; this one reads a page's recorded episodes.
import { Layer, Rows, newest, unpacked } from "./decode.mjs";

/**
 * @typedef {object} Source
 * @property {object} scene tank, goal, goal_radius_m, obstacles, palette
 * @property {object[]} agents name, colour, outcome, failed, cause, meaning, slot, end [s], leftOut
 * @property {number} end [s] how far it reaches by now
 * @property {(agent: number, time: number) => Frame} frame what an agent senses, maps, plans and does
 * @property {(time: number) => Float64Array} places x, y [m] of each obstacle in turn
 * @property {(agent: number) => object} history time, pose, clearance, ttc, speed, leaf of every step; leaves; replans
 *
 * @typedef {object} Frame as of one moment; null or empty where the agent has none
 * @property {number} step which row of the history
 * @property {Float64Array} pose x, y, z [m], yaw [rad]
 * @property {?number} clearance [m]
 * @property {?number} ttc [s], null = nothing closes in
 * @property {?number} speed [m/s]
 * @property {string} leaf node of the tree that drives
 * @property {number[][]} route points [m]
 * @property {?Float64Array} ahead the point that is steered at
 * @property {number[][]} echoes points [m]
 * @property {object[]} tracks x, y, radius, z [m], vx, vy [m/s], cov: xx, xy, yy [m^2]
 * @property {object[]} futures weight and points [m] of each hypothesis
 * @property {?Float64Array} camera how far it sees, 36 rows of 64 from the left above: 0 = near, 31 = 10 m or more
 * @property {?object} map rows, columns, x, y, cell_m, and of each layer cells 0 to 255 with their version
 */

/** The episode that blobs hold: the scene's and each agent's. */
export async function recorded(blobs) {
  const [scene, ...agents] = await Promise.all(blobs.map(unpacked));
  return new Recorded(scene, agents.map((agent) => new Agent(agent)));
}

class Recorded {
  constructor({ header, arrays }, agents) {
    this.scene = header;
    this.all = agents;
    this.agents = agents.map((agent) => agent.about);
    this.end = Math.max(...agents.map((agent) => agent.about.end));
    this.steps = arrays.time.values;
    this.moving = arrays.places;
  }

  frame(agent, time) {
    return this.all[agent].frame(time);
  }

  history(agent) {
    return this.all[agent].history;
  }

  places(time) {
    const i = Math.max(newest(this.steps, time), 0);
    const next = Math.min(i + 1, this.steps.length - 1);
    const gap = this.steps[next] - this.steps[i];
    const share = gap > 0 ? Math.min(Math.max((time - this.steps[i]) / gap, 0), 1) : 0;
    const { columns, values } = this.moving;
    const found = new Float64Array(2 * this.scene.obstacles.length);
    let column = 0;
    this.scene.obstacles.forEach((obstacle, k) => {
      for (const axis of [0, 1]) {
        if (!obstacle.moves) found[2 * k + axis] = obstacle.at[axis];
        else {
          const [a, b] = [values[i * columns + column], values[next * columns + column]];
          found[2 * k + axis] = a + share * (b - a);
          column++;
        }
      }
    });
    return found;
  }
}

class Agent {
  constructor({ header, arrays }) {
    const of = (name) => arrays[name]?.values ?? null;
    const times = of("time");
    this.about = {
      name: header.agent, colour: header.colour, outcome: header.outcome, failed: header.failed, cause: header.cause,
      meaning: header.meaning, slot: header.slot, end: times[times.length - 1], leftOut: header.left_out,
    };
    this.rows = Object.fromEntries(["route", "tracks", "futures", "echoes"].map((name) => [name, new Rows(arrays, name)]));
    const why = of("route.why") ?? [];
    this.history = {
      time: times, pose: of("pose"), clearance: of("clearance"), ttc: of("ttc"), speed: of("speed"), leaf: of("leaf"),
      leaves: header.leaves, replans: [...this.rows.route.times].map((time, i) => ({ time, why: header.triggers[why[i]] })),
    };
    this.ahead = of("ahead");
    this.cov = of("tracks.cov");
    this.weight = of("futures.weight");
    this.camera = { times: of("camera.time") ?? [], values: of("camera.of") };
    this.grid = header.grid;
    this.rare = header.rare_s;
    const cells = this.grid ? this.grid.rows * this.grid.columns : 0;
    this.layers = Object.fromEntries(["static", "dynamic", "clearance"].map((name) => [name, new Layer(arrays, `map_${name}`, cells)]));
  }

  frame(time) {
    const { history } = this;
    const step = Math.max(newest(history.time, time), 0);
    const route = this.points_of("route", time);
    return {
      step, pose: history.pose.subarray(4 * step, 4 * step + 4),
      clearance: history.clearance?.[step] ?? null,
      ttc: history.ttc && history.ttc[step] >= 0 ? history.ttc[step] : null,
      speed: history.speed?.[step] ?? null,
      leaf: history.leaf ? history.leaves[history.leaf[step]] : "",
      route, ahead: this.ahead && route.length ? this.ahead.subarray(2 * step, 2 * step + 2) : null,
      echoes: this.points_of("echoes", time), tracks: this.tracks(time), futures: this.futures(time), map: this.map(time), camera: this.seen(time),
    };
  }

  /** The newest image. */
  seen(time) {
    const i = newest(this.camera.times, time);
    return i < 0 ? null : this.camera.values.subarray(2304 * i, 2304 * (i + 1));
  }

  points_of(name, time) {
    const rows = this.rows[name];
    const found = rows.at(time);
    return found ? Array.from({ length: found.to - found.from }, (_, i) => rows.row(found.from + i)) : [];
  }

  tracks(time) {
    const found = this.rows.tracks.at(time);
    return this.points_of("tracks", time).map(([x, y, radius, z, vx, vy], i) => {
      const k = 3 * (found.from + i);
      return { x, y, radius, z, vx, vy, cov: this.cov.subarray(k, k + 3) };
    });
  }

  /** Forecasts until the next ones may come: what was foreseen a second ago is no forecast. */
  futures(time) {
    const found = this.rows.futures.at(time);
    if (!found || time - this.rows.futures.times[found.index] > 1.3 * this.rare) return [];
    return this.points_of("futures", time).map((path, i) => ({
      weight: this.weight[found.from + i],
      points: Array.from({ length: path.length / 2 }, (_, k) => [path[2 * k], path[2 * k + 1]]),
    }));
  }

  map(time) {
    if (!this.grid) return null;
    const layers = Object.entries(this.layers).map(([name, layer]) => [name, { cells: layer.at(time), version: layer.shown }]);
    return { ...this.grid, layers: Object.fromEntries(layers) };
  }
}
