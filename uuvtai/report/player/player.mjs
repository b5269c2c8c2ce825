// The player: a source's scene, strip and figures, and whatever moves through its time.
import { AROUND_PX, LAYERS, Painter, ended, paintAround, paintCamera } from "./paint.mjs";
import { recorded } from "./source.mjs";
import { STRIP_HEIGHT, moment, paintStrip } from "./strip.mjs";
import { gestures } from "./touch.mjs";
import { View } from "./view.mjs";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
const STEP_S = 0.1;
const NEAR_M = 9;
export const KEYS = [
  ["space", "play, pause"], ["← →", "0.1 s back, on (shift: 1 s)"], ["home end", "start, end"], ["+ −", "faster, slower"],
  ["1 … 9", "follow that agent"], ["n p", "next, previous episode"], ["x", "to the failure"], ["z", "near, whole tank"],
  ["l", "layers"], ["d", "dark, light"], ["?", "these keys"], ["two fingers", "zoom, move; then drag"],
];

/** What a key does, by its name in the browser: [command, argument], null = nothing of ours. */
export function command({ key, shiftKey, ctrlKey, metaKey, altKey }) {
  if (ctrlKey || metaKey || altKey) return null;
  const step = shiftKey ? 1 : STEP_S;
  const found = {
    " ": ["toggle"], ArrowLeft: ["step", -step], ArrowRight: ["step", step], Home: ["seek", 0], End: ["seek", Infinity],
    "+": ["faster", 1], "=": ["faster", 1], "-": ["faster", -1], n: ["episode", 1], p: ["episode", -1], x: ["failure"], z: ["near"],
    l: ["fold", "layers"], d: ["theme"], "?": ["fold", "help"],
  }[key];
  return found ?? (/^[1-9]$/.test(key) ? ["follow", Number(key) - 1] : null);
}

/** How an agent's episode ended, in words. */
export function ending({ name, outcome, end, cause, meaning }) {
  if (end === Infinity) return `${name}: under way`;
  const why = [cause, meaning].filter(Boolean).join(": ");
  return `${name}: ${outcome} after ${end.toFixed(1)} s${why ? `. ${why[0].toUpperCase()}${why.slice(1)}` : ""}`;
}

export class Player {
  /** `episodes`: [{title, open: () => Promise of a Source}] */
  constructor(root, episodes) {
    Object.assign(this, { root, episodes, time: 0, speed: 1, agent: 0, playing: false, near: false, window: null, images: {} });
    this.on = Object.fromEntries(LAYERS.map(([name, , , , shown]) => [name, shown]));
    this.build();
    root.player = this;
    const redraw = () => this.draw();
    new ResizeObserver(redraw).observe(this.scene);
    for (const media of ["(prefers-color-scheme: dark)", "print"]) matchMedia(media).addEventListener("change", redraw);
  }

  async open(index) {
    this.index = Math.min(Math.max(index, 0), this.episodes.length - 1);
    this.stop();
    this.source = await this.episodes[this.index].open();
    this.time = this.source.end;
    this.window = null;
    this.agent = Math.min(this.agent, this.source.agents.length - 1);
    this.select.value = this.index;
    this.buttons();
    this.draw();
    return this;
  }

  // -------------------------------------------------------------------------------------------------------- commands

  seek(time) {
    this.time = Math.min(Math.max(time, 0), this.source.end);
    this.draw();
  }

  step(seconds) {
    this.stop();
    this.seek(Math.round((this.time + seconds) / STEP_S) * STEP_S);
  }

