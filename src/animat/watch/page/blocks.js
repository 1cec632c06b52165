// Views made of tables, lists and charts.

import { Frame, colour, list, listColours, make, shown, spanOf, table, unpacked } from "./draw.js";

// Typographic minus, at-least and plus-minus signs, in texts as in numbers.
const signs = (text) => text.replace(/(^|[\s(,])-(?=\d)/g, "$1\u2212").replaceAll(">=", "\u2265").replaceAll("+- ", "\u00b1\u00a0");
const cell = (value) => (typeof value === "number" ? shown(value, 4) : signs(value ?? "none"));

export class BlocksPage {
  constructor(main) {
    this.main = main;
    this.made = [];
  }

  draw(view) {
    const key = view.blocks.map((each) => `${each.kind} ${each.width} ${each.title}`).join("\n");
    if (this.key !== key) {
      this.key = key;
      this.main.replaceChildren();
      this.made = view.blocks.map((block) => this.#make(block));
    }
    view.blocks.forEach((block, i) => {
      this.made[i].words.textContent = signs(block.words);
      this[block.kind](this.made[i], block);
    });
  }

  #make(block) {
    const words = make("p", { className: "words" });
    const body = { chart: () => make("canvas", { className: "tall" }), raster: () => make("canvas", { className: "tall" }), table: () => make("table"), facts: () => make("dl") }[block.kind]();
    if (body instanceof HTMLCanvasElement) body.setAttribute("aria-label", block.title);
    const legend = make("div", { className: "legend" });
    const held = block.kind === "table" ? make("div", { className: "table" }, body) : body;
    this.main.append(make("section", { className: block.width ?? (block.kind === "facts" ? "third" : "two-thirds") }, make("h2", { textContent: signs(block.title) }), held, legend, words));
    return { body, words, legend };
  }

  table({ body, words }, block) {
    // No head without rows.
    table(body, block.rows.length ? block.head : [], block.rows.map((row) => row.map(cell)));
    if (!block.rows.length && !block.words) words.textContent = "none";
  }

  facts({ body }, block) {
    list(body, block.rows.map(([name, value]) => [name, cell(value)]));
  }

  chart({ body, legend }, block) {
    body.hidden = !block.series.length;
    if (body.hidden) { legend.replaceChildren(); return; }
    const xs = block.series.flatMap((each) => each.x), ys = block.series.flatMap((each) => each.y);
    const frame = new Frame(body, spanOf([...xs, ...block.marks.map(([at]) => at), ...(block.until === null ? [] : [0, block.until])]), spanOf(ys), { top: block.marks.length || block.y ? 22 : 6, xLabel: block.x, isCounted: xs.every((x) => x === null || Number.isInteger(x)) });
    frame.text(block.y, 0, 10, colour("faint"));
    let free = frame.g.measureText(block.y).width + 6;
    const named = block.series.filter((each) => each.name);
    for (const each of block.series) {
      const how = { line: { width: 2.2 }, thin: { width: 0.8 }, dashed: { dashes: [5, 4] }, steps: { steps: true }, dots: null }[each.style];
      if (how) frame.line(each.x, each.y, colour(each.colour), how);
      // A single point makes no line.
      if (!how || each.x.filter((x, i) => x !== null && each.y[i] !== null).length === 1) each.x.forEach((x, i) => { if (x !== null && each.y[i] !== null) frame.dot(x, each.y[i], colour(each.colour)); });
    }
    for (const [at, what] of block.marks) {
      frame.line([at, at], frame.y, colour("red"), { dashes: [4, 3], width: 1 });
      // A label that would overlap the previous one is left out.
      const wide = frame.g.measureText(what).width, from = Math.min(frame.atX(at) - 2, frame.width - wide);
      if (from < free) continue;
      frame.text(what, from, 10, colour("faint"));
      free = from + wide + 6;
    }
    listColours(legend, named.map((each) => [each.name, colour(each.colour), each.style === "dashed" ? "dashed" : ""]));
  }

  raster({ body }, block) {
    const frame = new Frame(body, [block.from_s, block.to_s], [-0.5, Math.max(0.5, block.n_channels - 0.5)], { top: 18, left: 52, xLabel: "recording's clock (s)" });
    frame.spikes(unpacked(block.spikes.times), unpacked(block.spikes.channels), block.n_channels);
    frame.g.fillStyle = colour("red");
    for (const pulse of block.pulses_s) frame.g.fillRect(frame.atX(pulse) - 1, 4, 2, 12);
  }
}
