// Opens a page with a player in headless Chromium, shows ten moments of it, plays, and tells as JSON what was there.
// node play.mjs PAGE
import { inBrowser, opened } from "./browser.mjs";

const DENSE = 4; // pixels of the screen to one of the page: what is found on the canvas is as exact

/** Two fingers part on the scene, one moves it, one taps: how wide the window is, and where it begins. */
async function touch(tab, session) {
  await session.send("Emulation.setTouchEmulationEnabled", { enabled: true, maxTouchPoints: 2 });
  const box = await tab.locator(".scene").boundingBox();
  const window = () => tab.evaluate(() => {
    const { player } = document.querySelector(".player");
    const { view, playing } = player;
    return { metres: view.wide / view.scale, x: view.x0, playing };
  });
  const move = async (...places) => {
    for (const [i, fingers] of [...places, []].entries()) {
      const touchPoints = fingers.map(([x, y], id) => ({ x: box.x + x, y: box.y + y, id }));
      await session.send("Input.dispatchTouchEvent", { type: i ? (fingers.length ? "touchMove" : "touchEnd") : "touchStart", touchPoints });
    }
    return window();
  };
  return [
    await window(),
    await move([[500, 100], [600, 100]], [[400, 100], [700, 100]]), // three times as large
    await move([[600, 100]], [[500, 100]], [[400, 100]]),
    await move([[600, 100]]),
    await move([[600, 100]]),
    await move([[400, 100], [700, 100]], [[549, 100], [551, 100]]),
  ];
}

await inBrowser(async (browser) => {
  const { context, tab, errors, requests } = await opened(browser, process.argv[2], 1400, "light", DENSE);
  await tab.waitForFunction(() => document.querySelector(".player").player?.view);
  const ready_ms = await tab.evaluate(() => performance.now());
  const moments = await tab.evaluate((dense) => {
    const { player } = document.querySelector(".player");
    for (const name of Object.keys(player.on)) player.on[name] = false;
    return Array.from({ length: 10 }, (_, i) => shown((player.source.end * i) / 9));

    // where the hull is by the log, and where its colour is on the canvas
    function shown(time) {
      player.seek(time);
      const { view, source, scene } = player;
      const { pose, clearance } = source.frame(0, time);
      const [high, wide] = [Math.round(dense * (view.top + view.high)), scene.width];
      const copy = new OffscreenCanvas(wide, high).getContext("2d", { willReadFrequently: true });
      copy.drawImage(scene, 0, 0);
      const { data } = copy.getImageData(0, 0, wide, high);
      const [ahead, beside] = [[], []];
      const [c, s] = [Math.cos(pose[3]), Math.sin(pose[3])];
      for (let y = 0; y < high; y++)
        for (let x = 0; x < wide; x++) {
          const k = 4 * (y * wide + x);
          if (data[k] < 30 && Math.abs(data[k + 1] - 0x72) < 9 && Math.abs(data[k + 2] - 0xb2) < 9) {
            ahead.push(c * (x + 0.5) - s * (y + 0.5));
            beside.push(s * (x + 0.5) + c * (y + 0.5));
          }
        }
      const [u, v] = [ahead, beside].map((places) => places.reduce((low, one) => Math.min(low, one)) / 2 / dense + places.reduce((high, one) => Math.max(high, one)) / 2 / dense);
      const middle = [c * u + s * v, c * v - s * u];
      return { time, pose: [...pose], clearance, middle, scale: view.scale, left: view.left, top: view.top };
    }
  }, DENSE);
  await tab.focus(".player");
  const pressed = {};
  for (const key of ["Home", "ArrowRight", "Shift+ArrowRight", "End", "x", "2", "+", "l"]) {
    await tab.keyboard.press(key);
    pressed[key] = await tab.evaluate(() => {
      const { player } = document.querySelector(".player");
      return { time: player.time, agent: player.agent, speed: player.speed, open: player.layers.open, words: player.ending.textContent };
    });
  }
  const touched = await touch(tab, await context.newCDPSession(tab));
  await tab.keyboard.press("Home");
  await tab.keyboard.press("Space");
  await tab.waitForFunction(() => document.querySelector(".player").player.time > 0.2);
  return { ready_ms, moments, pressed, touched, errors, requests };
});