  toggle() {
    if (this.playing) return this.stop();
    if (this.time >= this.source.end) this.time = 0;
    this.playing = true;
    let before = null;
    const tick = (now) => {
      if (!this.playing) return;
      const gone = before === null ? 0 : Math.min((now - before) / 1000, 0.1);
      before = now;
      this.seek(this.time + gone * this.speed);
      if (this.time >= this.source.end) return this.stop();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
    this.draw();
  }

  stop() {
    this.playing = false;
    this.draw();
  }

  faster(sign) {
    this.speed = SPEEDS[Math.min(Math.max(SPEEDS.indexOf(this.speed) + sign, 0), SPEEDS.length - 1)];
    this.draw();
  }

  follow(agent) {
    if (agent < this.source.agents.length) this.agent = agent;
    this.draw();
  }

  episode(sign) {
    return this.open(this.index + sign);
  }

  /** To the end of the followed agent that failed, else of the next one that did. */
  failure() {
    const { agents } = this.source;
    const order = agents.map((_, i) => (this.agent + i) % agents.length);
    const failed = order.find((i) => agents[i].failed);
    if (failed === undefined) return;
    this.stop();
    this.agent = failed;
    this.seek(agents[failed].end);
  }

  /** From near, following the vehicle, or the whole tank. */
  zoom() {
    this.near = !this.near && !this.window;
    this.window = null;
    this.draw();
  }

  /** Fingers have moved the scene: it stays where they leave it. From the side they move it along. */
  moved(factor, ...places) {
    const low = this.view.top + this.view.high;
    const [from, to] = places.map(({ x, y }) => ({ x, y: Math.min(y, low) }));
    this.window = this.view.zoomed(this.source.scene.tank, factor, from, to);
    this.near = false;
    this.draw();
  }

  fold(name) {
    this[name].open = !this[name].open;
  }

  theme() {
    document.documentElement.dataset.theme = this.dark() ? "light" : "dark";
    this.draw();
  }

  dark() {
    if (matchMedia("print").matches) return false;
    const { theme } = document.documentElement.dataset;
    return theme ? theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  }

  run([name, argument]) {
    if (name === "near") name = "zoom";
    return this[name](argument);
  }

  // --------------------------------------------------------------------------------------------------------- drawing

  look() {
    const dark = this.dark();
    const style = getComputedStyle(this.root);
    const colours = Object.entries(this.source.scene.palette).map(([name, pair]) => [name, pair[dark ? 1 : 0]]);
    const agents = this.source.agents.map(({ colour: [light, series] }) => (dark && style.getPropertyValue(`--series-${series}`).trim()) || light);
    return { ...Object.fromEntries(colours), agents, on: this.on, images: this.images, font: style.fontFamily };
  }

  draw() {
    const width = this.scene.clientWidth;
    if (!this.source || !width) return;
    const look = this.look();
    const frame = this.source.frame(this.agent, this.time);
    const { tank } = this.source.scene;
    const near = this.near && { x: frame.pose[0], y: frame.pose[1], metres: Math.min(NEAR_M, tank.x_m[1] - tank.x_m[0]) };
    this.view = new View(tank, width, near || this.window);
    this.scene.style.touchAction = near || this.window ? "none" : "pan-y"; // else a finger scrolls the page
    const scene = sized(this.scene, width, this.view.height);
    new Painter(scene, this.view, look).scene(this.source, this.agent, this.time);
    paintStrip(sized(this.strip, width, STRIP_HEIGHT), width, this.source, this.agent, this.time, look);
    this.around.hidden = !this.on.around;
    if (this.on.around) paintAround(sized(this.around, AROUND_PX, AROUND_PX), frame, this.source.scene.goal, look.agents[this.agent], look);
    this.camera.hidden = !(this.on.camera && frame.camera);
    if (!this.camera.hidden) paintCamera(this.camera, frame.camera, look);
    this.figures(frame, look);
  }

  figures(frame, look) {
    const { source, agent, time } = this;
    const said = (value, unit) => (value === null ? "–" : `${value.toFixed(unit === "s" ? 1 : 2)} ${unit}`);
    const replans = source.history(agent).replans.filter((one) => one.time <= time + 1e-6).length;
    const values = [`${time.toFixed(1)} s`, said(frame.clearance, "m"), said(frame.ttc, "s"), said(frame.speed, "m/s"), frame.leaf || "–", replans];
    values.forEach((value, i) => (this.values[i].textContent = value));
    this.values[1].classList.toggle("near", frame.clearance !== null && frame.clearance < 0.3);
    this.button.textContent = this.playing ? "Pause" : "Play";
    this.rate.value = this.speed;
    this.zoomed.setAttribute("aria-pressed", this.near || this.window !== null);
    [...this.chips.children].forEach((chip, i) => {
      chip.setAttribute("aria-pressed", i === agent);
      chip.firstChild.style.background = look.agents[i];
      chip.lastChild.textContent = ended(source.agents[i], time) ? source.agents[i].outcome : "";
    });
    this.ending.textContent = ending(source.agents[agent]) + left(source.agents[agent].leftOut);
    this.jump.hidden = !source.agents.some((one) => one.failed);
    this.strip.setAttribute("aria-valuenow", time.toFixed(1));
    this.strip.setAttribute("aria-valuemax", source.end.toFixed(1));
    this.strip.setAttribute("aria-valuetext", `${time.toFixed(1)} of ${source.end.toFixed(1)} s`);
    const colours = Object.fromEntries(LAYERS);
    for (const [name, swatch] of Object.entries(this.swatches)) swatch.style.color = look[colours[name] ?? name] ?? look.agents[agent];
  }

  // -------------------------------------------------------------------------------------------------------- the page

  build() {
    const { root } = this;
    root.textContent = "";
    root.tabIndex = 0;
    root.setAttribute("role", "region");
    root.setAttribute("aria-label", "player of recorded episodes");
    this.select = add(root, "select", { ariaLabel: "episode" });
    this.episodes.forEach(({ title }, i) => add(this.select, "option", { value: i, textContent: title }));
    this.select.onchange = () => this.open(Number(this.select.value));
    this.chips = add(root, "div", { className: "chips" });
    this.transport(add(root, "div", { className: "transport" }));
    this.scene = add(root, "canvas", { className: "scene", role: "img", ariaLabel: "the episode from above and from the side" });
    const beside = add(root, "div", { className: "beside" });
    const figures = add(beside, "dl", { className: "figures" });
    this.around = add(beside, "canvas", { className: "around", role: "img", ariaLabel: "what the vehicle senses around it, its bow up", hidden: true });
    this.camera = add(beside, "canvas", { className: "camera", role: "img", ariaLabel: "what its camera sees", hidden: true });
    this.values = ["time", "clearance", "time to collision", "speed", "tree", "replans"].map((name) => {
      const pair = add(figures, "div", { className: name === "tree" ? "words" : "" });
      add(pair, "dt", { textContent: name });
      return add(pair, "dd");
    });
    this.strip = add(root, "canvas", { className: "strip", tabIndex: 0, role: "slider", ariaLabel: "time", ariaValueMin: "0" });
    this.ending = add(root, "p", { className: "ending" });
    this.legend();
    this.help = add(root, "details", { className: "keys" });
    add(this.help, "summary", { textContent: "Keys" });
    add(this.help, "dl");
    this.explain(KEYS);
    this.listen();
  }

  explain(keys) {
    const list = this.help.lastChild;
    list.textContent = "";
    for (const [key, words] of keys) add(list, "dt", { textContent: key }), add(list, "dd", { textContent: words });
  }

  press(words, title, act) {
    return add(this.bar, "button", { type: "button", textContent: words, title, onclick: act });
  }

  transport(bar) {
    this.bar = bar;
    this.press("−0.1 s", "a step back (←)", () => this.step(-STEP_S));
    this.button = this.press("Play", "play or pause (space)", () => this.toggle());
    this.press("+0.1 s", "a step on (→)", () => this.step(STEP_S));
    this.rate = add(bar, "select", { ariaLabel: "speed", onchange: () => this.run(["rated", Number(this.rate.value)]) });
    for (const speed of SPEEDS) add(this.rate, "option", { value: speed, textContent: `${speed}×` });
    this.jump = this.press("To the failure", "to the moment of the failure (x)", () => this.failure());
    this.zoomed = this.press("Near", "follow the vehicle from near (z)", () => this.zoom());
    this.press("Dark, light", "switch the page (d)", () => this.theme());
  }

  rated(speed) {
    this.speed = speed;
    this.draw();
  }

  legend() {
    this.layers = add(this.root, "details", { className: "layers", open: true });
    add(this.layers, "summary", { textContent: "Layers and legend" });
    const box = add(this.layers, "div");
    Object.assign(this, { swatches: {}, ticks: {} });
    for (const [name, , words, mark] of LAYERS) {
      const label = add(box, "label");
      const tick = (this.ticks[name] = add(label, "input", { type: "checkbox", checked: this.on[name] }));
      tick.onchange = () => ((this.on[name] = tick.checked), this.draw());
      this.swatches[name] = add(label, "span", { className: `swatch ${mark}` });
      label.append(words);
    }
    for (const why of ["initial", "stuck", "safety", "intersection"]) {
      const label = add(box, "span", { className: "replans" });
      this.swatches[why] = add(label, "span", { className: "swatch" });
      label.append(`replan: ${why}`);
    }
    add(box, "span", { className: "quiet", textContent: "star: goal; dashed: wholly above or below the vehicle; bar beside a track: 1 s of its motion" });
  }

  buttons() {
    this.chips.textContent = "";
    this.source.agents.forEach(({ name }, i) => {
      const chip = add(this.chips, "button", { type: "button", title: `follow (${i + 1})`, onclick: () => this.follow(i) });
      add(chip, "span", { className: "swatch" });
      chip.append(name);
      add(chip, "span", { className: "quiet" });
    });
  }

  listen() {
    this.root.addEventListener("keydown", (event) => {
      const found = ["SELECT", "INPUT"].includes(event.target.tagName) ? null : command(event);
      if (!found || (event.key === " " && ["BUTTON", "SUMMARY"].includes(event.target.tagName))) return;
      event.preventDefault();
      this.run(found);
    });
    const scrub = (event) => {
      if (!event.buttons) return;
      const box = this.strip.getBoundingClientRect();
      this.playing = false;
      this.seek(moment(event.clientX - box.left, this.source.end, box.width));
    };
    this.strip.addEventListener("pointerdown", (event) => (this.strip.setPointerCapture(event.pointerId), scrub(event)));
    this.strip.addEventListener("pointermove", scrub);
    gestures(this.scene, (...moved) => this.moved(...moved));
    this.scene.addEventListener("click", () => this.toggle());
  }
}

function left(names) {
  return names.length ? `. Left out to keep this page small: ${names.join(", ")}` : "";
}

export function add(parent, tag, properties = {}) {
  const made = parent.appendChild(document.createElement(tag));
  return Object.assign(made, properties);
}

/** The context of a canvas that is so large in CSS pixels, sharp on any screen. */
export function sized(canvas, width, height) {
  const dense = window.devicePixelRatio || 1;
  const [wide, high] = [Math.round(width * dense), Math.round(height * dense)];
  if (canvas.width !== wide) canvas.width = wide;
  if (canvas.height !== high) canvas.height = high;
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.setTransform(dense, 0, 0, dense, 0, 0);
  return context;
}

/** Makes a player of every place on the page that holds recorded episodes. */
export function start() {
  for (const root of document.querySelectorAll(".player")) {
    const episodes = [...root.querySelectorAll("script")].map((data) => {
      const blobs = data.textContent.trim().split(/\s+/);
      let source;
      return { title: data.dataset.title, open: () => (source ??= recorded(blobs)) };
    });
    new Player(root, episodes).open(0);
  }
}
