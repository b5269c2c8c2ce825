// The page of running episodes: a wall of tanks, the player for the one that is followed, and the helm.
import { Painter, ended } from "./paint.mjs";
import { Player, add, sized } from "./player.mjs";
import { Running } from "./running.mjs";
import { STEERING, Steering, said } from "./steer.mjs";
import { pad } from "./touch.mjs";
import { View } from "./view.mjs";

const AGAIN_MS = 1000;
const MOST_TRIES = 60;
const STEER_MS = 50;
const WATCHING = [
  ["space", "pause, go on"], ["← →", "0.1 s back, on (shift: 1 s)"], ["end", "to now"], ["esc", "to all tanks"], ["1 … 9", "follow that tank"],
  ["z", "near, whole tank"], ["l", "layers"], ["d", "dark, light"], ["?", "these keys"],
];
const DRIVING = [...STEERING, ["P", "pause, go on"], ["Z", "near, whole tank"]];

export class Live extends Player {
  constructor(root, connect = () => new WebSocket(`ws://${location.host}/live`)) {
    super(root, []);
    Object.assign(this, { connect, tanks: [], tank: -1, now: true, role: { held: "", note: "The page connects." }, tries: 0, due: false });
    this.steering = new Steering();
    this.join();
    this.tellRole();
    setInterval(() => this.steer(), STEER_MS);
    root.focus({ preventScroll: true });
  }

  // --------------------------------------------------------------------------------------------------- the server

  join() {
    this.socket = this.connect();
    this.socket.onmessage = ({ data }) => this.told(JSON.parse(data));
    this.socket.onopen = () => {
      Object.assign(this, { tries: 0, tanks: [] }); // the server tells all of them
      if (this.tank >= 0) this.send({ follow: this.tank });
    };
    this.socket.onclose = () => {
      const last = this.role.note && this.role.note.includes("Report:") ? this.role.note : "";
      this.role = { ...this.role, helm: false, note: last || "The server has ended, or turned this page away. Trying again." };
      this.tellRole();
      if (!last && ++this.tries <= MOST_TRIES) setTimeout(() => this.join(), AGAIN_MS);
    };
  }

  send(message) {
    if (this.socket.readyState === 1) this.socket.send(JSON.stringify(message));
  }

  told(message) {
    const tank = this.tanks[message.tank];
    if (message.kind === "role") this.take(message);
    else if (message.kind === "begin") this.begin(message);
    else if (message.kind === "frame") message.tanks.forEach(([number, row]) => this.tanks[number]?.add(row));
    else if (message.kind === "detail") tank?.detail(message);
    else if (message.kind === "replan") tank?.replan(message.replan);
    else if (message.kind === "end") tank?.finish(message.end);
    this.soon();
  }

  begin(message) {
    const { tank } = message;
    this.tanks[tank] = new Running(message, this.tanks[tank]);
    if (this.tank < 0 && (message.of === 1 || this.role.steered)) this.follow(tank);
    else if (this.tank === tank) Object.assign(this, { source: this.tanks[tank], now: true }), this.buttons();
    if (this.wall.children.length !== message.of) this.hang(message.of);
  }

  take(role) {
    const first = this.role.steered === undefined;
    this.role = role;
    if (first) {
      this.explain(role.steered ? DRIVING : WATCHING);
      if (role.steered) this.ticks.around.click(), this.ticks.camera.click(); // who steers looks around
    }
    this.tellRole();
  }

  /** Draws what has come, once for all that comes before the screen's next picture. */
  soon() {
    if (this.due) return;
    this.due = true;
    requestAnimationFrame(() => {
      this.due = false;
      this.draw();
    });
  }

  // ----------------------------------------------------------------------------------------------------- commands

  /** A tank, or all of them: -1. */
  follow(tank) {
    if (tank >= 0 && !this.tanks[tank]) return;
    if (tank < 0 && this.tanks.length < 2) return;
    Object.assign(this, { tank, source: this.tanks[tank], agent: 0, now: true });
    this.send({ follow: tank });
    this.root.classList.toggle("walled", tank < 0);
    if (tank >= 0) this.buttons();
    this.root.focus({ preventScroll: true }); // the tank that was clicked is gone
    this.tellRole();
    this.soon();
  }

  seek(time) {
    this.now = time >= this.source.end - 1e-6;
    super.seek(time);
  }

  toggle() {
    if (this.now || this.tank < 0) this.send({ pause: !this.role.held });
    this.now = true;
    this.soon();
  }

  truth() {
    this.send({ truth: !this.role.truth });
  }

  run([name, argument]) {
    const none = ["faster", "rated", "episode", "failure", ...(this.tank < 0 ? ["step", "seek", "near"] : [])];
    if (!none.includes(name)) super.run([name, argument]);
  }

  // ------------------------------------------------------------------------------------------------------ the helm

