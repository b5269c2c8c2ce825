// A running episode as a Source: what the server has told of it so far. Looking back shows what was told then.
import { newest } from "./decode.mjs";

const MAPPED = ["static", "dynamic", "clearance"];
const STALE_S = 0.4; // what was sensed longer ago is not shown

export class Running {
  /** `told`: the message that an episode begins with, or all of it up to now, then perhaps after `before`. */
  constructor(told, before) {
    const goesOn = before?.title === told.title && before.agents[0].name === told.agent;
    const { details, maps } = goesOn ? before : { details: [], maps: [] };
    Object.assign(this, { title: told.title, scene: told.scene, grid: told.grid, spots: [], details, maps });
    const about = { outcome: "", failed: false, cause: "", meaning: "", slot: -1, end: Infinity, leftOut: [] };
    this.agents = [{ name: told.agent, colour: told.colour, ...about }];
    this.past = { time: [], pose: [], clearance: [], ttc: [], speed: [], leaf: [], leaves: told.leaves, replans: [] };
    told.rows.forEach((row) => this.add(row));
    told.replans.forEach((replan) => this.replan(replan));
    if (told.end) this.finish(told.end);
  }

  get end() {
    return this.past.time[this.past.time.length - 1];
  }

  /** A step; what is not told is no number. */
  add([time, x, y, z, yaw, clearance, ttc, speed, leaf, places]) {
    const { past } = this;
    past.time.push(time);
    past.pose.push(x, y, z, yaw);
    past.clearance.push(clearance ?? NaN);
    past.ttc.push(ttc ?? NaN);
    past.speed.push(speed);
    past.leaf.push(leaf);
    this.spots.push(places);
  }

  /** What the vehicle senses, maps and plans at one time. */
  detail({ time, route, ahead, echoes, tracks, futures, camera, map }) {
    const moving = tracks.map(([x, y, vx, vy, radius, ...cov]) => ({ x, y, vx, vy, radius, z: 0, cov }));
    const weighed = futures.map(([weight, points]) => ({ weight, points }));
    this.details.push({ time, route, ahead, echoes, tracks: moving, futures: weighed, camera: bytes(camera) });
    if (map) this.maps.push({ time, layers: map.map(bytes) });
  }

  replan([time, why]) {
    this.past.replans.push({ time, why });
  }

  finish({ outcome, failed, time }) {
    Object.assign(this.agents[0], { outcome, failed, end: Math.min(time, this.end) });
  }

  history() {
    return this.past;
  }

  frame(_, time) {
    const { past } = this;
    const step = Math.max(newest(past.time, time), 0);
    const known = (value) => (value >= 0 || value < -1 ? value : null);
    const found = latest(this.details, time);
    const fresh = found && time - found.time <= STALE_S ? found : { route: [], ahead: null, echoes: [], tracks: [], futures: [], camera: null };
    return {
      step, pose: past.pose.slice(4 * step, 4 * step + 4), speed: past.speed[step], leaf: past.leaves[past.leaf[step]] ?? "",
      clearance: Number.isNaN(past.clearance[step]) ? null : past.clearance[step], ttc: known(past.ttc[step]), ...fresh, map: this.map(time),
    };
  }

  map(time) {
    const found = latest(this.maps, time);
    if (!found) return null;
    const version = this.maps.indexOf(found);
    return { ...this.grid, layers: Object.fromEntries(MAPPED.map((name, i) => [name, { cells: found.layers[i], version }])) };
  }

  places(time) {
    const moving = this.spots[Math.max(newest(this.past.time, time), 0)];
    let next = 0;
    return this.scene.obstacles.flatMap(({ at, moves }) => (moves ? [moving[next++], moving[next++]] : [at[0], at[1]]));
  }
}

function bytes(text) {
  return Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
}

/** The newest of these at a time; undefined before the first. */
function latest(list, time) {
  return list.findLast((one) => one.time <= time + 1e-6);
}
