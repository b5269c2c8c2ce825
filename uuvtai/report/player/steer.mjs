// Steering by keys, thumb pads and gamepad: a command is surge, sway, heave and yaw rate, each from -1 to 1 of the vehicle's limits.

/** Which part of the command a key moves, and which way; keys by their place, whatever is printed on them. */
const PARTS = {
  KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1], KeyA: [1, 1], KeyD: [1, -1], PageUp: [2, 1], KeyR: [2, 1],
  PageDown: [2, -1], KeyF: [2, -1], KeyQ: [3, 1], ArrowLeft: [3, 1], KeyE: [3, -1], ArrowRight: [3, -1],
};
const NAMES = [["ahead", "back"], ["left", "right"], ["up", "down"], ["turn left", "turn right"]];
const SLOWLY = 1 / 3;
const REST = 0.12; // a stick that is moved less is at rest
export const STEERING = [
  ["W S, ↑ ↓", "ahead, back"], ["A D", "left, right"], ["Q E, ← →", "turn left, right"], ["R F, page ↑ ↓", "up, down"],
  ["shift", "slowly"], ["space", "stop"], ["T", "the truth, what it senses"], ["gamepad, thumb pads", "left: ahead, sideways; right: turn, depth; A: stop"],
];

export class Steering {
  constructor() {
    this.pressed = new Set();
    this.slow = false;
    this.pads = [0, 0, 0, 0]; // by thumbs
  }

  /** Takes a key that is pressed or let go; whether it is one of ours. */
  key({ code, shiftKey, ctrlKey, metaKey, altKey }, down) {
    this.slow = shiftKey;
    if (code === "Space" && down) this.pressed.clear();
    if (code in PARTS) down && !(ctrlKey || metaKey || altKey) ? this.pressed.add(code) : this.pressed.delete(code);
    return (code === "Space" || code in PARTS) && !(ctrlKey || metaKey || altKey);
  }

  /** Lets go of all keys and pads. */
  release() {
    this.pressed.clear();
    this.pads.fill(0);
  }

  /** A thumb is there on a pad, the left one or the right one. */
  thumb(isLeft, right, up) {
    this.pads.splice(isLeft ? 0 : 2, 2, moved(up), -moved(right));
  }

  /** By keys, thumbs and the first gamepad that is there. */
  command(pads) {
    const pad = [...pads].find((one) => one?.connected);
    const asked = this.pads.slice();
    for (const code of this.pressed) asked[PARTS[code][0]] += PARTS[code][1] * (this.slow ? SLOWLY : 1);
    if (pad) {
      if (pad.buttons[0]?.pressed) return [0, 0, 0, 0];
      const [x, y, turn, rise] = [0, 1, 2, 3].map((i) => moved(pad.axes[i] ?? 0));
      [-y, -x, -rise, -turn].forEach((value, i) => (asked[i] += value));
    }
    return asked.map((value) => Math.min(Math.max(value, -1), 1) + 0);
  }
}

function moved(axis) {
  return Math.abs(axis) < REST ? 0 : (axis - Math.sign(axis) * REST) / (1 - REST);
}

/** A command in words. */
export function said(command) {
  const parts = command.map((value, i) => (value ? `${NAMES[i][value > 0 ? 0 : 1]} ${Math.round(100 * Math.abs(value))} %` : ""));
  return parts.filter(Boolean).join(", ") || "stop";
}
