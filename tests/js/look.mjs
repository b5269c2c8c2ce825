// Opens pages from disk in headless Chromium at two widths, light and dark, and tells as JSON what it met; exit code 3 = no browser starts.
// node look.mjs PAGE.. : with LOOK_SHOTS=FOLDER also screenshots, with CHROME_PATH=FILE that browser instead of the packed one.
import { basename } from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const pages = process.argv.slice(2);
const folder = process.env.LOOK_SHOTS;

async function launch() {
  const { default: packed } = await import("@sparticuz/chromium");
  const executablePath = process.env.CHROME_PATH ?? (await packed.executablePath());
  // the sandbox needs rights that containers do not give; the pages are our own
  return chromium.launch({ executablePath, args: ["--no-sandbox", "--disable-gpu"] });
}

async function look(browser, page, width, scheme) {
  const context = await browser.newContext({ viewport: { width, height: 900 }, colorScheme: scheme, offline: true });
  const tab = await context.newPage();
  const errors = [];
  const requests = [];
  tab.on("console", (message) => ["error", "warning"].includes(message.type()) && errors.push(message.text()));
  tab.on("pageerror", (error) => errors.push(String(error)));
  tab.on("request", (request) => request.url().startsWith("data:") || requests.push(request.url()));
  await tab.goto(pathToFileURL(page).href, { waitUntil: "load" });
  await tab.evaluate(() => {
    const known = (video) => video.readyState > 0 || video.error || new Promise((done) => (video.onloadedmetadata = video.onerror = done));
    return Promise.all([...document.querySelectorAll("video")].map(known)).then(() => undefined);
  });
  const closed = await measure(tab);
  await tab.evaluate(() => document.querySelectorAll("details").forEach((one) => (one.open = true)));
  const open = await measure(tab);
  await tab.evaluate(() => document.querySelectorAll("details").forEach((one) => (one.open = false)));
  if (folder) {
    await tab.screenshot({ path: `${folder}/${basename(page, ".html")}-${width}-${scheme}.png`, fullPage: true });
  }
  await tab.emulateMedia({ media: "print" });
  const printed = await measure(tab);
  await context.close();
  return { width, scheme, errors, requests: requests.slice(1), closed, open, printed };
}

function measure(tab) {
  return tab.evaluate(() => {
    const root = document.scrollingElement;
    const ids = [...document.querySelectorAll("[id]")].map((one) => one.id);
    const videos = [...document.querySelectorAll("video")].filter((one) => one.videoWidth > 0);
    const texts = [...document.querySelectorAll("svg text")].filter((one) => getComputedStyle(one).fill === getComputedStyle(document.body).color);
    return {
      scrollWidth: root.scrollWidth,
      innerWidth: window.innerWidth,
      title: document.title,
      background: getComputedStyle(document.body).backgroundColor,
      ink: getComputedStyle(document.body).color,
      inkedTexts: texts.length,
      svgs: document.querySelectorAll("svg").length,
      hovers: document.querySelectorAll("svg title").length,
      images: [...document.images].filter((one) => one.complete && one.naturalWidth > 0).length,
      videos: videos.length,
      downloads: document.querySelectorAll("a[download]").length,
      scripts: document.scripts.length,
      doubleIds: ids.filter((id, i) => ids.indexOf(id) !== i),
      deadLinks: [...document.querySelectorAll('a[href^="#"]:not([href="#"])')].filter((one) => !document.getElementById(decodeURIComponent(one.hash.slice(1)))).length,
    };
  });
}

const browser = await launch().catch((error) => {
  console.error(error.message);
  process.exit(3);
});
try {
  const seen = [];
  for (const page of pages)
    for (const width of [1400, 390]) for (const scheme of ["light", "dark"]) seen.push({ page, ...(await look(browser, page, width, scheme)) });
  console.log(JSON.stringify({ version: browser.version(), seen }));
} finally {
  await browser.close();
}
