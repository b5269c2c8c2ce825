// A picture of a moment as a report's player shows it, light:
// node picture.mjs PAGE --episode 3 --agent bt --time 9.4 --width 900 --out FILE.png
import { inBrowser, opened } from "./browser.mjs";

const [page, ...words] = process.argv.slice(2);
const given = Object.fromEntries(words.map((word, i) => [word.replace("--", ""), words[i + 1]]).filter((_, i) => i % 2 === 0));

/** What belongs to the page, not to the picture, is not shown. */
const STYLE = `.player { margin: 0 !important; border: none !important }
  :is(.transport, .keys, .figures, .ending, .player select, summary, .layers input), label:has(input:not(:checked)) { display: none !important }`;

await inBrowser(async (browser) => {
  const { tab } = await opened(browser, page, Number(given.width ?? 900), "light", 2);
  await tab.waitForFunction(() => document.querySelector(".player").player?.view);
  await tab.addStyleTag({ content: STYLE });
  await tab.evaluate(async ({ episode, agent, time }) => {
    const { player } = document.querySelector(".player");
    const wanted = player.episodes.findIndex(({ title }) => title.split(":")[0].endsWith(`episode ${episode}`));
    if (wanted < 0) throw new Error(`no episode ${episode} on this page`);
    await player.open(wanted);
    player.follow(player.source.agents.findIndex(({ name }) => name === agent));
    player.seek(Number(time));
  }, given);
  await tab.locator(".player").screenshot({ path: given.out });
  return given.out;
});
