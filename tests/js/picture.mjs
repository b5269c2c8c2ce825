// A picture, or with .gif an episode, as a report's player shows it, light:
// node picture.mjs PAGE --episode 3 --agent bt --time 9.4 --out FILE.png, or --speed 4 --fps 5 --out FILE.gif
import { execFileSync } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { inBrowser, opened } from "./browser.mjs";

const [page, ...words] = process.argv.slice(2);
const given = Object.fromEntries(words.map((word, i) => [word.replace("--", ""), words[i + 1]]).filter((_, i) => i % 2 === 0));
const moves = given.out.endsWith(".gif");

/** What belongs to the page, not to the picture, is not shown. */
const STYLE = `body { padding: 0 !important } header, p, figure, table { display: none } .player { margin: 0 !important; border: none !important }
  :is(.transport, .keys, .figures, .ending, .player select, summary, .layers input), label:has(input:not(:checked)) { display: none !important }
  ${moves ? ".chips, .layers { display: none !important }" : ""}`;

/** Frames of one palette, so that what stands still costs nothing: the last one stays. */
const GIF = `import sys
from PIL import Image
out, gap, *names = sys.argv[1:]
frames = [Image.open(name).convert("RGB") for name in names]
some = frames[:: max(len(frames) // 4, 1)]
sheet = Image.new("RGB", (frames[0].width, len(some) * frames[0].height))
for i, frame in enumerate(some):
    sheet.paste(frame, (0, i * frame.height))
known = sheet.quantize(64, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
frames = [frame.quantize(palette=known, dither=Image.Dither.NONE) for frame in frames]
times = [int(gap)] * (len(frames) - 1) + [2000]
frames[0].save(out, save_all=True, append_images=frames[1:], duration=times, loop=0, optimize=True)`;

/** Opens the episode of that number and follows the agent; how long it drives [s]. */
async function opens({ episode, agent }) {
  const { player } = document.querySelector(".player");
  const wanted = player.episodes.findIndex(({ title }) => title.split(":")[0].endsWith(`episode ${episode}`));
  if (wanted < 0) throw new Error(`no episode ${episode} on this page`);
  await player.open(wanted);
  const followed = player.source.agents.findIndex(({ name }) => name === agent);
  if (followed < 0) throw new Error(`no agent ${agent} in this episode`);
  player.follow(followed);
  return player.source.agents[player.agent].end;
}

await inBrowser(async (browser) => {
  const { tab } = await opened(browser, page, ...(moves ? [640, "light", 1] : [900, "light", 2]));
  await tab.waitForFunction(() => document.querySelector(".player").player?.view);
  await tab.addStyleTag({ content: STYLE });
  const end = await tab.evaluate(opens, given);
  const show = async (time, path) => {
    await tab.evaluate((at) => document.querySelector(".player").player.seek(at), time);
    await tab.locator(".player").screenshot({ path });
    return path;
  };
  if (!moves) return show(Number(given.time), given.out);
  const folder = mkdtempSync(join(tmpdir(), "picture-"));
  const frames = [];
  for (let i = 0; i * given.speed < end * given.fps; i++) frames.push(await show((i * given.speed) / given.fps, join(folder, `${i}.png`)));
  frames.push(await show(end, join(folder, "end.png")));
  execFileSync("python3", ["-c", GIF, given.out, String(Math.round(1000 / given.fps)), ...frames]);
  rmSync(folder, { recursive: true });
  return given.out;
});
