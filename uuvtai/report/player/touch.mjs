// Fingers and mouse: two fingers, or a trackpad's, zoom and move the scene, one moves it; thumb pads steer.

const STILL_PX = 5;

/** Calls `act(factor, from, to)`: what is at pixel `from` is to be at `to`, so many times as large. A click that dragged is none. */
export function gestures(canvas, act) {
  const fingers = new Map();
  let dragged = false;
  const place = ({ clientX, clientY }) => {
    const box = canvas.getBoundingClientRect();
    return { x: clientX - box.left, y: clientY - box.top };
  };
  const middle = () => {
    const [a, b = a] = fingers.values();
    return { x: 0.5 * (a.x + b.x), y: 0.5 * (a.y + b.y), spread: Math.hypot(a.x - b.x, a.y - b.y) || 1 };
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button || fingers.size > 1) return;
    dragged = fingers.size > 0;
    fingers.set(event.pointerId, place(event));
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const [before, now] = [fingers.get(event.pointerId), place(event)];
    if (!before || (!dragged && Math.hypot(now.x - before.x, now.y - before.y) < STILL_PX)) return;
    dragged = true;
    const from = middle();
    fingers.set(event.pointerId, now);
    const to = middle();
    act(to.spread / from.spread, from, to);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, ({ pointerId }) => fingers.delete(pointerId));
  canvas.addEventListener("click", (event) => dragged && event.stopImmediatePropagation());
  canvas.addEventListener("touchmove", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // the page scrolls
    event.preventDefault();
    act(Math.exp(-0.01 * event.deltaY), place(event), place(event));
  }, { passive: false });
}

/** Makes an element a pad: `told(right, up)`, each from -1 to 1, while a finger is on it, and 0 when it has gone. */
export function pad(root, told) {
  const knob = root.firstChild;
  const say = (right, up) => {
    knob.style.transform = `translate(${40 * right}%, ${-40 * up}%)`;
    told(right, up);
  };
  const follow = (event) => {
    if (!root.hasPointerCapture(event.pointerId)) return;
    const { left, top, width, height } = root.getBoundingClientRect();
    const [x, y] = [2 * (event.clientX - left) / width - 1, 1 - 2 * (event.clientY - top) / height];
    say(...[x, y].map((part) => Math.min(Math.max(1.5 * part, -1), 1)));
  };
  root.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    root.setPointerCapture(event.pointerId);
    follow(event);
  });
  root.addEventListener("pointermove", follow);
  root.addEventListener("lostpointercapture", () => say(0, 0));
}
