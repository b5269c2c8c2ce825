// Headless Chromium: the packed one, or CHROME_PATH=FILE. Exit code 3 = no browser starts.
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

/** What `work` gives of a browser, printed as JSON. */
export async function inBrowser(work) {
  const browser = await launch().catch((error) => {
    console.error(error.message);
    process.exit(3);
  });
  try {
    console.log(JSON.stringify(await work(browser)));
  } finally {
    await browser.close();
  }
}

async function launch() {
  const { default: packed } = await import("@sparticuz/chromium");
  const executablePath = process.env.CHROME_PATH ?? (await packed.executablePath());
  // the sandbox needs rights that containers do not give; the pages are our own
  return chromium.launch({ executablePath, args: ["--no-sandbox", "--disable-gpu"] });
}

/** A page from disk without a network, or one of a server here; and what goes wrong or leaves it. */
export async function opened(browser, page, width, colorScheme, deviceScaleFactor = 1) {
  const served = page.startsWith("http://127.0.0.1:");
  const context = await browser.newContext({ viewport: { width, height: 900 }, deviceScaleFactor, colorScheme, offline: !served });
  const tab = await context.newPage();
  const errors = [];
  const requests = [];
  tab.on("console", (message) => ["error", "warning"].includes(message.type()) && errors.push(message.text()));
  tab.on("pageerror", (error) => errors.push(String(error)));
  tab.on("request", (request) => request.url().startsWith("data:") || requests.push(request.url()));
  const address = served ? `${page}/` : pathToFileURL(page).href;
  await tab.goto(address, { waitUntil: "load" });
  requests.splice(requests.indexOf(address), 1);
  return { context, tab, errors, requests };
}
