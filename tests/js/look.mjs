// Opens pages from disk in headless Chromium at two widths, light and dark, and tells as JSON what it met.
// node look.mjs PAGE.. : with LOOK_SHOTS=FOLDER also screenshots.
import { basename } from "node:path";
import { inBrowser, opened } from "./browser.mjs";

const pages = process.argv.slice(2);
const folder = process.env.LOOK_SHOTS;

async function look(browser, page, width, scheme) {
  const { context, tab, errors, requests } = await opened(browser, page, width, scheme);
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
  return { width, scheme, errors, requests, closed, open, printed };
}

function measure(tab) {
  return tab.evaluate(() => {
    const root = document.scrollingElement;
    const ids = [...document.querySelectorAll("[id]")].map((one) => one.id);
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
      downloads: document.querySelectorAll("a[download]").length,
      scripts: [...document.scripts].filter((one) => one.type !== "text/plain").length,
      doubleIds: ids.filter((id, i) => ids.indexOf(id) !== i),
      deadLinks: [...document.querySelectorAll('a[href^="#"]:not([href="#"])')].filter((one) => !document.getElementById(decodeURIComponent(one.hash.slice(1)))).length,
    };
  });
}

await inBrowser(async (browser) => {
  const seen = [];
  for (const page of pages)
    for (const width of [1400, 390]) for (const scheme of ["light", "dark"]) seen.push({ page, ...(await look(browser, page, width, scheme)) });
  return { version: browser.version(), seen };
});
