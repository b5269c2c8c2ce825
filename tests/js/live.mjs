// Looks at running episodes, or drives, in headless Chromium, and tells as JSON what it met.
// node live.mjs wall|drive|shots URL : with LOOK_SHOTS=FOLDER also screenshots.
import { inBrowser, opened } from "./browser.mjs";

const [what, address] = process.argv.slice(2);
const folder = process.env.LOOK_SHOTS;
const shot = (tab, name) => folder && tab.screenshot({ path: `${folder}/${name}.png`, fullPage: true });
const inPlayer = (tab, work) => tab.evaluate(`(() => { const { player } = document.querySelector(".player"); return ${work}; })()`);

/** Asks again and again: the page's policy lets nobody evaluate in it. */
async function until(tab, work) {
  for (const end = Date.now() + 200_000; Date.now() < end; await tab.waitForTimeout(30)) if (await inPlayer(tab, work)) return;
  throw new Error(`never: ${work}`);
}

const ready = (tab) => until(tab, "player?.tanks?.length");

/** A wall of tanks: look at one of them, back, pause. */
async function wall(browser) {
  const { tab, errors, requests } = await opened(browser, address, 1400, "light");
  await ready(tab);
  await until(tab, "player.tanks.length > 2 && player.tanks.every((one) => one.end > 1)");
  await shot(tab, "wall");
  const names = await tab.locator(".tank span").allTextContents();
  await tab.click(".tank:nth-child(2)");
  await until(tab, "player.source.maps.length > 1 && player.source.details.length > 20 && player.view");
  await shot(tab, "followed");
  const past = await inPlayer(tab, "player.source.past.time");
  const seen = await inPlayer(tab, "({ tank: player.tank, echoes: player.source.details.at(-1).echoes.length, words: player.ending.textContent })");
  await tab.keyboard.press("Space");
  await until(tab, "player.role.held === 'pause'");
  const second = await opened(browser, address, 390, "dark"); // comes while it is paused
  await ready(second.tab);
  const paused = await inPlayer(tab, "player.source.end"); // what was on its way has come
  const other = await inPlayer(second.tab, "({ end: player.tanks[1].end, helm: player.role.helm })");
  await tab.keyboard.press("ArrowLeft");
  const back = await inPlayer(tab, "({ time: player.time, now: player.now })");
  await tab.keyboard.press("End");
  await tab.keyboard.press("Space");
  await until(tab, `player.source.end > ${paused}`);
  await tab.keyboard.press("Escape");
  const walled = await inPlayer(tab, "({ tank: player.tank, hidden: player.scene.clientWidth === 0 })");
  return { names, past, seen, paused, other, back, walled, errors: [...errors, ...second.errors], requests };
}

async function pause(tab, on) {
  await tab.keyboard.press("p");
  await until(tab, `(player.role.held === "pause") === ${on}`);
}

/** Pads are there for thumbs only; the left one is held at its upper edge. */
async function thumb(tab, session) {
  const before = await tab.locator(".pad").first().isVisible();
  await session.send("Emulation.setTouchEmulationEnabled", { enabled: true, maxTouchPoints: 2 });
  const { x, y, width } = await tab.locator(".pad").first().boundingBox();
  await session.send("Input.dispatchTouchEvent", { type: "touchStart", touchPoints: [{ x: x + width / 2, y: y + 20 }] });
  await until(tab, "player.commanded.textContent === 'ahead 100 %'");
  await shot(tab, "thumbs");
  await session.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
  await until(tab, "player.commanded.textContent === 'stop'");
  return [before, await tab.locator(".pad").count()];
}

/** Waits for the start, steers, asks for the truth, lets go; a second page only looks on. */
async function drive(browser) {
  const { context, tab, errors, requests } = await opened(browser, address, 1400, "light");
  await ready(tab);
  const second = await opened(browser, address, 390, "dark");
  await ready(second.tab);
  await until(second.tab, "player.role.helm === false");
  await second.tab.keyboard.press("w");
  const begun = await inPlayer(tab, "({ end: player.source.end, held: player.role.held, words: player.state.textContent, truth: player.source.scene.obstacles.length })");
  await tab.keyboard.down("w");
  await until(tab, "player.source.end > 1");
  await pause(tab, true); // whatever takes its time does it while the episode waits
  await shot(tab, "driven");
  const driven = await inPlayer(tab, "({ end: player.source.end, speed: player.source.past.speed.at(-1), clearance: player.source.frame(0, 99).clearance, said: player.commanded.textContent })");
  await tab.keyboard.press("t");
  await until(tab, "player.role.truth && player.source.scene.obstacles.length && player.source.frame(0, 99).clearance !== null");
  await shot(tab, "truth");
  await shot(second.tab, "second");
  await tab.keyboard.up("w");
  await tab.keyboard.press("Space");
  await until(tab, "player.commanded.textContent === 'stop'");
  const touched = await thumb(tab, await context.newCDPSession(tab));
  await pause(tab, false);
  await until(tab, `player.source.end > ${driven.end + 0.3}`);
  await tab.keyboard.down("s"); // until it is over
  await until(tab, "/Report: /.test(player.role.note ?? '')");
  await shot(tab, "over");
  return { begun, driven, touched, note: await inPlayer(tab, "player.state.textContent"), errors: [...errors, ...second.errors], requests };
}

/** Wall and one tank as they are, at both widths, light and dark. */
async function shots(browser) {
  const seen = [];
  for (const width of [1400, 390])
    for (const scheme of ["light", "dark"]) {
      const { context, tab, errors } = await opened(browser, address, width, scheme);
      await ready(tab);
      const many = await inPlayer(tab, "player.tanks.length > 1");
      if (many) {
        await tab.waitForTimeout(1500);
        await shot(tab, `wall-${width}-${scheme}`);
        await tab.click(".tank:nth-child(1)");
      }
      await until(tab, "player.source?.maps.length && player.view");
      await tab.waitForTimeout(3000);
      await shot(tab, `tank-${width}-${scheme}`);
      const { scrollWidth } = await tab.evaluate(() => ({ scrollWidth: document.scrollingElement.scrollWidth }));
      seen.push({ width, scheme, scrollWidth, errors });
      await context.close();
    }
  return seen;
}

await inBrowser({ wall, drive, shots }[what]);
