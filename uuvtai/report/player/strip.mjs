// The time strip: clearance, time to collision, speed and the tree's node over the episode, replans as ticks.

const ROWS = [["clearance", "clearance m", 1], ["ttc", "TTC s", 10], ["speed", "speed m/s", 1]];
const [LEFT, RIGHT, ROW, BAND] = [84, 10, 40, 16];
export const STRIP_HEIGHT = ROWS.length * ROW + BAND + 44;

/** Where a moment is on a strip so wide, and back. */
export function place(time, end, width) {
  return LEFT + (width - LEFT - RIGHT) * (end > 0 ? time / end : 0);
}

export function moment(x, end, width) {
  return Math.min(Math.max((x - LEFT) / (width - LEFT - RIGHT), 0), 1) * end;
}

/** The largest value of a row's scale: what is there, rounded up, at least its least. */
export function most(values, least) {
  let found = least;
  for (const value of values ?? []) if (value > found) found = value;
  return least === 10 ? 10 : Math.ceil(found);
}

export function paintStrip(context, width, source, agent, time, look) {
  const history = source.history(agent);
  const x = (moment) => place(moment, source.end, width);
  context.fillStyle = look.paper;
  context.fillRect(0, 0, width, STRIP_HEIGHT);
  ROWS.forEach(([name, words, least], i) => {
    const low = (i + 1) * ROW;
    const top = most(history[name], least);
    text(context, look, words, LEFT - 8, low - 10, "right");
    text(context, look, `${top}`, LEFT - 8, low - 26, "right", 10);
    rule(context, look.faint, LEFT, width - RIGHT, low);
    if (name === "clearance" && look.on.ghosts) {
      source.agents.forEach((_, other) => {
        const theirs = source.history(other);
        if (other !== agent) curve(context, theirs.time, theirs[name], x, low, top, look.agents[other], 0.35);
      });
    }
    curve(context, history.time, history[name], x, low, top, look.agents[agent], 1);
  });
  const low = ROWS.length * ROW + 6;
  band(context, history, x, low, look);
  for (const { time: at, why } of history.replans) {
    context.fillStyle = look[why] ?? look.grey;
    context.fillRect(x(at) - 1, low + BAND + 3, 2, 8);
  }
  text(context, look, "replans", LEFT - 8, low + BAND + 11, "right");
  axis(context, source, x, low + BAND + 28, look);
  marks(context, source, agent, time, x, low + BAND + 12, look);
}

/** A line, broken where nothing is known: null rows and values below 0 of the time to collision. */
function curve(context, times, values, x, low, top, colour, alpha) {
  if (!values) return;
  context.globalAlpha = alpha;
  context.beginPath();
  let open = false;
  for (let i = 0; i < times.length; i++) {
    const known = values[i] >= -0.5 && !(top === 10 && (values[i] < 0 || values[i] > 10));
    const y = low - ((ROW - 8) * Math.min(Math.max(values[i], 0), top)) / top;
    if (known) open ? context.lineTo(x(times[i]), y) : context.moveTo(x(times[i]), y);
    open = known;
  }
  context.strokeStyle = colour;
  context.lineWidth = 1.5;
  context.stroke();
  context.globalAlpha = 1;
}

/** Which node of the tree drove, as bars with names where they fit; a gap where the vehicle was held and none did. */
function band(context, history, x, top, look) {
  text(context, look, "tree", LEFT - 8, top + 12, "right");
  const { time, leaf, leaves } = history;
  if (!leaf) return;
  for (let from = 0, i = 1; i <= time.length; i++) {
    if (i < time.length && leaf[i] === leaf[from]) continue;
    const [left, right] = [x(time[from]), x(time[Math.min(i, time.length - 1)])];
    const name = leaves[leaf[from]] ?? "";
    context.fillStyle = leafColour(name, look);
    if (name) context.fillRect(left, top, Math.max(right - left, 1), BAND);
    context.font = `11px ${look.font}`;
    if (context.measureText(name).width < right - left - 8) text(context, { ...look, grey: look.paper }, name, left + 4, top + 12, "left", 11);
    from = i;
  }
}

/** By the node's name, so that it is the same for all agents. */
export function leafColour(name, look) {
  const known = { FollowRoute: look.route, Evade: look.dynamic }[name];
  const sum = [...name].reduce((total, character) => total + character.codePointAt(0), 0);
  return known ?? [look.stuck, look.echo, look.mover, look.grey][sum % 4];
}

function axis(context, source, x, y, look) {
  const step = [1, 2, 5, 10, 20, 50, 100, 500].find((gap) => source.end / gap <= 10) ?? 1000;
  for (let at = 0; at <= source.end + 1e-6; at += step) text(context, look, at ? `${at}` : "0 s", x(at), y, "center");
}

/** Where each agent ended, and the moment that is shown. */
function marks(context, source, agent, time, x, bottom, look) {
  source.agents.forEach((one, i) => {
    if (!one.failed || (i !== agent && !look.on.ghosts)) return;
    context.globalAlpha = i === agent ? 1 : 0.45;
    context.fillStyle = look.failed;
    context.fillRect(x(one.end) - 1, 6, 2, bottom - 6);
    text(context, { ...look, grey: look.failed }, "×", x(one.end) - 5, 14, "right", 14);
    context.globalAlpha = 1;
  });
  context.fillStyle = look.ink;
  context.fillRect(x(time) - 0.75, 2, 1.5, bottom);
  context.beginPath();
  context.moveTo(x(time) - 5, 0);
  context.lineTo(x(time) + 5, 0);
  context.lineTo(x(time), 7);
  context.fill();
}

function rule(context, colour, left, right, y) {
  context.fillStyle = colour;
  context.fillRect(left, y, right - left, 1);
}

function text(context, look, words, x, y, align, size = 12) {
  context.font = `${size}px ${look.font}`;
  context.textAlign = align;
  context.fillStyle = look.grey;
  context.fillText(words, x, y);
}
