// The player's modules without a page: node --test player.test.mjs
import assert from "node:assert/strict";
import { test } from "node:test";
import { deflateSync } from "node:zlib";

const player = new URL("../../uuvtai/report/player/", import.meta.url);
const { Layer, Rows, newest, unpacked } = await import(new URL("decode.mjs", player));
const { View, ellipse, gap, halfWidth, hullOutline, obstacleOutline, tankOutline } = await import(new URL("view.mjs", player));
const { moment, most, place } = await import(new URL("strip.mjs", player));
const { command, ending } = await import(new URL("player.mjs", player));
const { recorded } = await import(new URL("source.mjs", player));
const { Running } = await import(new URL("running.mjs", player));
const { Steering, said } = await import(new URL("steer.mjs", player));

/** A blob of arrays: name -> [step, columns, whole numbers row by row], in four bytes each. */
function packed(header, arrays) {
  const [table, parts] = [{}, []];
  let at = 0;
  for (const [name, [step, columns, values]] of Object.entries(arrays)) {
    const rows = values.length / columns;
    const planes = Buffer.alloc(4 * values.length);
    for (let column = 0; column < columns; column++)
      for (let row = 0; row < rows; row++) {
        const difference = values[row * columns + column] - (row ? values[(row - 1) * columns + column] : 0);
        for (let k = 0; k < 4; k++) planes[k * values.length + column * rows + row] = (difference >> (8 * k)) & 255;
      }
    table[name] = { at, bytes: 4, rows, columns, step };
    parts.push(planes);
    at += planes.length;
  }
  const head = Buffer.from(JSON.stringify({ ...header, arrays: table }));
  const length = Buffer.alloc(4);
  length.writeUInt32LE(head.length);
  return deflateSync(Buffer.concat([length, head, ...parts])).toString("base64");
}

const TANK = { shape: "rectangle", x_m: [0, 20], y_m: [0, 6], z_m: [-1.6, 0], radius_m: 3 };

test("a blob gives back its header and its numbers", async () => {
  const { header, arrays } = await unpacked(packed({ agent: "bt ü" }, { pose: [0.001, 2, [1, -2, 70000, -70000, -3, 4]] }));
  assert.equal(header.agent, "bt ü");
  assert.deepEqual([...arrays.pose.values], [0.001, -0.002, 70, -70, -0.003, 0.004]);
});

test("the newest of times, and rows of a moment", () => {
  assert.deepEqual([-1, 0, 0.5, 1, 9].map((time) => newest([0, 1, 2], time)), [-1, 0, 0, 1, 2]);
  const rows = new Rows({ "a.time": { values: [0, 1] }, "a.rows": { values: [2, 1] }, "a.of": { columns: 1, values: Float64Array.of(5, 6, 7) } }, "a");
  assert.deepEqual([rows.at(-1), rows.at(0), rows.at(1)], [null, { index: 0, from: 0, to: 2 }, { index: 1, from: 2, to: 3 }]);
  assert.deepEqual([...rows.row(2)], [7]);
  assert.equal(new Rows({}, "missing").at(3), null);
});

test("a map goes on and back", () => {
  const changes = { "m.time": { values: [1, 2] }, "m.rows": { values: [2, 1] }, "m.of": { columns: 1, values: Float64Array.of(0, 3, 0) }, "m.value": { values: [9, 8, 0] } };
  const layer = new Layer(changes, "m", 4);
  for (const [time, cells] of [[0, [0, 0, 0, 0]], [1, [9, 0, 0, 8]], [2, [0, 0, 0, 8]], [1.5, [9, 0, 0, 8]], [0.5, [0, 0, 0, 0]], [7, [0, 0, 0, 8]]]) {
    assert.deepEqual([...layer.at(time)], cells, `at ${time}`);
  }
});

test("places on the canvas", () => {
  for (const width of [1180, 340]) {
    const view = new View(TANK, width, null);
    assert.ok(view.x(20) <= width && view.x(0) >= 30 && view.y(6) === view.top && view.y(0) < view.side);
    assert.ok(Math.abs((view.x(20) - view.x(0)) / 20 - (view.y(0) - view.y(6)) / 6) < 1e-9, "a metre is as long both ways");
    assert.deepEqual([view.depth(0), view.depth(-1.6)], [view.side, view.side + view.deep]);
  }
  const near = new View(TANK, 1180, { x: 19, y: 1, metres: 9 });
  assert.ok(Math.abs(near.x(20) - near.left - near.wide) < 1e-9 && Math.abs(near.y(0) - near.top - near.high) < 1e-9, "no farther than the walls");
});