  /** Sends what keys and gamepad say, over and over: the server stops a vehicle of which it hears nothing. */
  steer() {
    if (!this.role.steered || !this.role.helm) return;
    const command = this.steering.command(navigator.getGamepads?.() ?? []);
    this.send({ steer: command });
    this.commanded.textContent = said(command);
  }

  key(event, down) {
    if (["SELECT", "INPUT"].includes(event.target.tagName)) return;
    const { steered, helm } = this.role;
    const act = { Escape: () => this.follow(-1), t: () => steered && this.truth(), T: () => steered && this.truth(), p: () => steered && this.toggle() }[event.key];
    if (steered && helm && this.steering.key(event, down)) this.steer();
    else if (act && down && !event.ctrlKey && !event.metaKey && !event.altKey) act();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  listen() {
    super.listen();
    document.addEventListener("keydown", (event) => this.key(event, true), true);
    document.addEventListener("keyup", (event) => this.key(event, false), true);
    for (const [target, name] of [[window, "blur"], [document, "visibilitychange"]]) target.addEventListener(name, () => this.steering.release());
  }

  // ------------------------------------------------------------------------------------------------------- drawing

  draw() {
    if (!this.tanks?.length || !this.root.clientWidth) return;
    if (this.tank < 0) return this.drawWall();
    if (this.now) this.time = this.source.end;
    this.playing = this.now && !this.role.held;
    super.draw();
    this.back.hidden = this.tanks.length < 2;
    this.chips.lastChild.lastChild.textContent = `${this.source.title} ${this.source.agents[0].outcome}`;
  }

  drawWall() {
    this.button.textContent = this.role.held ? "Play" : "Pause";
    this.tanks.forEach((source, i) => {
      const [canvas, words] = this.wall.children[i].children;
      const [width, time] = [canvas.clientWidth, source.end];
      const view = new View(source.scene.tank, width, null, true);
      this.source = source; // whose colour it is
      new Painter(sized(canvas, width, view.height), view, this.look()).small(source, time);
      const [{ name, outcome, failed }] = source.agents;
      words.textContent = `${name}, ${source.title}: ${outcome || ""} ${time.toFixed(1)} s`;
      words.className = failed ? "failed" : "";
    });
  }

  tellRole() {
    const { held, steered, helm, note, truth } = this.role;
    const over = steered && this.tanks[0] && ended(this.tanks[0].agents[0], this.tanks[0].end);
    const start = helm ? "The first command starts: W A S D and arrows, R F for the depth, a gamepad, or thumbs." : "Nobody has begun to drive yet.";
    const words = [
      note,
      over && !note && "It is over. Others now drive the same episode; who won is told here.",
      held === "pause" && "Paused.",
      !over && held === "start" && start,
      steered && helm === false && !note && "Another page drives; this one looks on.",
    ];
    this.state.textContent = words.filter(Boolean).join(" ");
    this.asks.hidden = !steered;
    this.asks.setAttribute("aria-pressed", Boolean(truth));
    this.asks.disabled = this.button.disabled = !helm;
    this.commanded.parentElement.hidden = this.thumbs.hidden = !(steered && helm);
    this.soon();
  }

  /** A pad for each thumb, where the screen is touched. */
  pads() {
    this.thumbs = add(this.root, "div", { className: "thumbs", hidden: true });
    for (const [isLeft, words] of [[true, "ahead, sideways"], [false, "depth, turn"]]) {
      const round = add(this.thumbs, "div", { className: "pad", ariaLabel: words });
      add(round, "span", { textContent: words });
      pad(round, (right, up) => this.steering.thumb(isLeft, right, up));
    }
    this.scene.after(this.thumbs);
  }

  /** The wall: a picture a tank. */
  hang(count) {
    this.wall.textContent = "";
    for (let i = 0; i < count; i++) {
      const tank = add(this.wall, "button", { type: "button", className: "tank", title: `follow (${i + 1})`, onclick: () => this.follow(i) });
      add(tank, "canvas");
      add(tank, "span");
    }
    this.root.classList.toggle("walled", this.tank < 0);
  }

  build() {
    super.build();
    this.root.setAttribute("aria-label", "running episodes");
    this.state = add(this.root, "p", { className: "state", role: "status" });
    this.wall = add(this.root, "div", { className: "wall" });
    this.chips.after(this.state, this.wall);
    this.root.classList.add("walled");
    for (const unused of [this.select, this.rate, this.jump]) unused.remove();
    for (const button of this.bar.children) if (/0.1|Near/.test(button.textContent)) button.classList.add("one");
    this.back = this.press("All tanks", "back to the wall (esc)", () => this.follow(-1));
    this.back.classList.add("one");
    this.asks = this.press("Truth", "show what no vehicle senses (T)", () => this.truth());
    this.pads();
    const pair = add(this.root.querySelector(".figures"), "div", { className: "words" });
    add(pair, "dt", { textContent: "command" });
    this.commanded = add(pair, "dd", { textContent: "stop" });
  }
}

/** Makes the page's player show what its server runs. */
export function live() {
  new Live(document.querySelector(".player"));
}