test("fingers zoom and move, and no farther than the whole tank", () => {
  const whole = new View(TANK, 340, null);
  const [from, to] = [{ x: 200, y: 50 }, { x: 180, y: 60 }];
  const zoom = whole.zoomed(TANK, 8, from, to);
  const large = new View(TANK, 340, zoom);
  assert.ok(Math.abs(large.scale - 8 * whole.scale) < 1e-9);
  whole.world(from).forEach((part, i) => assert.ok(Math.abs(part - large.world(to)[i]) < 1e-9, "what was under the fingers still is"));
  assert.equal(large.zoomed(TANK, 0.12, to, from), null);
  const far = new View(TANK, 340, large.zoomed(TANK, 1, from, { x: 9000, y: -9000 }));
  assert.deepEqual([far.x0, Math.round(1e6 * (far.y1 - far.high / far.scale))], [0, 0]);
  assert.equal(whole.zoomed(TANK, 1e9, from, to).metres, 1.5);
});

test("shapes", () => {
  assert.equal(tankOutline(TANK).length, 4);
  assert.deepEqual(tankOutline({ ...TANK, shape: "circle" })[0], [13, 3]);
  const box = { kind: "box", size: [2, 1, 1], yaw: Math.PI / 2 };
  assert.ok(Math.abs(halfWidth(box) - 1) < 1e-9);
  assert.deepEqual(obstacleOutline(box, 5, 5).map((point) => point.map(Math.round)), [[4, 7], [4, 3], [6, 3], [6, 7]]);
  const across = ellipse(0, 0, [0.01, 0, 0.04]).map(([x, y]) => [Math.abs(x), Math.abs(y)]);
  assert.ok(Math.abs(Math.max(...across.map(([x]) => x)) - 0.2) < 1e-6 && Math.abs(Math.max(...across.map(([, y]) => y)) - 0.4) < 1e-6);
  const bow = hullOutline([1, 2, -1, Math.PI / 2], 50)[0];
  assert.ok(Math.abs(bow[0] - 1) < 1e-9 && Math.abs(bow[1] - 2.27) < 1e-9);
  assert.deepEqual([gap(20), gap(6), gap(200)], [2, 0.5, 20]);
});

test("a moment's place on the strip, and back", () => {
  for (const time of [0, 3.3, 12]) assert.ok(Math.abs(moment(place(time, 12, 700), 12, 700) - time) < 1e-9);
  assert.deepEqual([moment(-50, 12, 700), moment(9999, 12, 700), place(0, 0, 700)], [0, 12, place(0, 12, 700)]);
  assert.deepEqual([most([0.2, 1.4], 1), most(null, 1), most([50], 10)], [2, 1, 10]);
});

test("keys", () => {
  assert.deepEqual(command({ key: " " }), ["toggle"]);
  assert.deepEqual(command({ key: "ArrowLeft", shiftKey: true }), ["step", -1]);
  assert.deepEqual(command({ key: "3" }), ["follow", 2]);
  assert.equal(command({ key: "r", ctrlKey: true }) ?? command({ key: "q" }), null);
});

test("how an episode ended, in words", () => {
  const agent = { name: "bt", outcome: "collision", end: 7.24, cause: "late detection", meaning: "seen too late" };
  assert.equal(ending(agent), "bt: collision after 7.2 s. Late detection: seen too late");
  assert.equal(ending({ ...agent, cause: "", meaning: "" }), "bt: collision after 7.2 s");
  assert.equal(ending({ ...agent, end: Infinity }), "bt: under way");
});

test("a running episode", () => {
  const obstacles = [{ at: [9, 8, 0], moves: false }, { at: [0, 0, 0], moves: true }];
  const rows = [[0, 1, 2, -1, 0, 2, -1, 0, 0, [3, 4]], [0.05, 1.5, 2, -1, 0.1, null, null, 0.5, 1, [5, 6]]];
  const told = { agent: "bt", title: "seed 0, episode 1", colour: ["#0072b2", 0], leaves: ["Follow", "Evade"], scene: { obstacles }, grid: { rows: 1, columns: 2 }, rows, replans: [[0, "initial"]], end: null };
  const source = new Running(told);
  assert.deepEqual([source.end, source.agents[0].end, ...source.places(0), ...source.places(1)], [0.05, Infinity, 9, 8, 3, 4, 9, 8, 5, 6]);
  const [first, second] = [0, 0.05].map((time) => source.frame(0, time));
  assert.deepEqual([first.pose, first.clearance, first.ttc, first.leaf, first.map], [[1, 2, -1, 0], 2, null, "Follow", null]);
  assert.deepEqual([second.step, second.clearance, second.ttc, second.speed, second.leaf], [1, null, null, 0.5, "Evade"]);
  source.detail({ time: 0.05, route: [[0, 0]], ahead: [1, 1], echoes: [[2, 2]], tracks: [[1, 2, 3, 4, 0.5, 0.1, 0, 0.2]], futures: [[0.7, [[1, 1]]]], camera: "AR8=", map: ["AR8=", "AAA=", "/wA="] });
  source.add([2, 3, 2, -1, 0, 1, 4, 0.5, 0, [5, 6]]);
  const [seen, later] = [0.1, 2].map((time) => source.frame(0, time));
  assert.deepEqual([seen.tracks[0].cov, seen.futures[0].weight, [...seen.map.layers.static.cells]], [[0.1, 0, 0.2], 0.7, [1, 31]]);
  assert.deepEqual([[...seen.camera], later.camera], [[1, 31], null]);
  assert.deepEqual([later.echoes, later.ttc, [...later.map.layers.clearance.cells]], [[], 4, [255, 0]]);
  source.finish({ outcome: "collision", failed: true, time: 2 });
  assert.deepEqual([source.agents[0].end, source.agents[0].failed], [2, true]);
  assert.deepEqual([new Running(told, source).maps.length, new Running({ ...told, title: "seed 0, episode 2" }, source).maps.length], [1, 0]);
});

test("steering by keys and gamepad", () => {
  const steering = new Steering();
  const [none, plain] = [[], { shiftKey: false }];
  for (const code of ["KeyW", "KeyA", "PageDown", "ArrowLeft"]) assert.ok(steering.key({ ...plain, code }, true));
  assert.deepEqual(steering.command(none), [1, 1, -1, 1]);
  steering.key({ code: "KeyA", shiftKey: true }, false);
  assert.deepEqual(steering.command(none).map((value) => Math.round(10 * value)), [3, 0, -3, 3]);
  assert.equal(said(steering.command(none)), "ahead 33 %, down 33 %, turn left 33 %");
  assert.ok(steering.key({ ...plain, code: "Space" }, true) && !steering.key({ ...plain, code: "KeyX" }, true) && !steering.key({ ...plain, code: "KeyW", ctrlKey: true }, true));
  assert.deepEqual([steering.command(none), said([0, 0, 0, 0])], [[0, 0, 0, 0], "stop"]);
  steering.thumb(true, -0.56, 1);
  steering.thumb(false, 0.1, -1);
  assert.deepEqual(steering.command(none).map((value) => Math.round(100 * value)), [100, 50, -100, 0]);
  steering.release();
  const pad = { connected: true, axes: [0.1, -1, 1, 0.56], buttons: [{ pressed: false }] };
  assert.deepEqual(steering.command([null, pad]).map((value) => Math.round(100 * value)), [100, 0, -50, -100]);
  assert.deepEqual(steering.command([{ ...pad, buttons: [{ pressed: true }] }]), [0, 0, 0, 0]);
});

test("agents of an episode in step", async () => {
  const still = { kind: "cylinder", at: [5, 1, -1], size: [1, 1, 1], yaw: 0, slot: 0, moves: false };
  const scene = packed({ tank: TANK, obstacles: [still, { ...still, moves: true }] }, { time: [1, 1, [0, 2]], places: [1, 2, [1, 1, 3, 5]] });
  const header = { agent: "bt", colour: ["#0072b2", 0], outcome: "success", failed: false, cause: "", meaning: "", slot: -1, leaves: ["Follow", "Evade"], triggers: ["initial"], grid: null, rare_s: 0.2, left_out: [] };
  const agent = packed(header, {
    time: [0.1, 1, [0, 5, 10]], pose: [0.001, 4, [0, 0, 0, 0, 500, 0, 0, 0, 1000, 0, 0, 0]], leaf: [1, 1, [0, 1, 1]], ttc: [0.01, 1, [-100, 250, 0]],
    "route.time": [0.1, 1, [5]], "route.rows": [1, 1, [2]], "route.of": [1, 2, [0, 0, 1, 1]], "route.why": [1, 1, [0]],
    "futures.time": [0.1, 1, [5]], "futures.rows": [1, 1, [1]], "futures.of": [1, 4, [1, 2, 3, 4]], "futures.weight": [0.1, 1, [7]],
    "camera.time": [0.1, 1, [5]], "camera.of": [1, 2304, Array(2304).fill(9)],
  });
  const source = await recorded([scene, agent]);
  assert.deepEqual([source.end, source.agents[0].name, ...source.places(0.5)], [1, "bt", 5, 1, 1.5, 2]);
  const [first, second, last] = [0, 0.6, 5].map((time) => source.frame(0, time));
  assert.deepEqual([first.pose[0], second.pose[0], last.pose[0]], [0, 0.5, 1]);
  assert.deepEqual([first.ttc, second.ttc, last.ttc], [null, 2.5, 0]);
  assert.deepEqual([first.leaf, second.leaf, first.route.length, second.route.length, first.map], ["Follow", "Evade", 0, 2, null]);
  assert.deepEqual([first.camera, second.camera.length, second.camera[2303]], [null, 2304, 9]);
  assert.deepEqual([second.futures, last.futures], [[{ weight: 0.7000000000000001, points: [[1, 2], [3, 4]] }], []]);
  assert.deepEqual(source.history(0).replans, [{ time: 0.5, why: "initial" }]);
});
