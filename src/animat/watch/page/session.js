// The view of a closed loop.

import { Frame, colour, list, listColours, make, ordered, series, shown, spanOf, table, unpacked } from "./draw.js";

// The same left margin for every canvas over time, so that their times line up.
const LEFT = 52, CLOCK = "session's clock (s)";
const units = (column) => column.replaceAll("_per_", "/").replace(/_([^_]+)$/, (all, unit) => (/^(m|s|rad|deg|Hz|V|N)(\/.*)?$/.test(unit) ? ` (${unit})` : all)).replaceAll("_", " ");

function card(main, kind, title, canvasKind = "") {
  const canvas = make("canvas", { className: canvasKind }), words = make("p", { className: "words" });
  const section = make("section", { className: kind }, make("h2", { textContent: title }), canvas, words);
  canvas.setAttribute("aria-label", title);
  main.append(section);
  return { canvas, words, section };
}

export class SessionPage {
  constructor(main, about, urlOf) {
    this.about = about;
    this.urlOf = urlOf;
    this.picture = null;
    this.now = make("dl", { id: "now" });
    this.robot = make("canvas", { className: "robot", hidden: true });
    this.robot.setAttribute("aria-label", "the robot");
    this.robotWords = make("p", { className: "words", textContent: "no picture yet" });
    main.append(make("section", { className: "third" }, make("h2", { textContent: "Robot" }), this.robot, this.robotWords, this.now));
    this.raster = card(main, "two-thirds", "Spikes by channel", "tall");
    this.legend = make("div", { className: "legend", id: "legend" });
    this.raster.section.insertBefore(this.legend, this.raster.words);
    this.response = card(main, "half", "Response (Hz per channel) against thresholds");
    this.command = card(main, "half", "Command");
    this.array = card(main, "third", "Array: firing rate of each channel", "square");
    this.observed = make("section", { className: "two-thirds" }, make("h2", { textContent: "Observation" }));
    const grid = make("div", { className: "pair" });
    this.observed.append(grid);
    main.append(this.observed);
    this.observations = about.observed.map((name) => {
      const canvas = make("canvas", { className: "low" }), words = make("p", { className: "words" });
      canvas.setAttribute("aria-label", units(name));
      grid.append(make("div", {}, words, canvas));
      return { canvas, words };
    });
    if (!about.observed.length) this.observed.append(make("p", { className: "words", textContent: "the log has no observations" }));
    this.total = card(main, "half", "Return so far in the episode");
    this.late = card(main, "half", "Lateness and time to decide (ms)");
    this.agentTable = make("table", { id: "agents" });
    this.returns = card(main, "", "Return of whole episodes: predicted and measured", "tall");
    this.returns.section.append(make("div", { className: "table" }, this.agentTable));
    this.drift = card(main, "half", "Percentiles of the responses over the session (Hz)");
    this.totals = make("dl", { id: "totals" });
    this.faults = make("table", { id: "faults" });
    this.faultWords = make("p", { className: "words" });
    main.append(make("section", { className: "half" }, make("h2", { textContent: "So far" }), this.totals, make("h2", { textContent: "Faults" }), this.faultWords, make("div", { className: "table" }, this.faults)));
  }

  condition(i) { return ordered(i, this.about.conditions.length); }

  draw(view) {
    const { ticks } = view;
    const last = ticks.number.length - 1;
    this.span = [view.from_s, view.to_s];
    this.#drawNow(view, last);
    this.#drawRaster(view);
    this.#drawArray(view);
    this.#drawResponse(view, last);
    this.#drawCommand(ticks, last);
    this.#drawObservations(ticks, last);
    this.#drawTotal(ticks, last);
    this.#drawLate(view, last);
    this.#drawAgents(view);
    this.#drawDrift(view);
    this.#listTotals(view);
  }

  #drawNow(view, last) {
    const { ticks } = view, { about } = this;
    if (last < 0) {
      this.now.replaceChildren();
      this.robotWords.textContent = "no stimulus was presented in this span";
      return;
    }
    const at = (name) => ticks[name][last];
    const label = (i) => about.conditions[i] ?? "not known";
    const command = at("command"), handled = at("handled");
    list(this.now, [
      ["tick", shown(at("number"))],
      ["time", `${shown(at("time_s"), 7)} s`],
      ["agent", at("agent")],
      ["episode, iteration", `${shown(at("episode"))}, ${at("iteration") < 0 ? "warm-up" : shown(at("iteration"))} (counted from 0)`],
      ["stimulus", at("chosen") === at("delivered") ? label(at("delivered")) : `${label(at("delivered"))} (chosen: ${label(at("chosen"))})`],
      ["response", `${shown(at("rate_hz"), 6)} Hz per channel, ${shown(at("spikes"))} spikes${at("is_burst") ? ", a burst" : ""}${handled === "used" ? "" : `, ${handled}`}`],
      ["command", command.length ? command.map((each) => shown(each)).join(", ") : "none: the robot was not moved"],
      ["reward", at("reward") === null ? "none" : shown(at("reward"))],
      ["return so far", at("total") === null ? "being added up" : shown(at("total"), 6)],
    ]);
    this.#drawRobot(view.picture);
  }

  #drawRobot(wanted) {
    if (!this.about.is_drawn) {
      this.robotWords.textContent = "no picture: this robot is not known here, or cannot be drawn";
      return;
    }
    if (wanted === null || wanted === this.picture || this.loading) return;
    this.loading = true;
    this.picture = wanted;
    this.#loadRobot(wanted).then(
      () => { this.robot.hidden = false; this.robotWords.textContent = ""; },
      () => { this.robot.hidden = true; this.robotWords.textContent = "no picture of this tick"; },
    ).finally(() => { this.loading = false; });
  }

  // Into one canvas: successive images in an element stay in the browser's memory, as does a response that is not read.
  async #loadRobot(wanted) {
    const response = await fetch(this.urlOf("robot.png", { at: wanted }), { cache: "no-store" });
    const content = await response.blob();
    if (!response.ok) throw new Error(`status ${response.status}`);
    const image = await createImageBitmap(content);
    this.robot.width = image.width;
    this.robot.height = image.height;
    this.robot.getContext("2d").drawImage(image, 0, 0);
    image.close();
  }

  #drawRaster(view) {
    const n = this.about.channels.x_um.length;
    const frame = new Frame(this.raster.canvas, this.span, [-0.5, Math.max(n - 0.5, 0.5)], { top: 18, left: LEFT, xLabel: CLOCK });
    frame.spikes(unpacked(view.spikes.times), unpacked(view.spikes.channels), n);
    const { ticks } = view;
    let pulses = 0;
    ticks.pulse_time_s.forEach((times, i) => {
      for (const time of times) {
        if (time < this.span[0] || time > this.span[1]) continue;
        pulses += 1;
        frame.g.fillStyle = this.condition(ticks.delivered[i]);
        frame.g.fillRect(frame.atX(time) - 1, 4, 2, 12);
      }
    });
    const thin = view.spikes.every > 1 ? `; every ${view.spikes.every}th is drawn` : "";
    this.raster.words.textContent = view.spikes.n || n
      ? `${shown(view.spikes.n)} spikes on ${shown(n)} channels in ${shown(this.span[1] - this.span[0])} s${thin}; ${shown(pulses)} pulses, marked above the frame in the colour of their stimulus`
      : "the log has no spikes";
    if (!this.legendOf || this.legendOf !== colour("paper")) {
      this.legendOf = colour("paper");
      listColours(this.legend, this.about.conditions.map((label, i) => [label, this.condition(i)]));
    }
  }

  #drawArray(view) {
    const { x_um: x, y_um: y, electrode } = this.about.channels;
    const placed = x.map((_, i) => i).filter((i) => x[i] !== null && y[i] !== null);
    if (!placed.length) {
      this.array.words.textContent = "the log has no channel positions";
      this.array.canvas.hidden = true;
      return;
    }
    // Nothing has happened yet at the start of a session.
    const seconds = Math.max(this.span[1] - this.span[0], 1e-9);
    const rates = view.counts.map((each) => each / seconds);
    const sorted = [...rates].sort((a, b) => a - b);
    const most = Math.max(sorted[Math.floor(0.98 * (sorted.length - 1))] ?? 0, 1e-9);
    let [across, down] = [x, y].map((each) => spanOf(placed.map((i) => each[i]), 20));
    const { canvas } = this.array;
    const width = canvas.clientWidth - 50, height = canvas.clientHeight - 45;
    // The same scale in both directions.
    const scale = Math.max((across[1] - across[0]) / width, (down[1] - down[0]) / height);
    const widened = (span, px) => { const middle = (span[0] + span[1]) / 2, half = (px * scale) / 2; return [middle - half, middle + half]; };
    across = widened(across, width);
    down = widened(down, height);
    const frame = new Frame(canvas, across, [down[1], down[0]], { xLabel: "x and y (µm)", left: 44 });
    const steps = 12;
    for (const i of placed) {
      frame.g.fillStyle = ordered(Math.round(Math.min(1, rates[i] / most) * (steps - 1)), steps);
      frame.g.fillRect(frame.atX(x[i]) - 1.5, frame.atY(y[i]) - 1.5, 3, 3);
    }
    const pulsed = new Set(view.pulsed.filter((each) => each !== null)), ringed = placed.filter((i) => pulsed.has(electrode[i]));
    for (const i of ringed) frame.dot(x[i], y[i], colour("red"), { radius: 6, ring: true });
    const unread = pulsed.size - ringed.length;
    const where = pulsed.size ? `last pulse on electrodes ${[...pulsed].join(", ")}, ringed${unread > 0 ? `; no channel reads ${unread} of them` : ""}` : "no pulse at the last tick";
    this.array.words.textContent = `0 to ${shown(most, 3)} Hz (the brightest), mean ${shown(rates.reduce((a, b) => a + b, 0) / Math.max(1, rates.length), 3)} Hz; ${where}`;
  }

  #drawResponse(view, last) {
    const { ticks } = view;
    const changes = [[-Infinity, this.about.percentiles_hz], ...view.percentiles].filter(([from], i, all) => from <= this.span[1] && (all[i + 1]?.[0] ?? Infinity) > this.span[0]);
    const now = changes.at(-1)[1];
    // Bursts would flatten all other responses: they are drawn at the upper edge.
    const sorted = ticks.rate_hz.filter((each, i) => each !== null && !ticks.is_burst[i]).sort((a, b) => a - b);
    const high = sorted[Math.floor(0.97 * (sorted.length - 1))] ?? 1;
    const frame = new Frame(this.response.canvas, this.span, [0, Math.max(high, now[9] ?? 0, 1e-6) * 1.25], { left: LEFT, xLabel: CLOCK });
    for (const which of this.about.thresholds) {
      const xs = [...changes.map(([from]) => Math.max(from, this.span[0])), this.span[1]];
      const ys = [...changes.map(([, of]) => of[which] ?? null), now[which] ?? null];
      frame.line(xs, ys, colour("grey"), { steps: true, width: 1, dashes: [4, 3] });
    }
    ticks.rate_hz.forEach((rate, i) => {
      if (rate !== null && ticks.time_s[i] !== null) frame.dot(ticks.time_s[i], rate, ticks.is_burst[i] ? colour("red") : this.condition(ticks.delivered[i]), { ring: Boolean(ticks.is_burst[i]) });
    });
    const thresholds = this.about.thresholds.map((i) => shown(now[i], 3)).join(", ");
    const response = last < 0 ? "no response in this span" : `last response ${shown(ticks.rate_hz[last], 6)} Hz per channel`;
    const of = this.about.readouts.length > 1 ? ` of ${this.about.readouts[0]}, the first of ${this.about.readouts.length} readouts` : "";
    this.response.words.textContent = `${response}; thresholds${of} (dashed, ${this.about.adaptive ? "adaptive" : "fixed"}): ${thresholds} Hz. A dot has the colour of its stimulus, a ring is a burst; responses above the frame are drawn at its edge.`;
  }

  // Draws known values over time; lines do not connect episodes. Returns the first tick of each episode.
  #lines(frame, ticks, values, stroke, options) {
    const firsts = ticks.episode.map((_, i) => i).filter((i) => i === 0 || ticks.episode[i] !== ticks.episode[i - 1]);
    firsts.forEach((first, run) => {
      const known = values.map((_, i) => i).slice(first, firsts[run + 1]).filter((i) => values[i] !== null);
      frame.line(known.map((i) => ticks.time_s[i]), known.map((i) => values[i]), stroke, options);
    });
    return firsts;
  }

  #drawCommand(ticks, last) {
    const frame = new Frame(this.command.canvas, this.span, [-1.1, 1.1], { left: LEFT, xLabel: CLOCK, yMarks: [-1, -0.5, 0, 0.5, 1] });
    const n = Math.max(0, ...ticks.command.map((each) => each.length));
    for (let k = 0; k < n; k += 1) this.#lines(frame, ticks, ticks.command.map((each) => each[k] ?? null), series(k), { steps: true });
    const now = last < 0 ? [] : ticks.command[last];
    const names = this.about.readouts.length > 1 ? this.about.readouts : [];
    const words = now.map((each, k) => `${names[k] ? `${names[k]}: ` : ""}${shown(each)}`).join(", ");
    this.command.words.textContent = now.length ? `now ${words}, by the mapping ${this.about.mapping}` : "the robot was not moved at the last tick";
  }

  #drawObservations(ticks, last) {
    this.observations.forEach(({ canvas, words }, k) => {
      const values = ticks.observation.map((each) => each[k] ?? null);
      const frame = new Frame(canvas, this.span, spanOf(values, 1e-6), { top: 4, left: LEFT, xLabel: CLOCK });
      this.#lines(frame, ticks, values, series(k));
      const now = last < 0 ? null : values[last];
      words.textContent = `${units(this.about.observed[k])}: ${now === null ? "none at the last tick" : shown(now, 5)}`;
    });
  }

  #drawTotal(ticks, last) {
    const frame = new Frame(this.total.canvas, this.span, spanOf([0, ...ticks.total], 0.5), { left: LEFT, xLabel: CLOCK });
    for (const first of this.#lines(frame, ticks, ticks.total, colour("blue"), { steps: true })) {
      const x = frame.atX(ticks.time_s[first]);
      if (x > frame.left - 1 && x + frame.g.measureText(ticks.agent[first]).width < frame.right - 3) frame.text(ticks.agent[first], x + 3, frame.top + 9, colour("faint"));
    }
    this.total.words.textContent = last < 0 ? "no episode in this span" : `${ticks.agent[last]}, episode ${shown(ticks.episode[last])}: ${ticks.total[last] === null ? "being added up" : shown(ticks.total[last], 6)}; the sum restarts with each episode`;
  }

  #drawLate(view, last) {
    const { ticks } = view;
    const late = ticks.late_s.map((each) => (each === null ? null : each * 1000)), decided = ticks.decided_s.map((each) => (each === null ? null : each * 1000));
    const frame = new Frame(this.late.canvas, this.span, [0, spanOf([1, ...late, ...decided])[1]], { left: LEFT, xLabel: CLOCK });
    ticks.time_s.forEach((time, i) => {
      if (time === null) return;
      if (decided[i] !== null) frame.dot(time, decided[i], colour("blue"), { radius: 1.8 });
      if (late[i]) frame.dot(time, late[i], colour("red"), { radius: 3, ring: true });
    });
    this.late.words.textContent = last < 0 ? "no tick in this span" : `last pulse ${late[last] ? `${shown(late[last], 3)} ms late` : "in time"} (late: red rings), decided in ${shown(decided[last], 3)} ms (blue dots); ${view.late ? `late ticks in total: ${shown(view.late)}, the latest by ${shown(view.latest_s === null ? null : view.latest_s * 1000, 3)} ms` : "no tick was late so far"}`;
  }

  #drawAgents(view) {
    const { agents } = view;
    const rows = Math.max(1, agents.length);
    this.returns.canvas.style.height = `${Math.max(90, 26 * rows + 40)}px`;
    const all = agents.flatMap((each) => [...each.returns, ...(each.predicted ?? [])]);
    const names = agents.map((each) => each.name);
    const frame = new Frame(this.returns.canvas, spanOf(all, 0.5), [rows - 0.5, -0.5], { yMarks: names.map((_, i) => i), yLabels: names.map((name) => (name.length > 18 ? `${name.slice(0, 17)}…` : name)), xLabel: "return" });
    agents.forEach((each, i) => {
      const y = frame.atY(i), { g } = frame;
      if (each.predicted) {
        const [mean, low, high] = each.predicted;
        g.fillStyle = colour("grey");
        g.globalAlpha = 0.35;
        g.fillRect(frame.atX(low), y - 8, Math.max(2, frame.atX(high) - frame.atX(low)), 16);
        g.globalAlpha = 1;
        g.fillStyle = colour("ink");
        g.fillRect(frame.atX(mean) - 1, y - 9, 2, 18);
      }
      if (each.half !== null) frame.line([each.mean - each.half, each.mean + each.half], [i, i], colour("orange"), { width: 3 });
      if (each.mean !== null) frame.dot(each.mean, i, colour("orange"), { radius: 5 });
      for (const total of each.returns) frame.dot(total, i, colour("blue"), { radius: 3, ring: true });
    });
    const exceeds = agents.some((each) => each.half !== null && (each.mean - each.half < frame.x[0] || each.mean + each.half > frame.x[1]));
    const predicted = agents.some((each) => each.predicted) ? "Grey: predicted, the bar its 95 % interval, the line its mean." : "The log has no prediction of these returns.";
    this.returns.words.textContent = `${predicted} Blue rings: whole episodes. Orange: their mean and its 95 % interval, which narrows as episodes are added${exceeds ? "; one that reaches the frame extends beyond it" : ""}.`;
    // One decimal, as in the table that the command prints; no -0.0.
    const tenths = (value) => value.toFixed(1).replace(/^-0\.0$/, "0.0").replace("-", "\u2212");
    const within = (low, high) => ` (${tenths(low)} to\u00a0${tenths(high)})`;
    const measured = ({ mean, half }) => (mean === null ? "none yet" : `${tenths(mean)}${half === null ? "" : within(mean - half, mean + half)}`);
    table(this.agentTable, ["agent", "episodes", "measured (95 % interval)", "predicted (95 % interval)"], agents.map((each) => [
      each.name, shown(each.n), measured(each), each.predicted ? `${tenths(each.predicted[0])}${within(each.predicted[1], each.predicted[2])}` : "not predicted",
    ]));
  }

  #drawDrift(view) {
    const rows = [[0, this.about.percentiles_hz], ...view.percentiles];
    const xs = rows.map(([time]) => time), end = Math.max(view.end_s, 1);
    const shownOnes = [1, 5, 9];
    const frame = new Frame(this.drift.canvas, [0, end], [0, spanOf([1e-6, ...rows.map(([, of]) => of[9] ?? null)])[1]], { xLabel: CLOCK, right: 40 });
    shownOnes.forEach((which, k) => {
      const ys = rows.map(([, of]) => of[which] ?? null);
      frame.line([...xs, end], [...ys, ys.at(-1)], series(k), { steps: true });
      if (ys.at(-1) !== null) frame.text(`P${10 * which}`, frame.right + 4, frame.atY(ys.at(-1)), series(k));
    });
    const latest = rows.at(-1)[1], first = rows[0][1];
    this.drift.words.textContent = first.length ? `${shownOnes.map((i) => `P${10 * i}: ${shown(first[i], 3)} at the start, ${shown(latest[i], 3)} now`).join("; ")} (Hz)${this.about.adaptive ? "" : "; thresholds are fixed"}` : "the log has no percentiles";
  }

  #listTotals(view) {
    const { limits, account } = this.about;
    const budget = account.of ? ` of a budget of ${shown(account.of)} (${shown(account.pulses)} had been spent before)` : limits.stimuli_per_session ? `; no budget was set, the culture's limit is ${shown(limits.stimuli_per_session)}` : "; the log has no budget";
    const each = account.of_per_electrode ? ` of ${shown(account.of_per_electrode)}` : "";
    const summing = view.summed < 1 ? [["added up", `${(100 * view.summed).toFixed(0)} % of the log, to which the rest applies`]] : [];
    list(this.totals, [
      ...summing,
      ["ticks", shown(view.n_ticks)],
      ["episodes", `${shown(view.episodes_done)} of ${this.about.planned ? shown(this.about.planned) : "an unknown number"}`],
      ["time left", view.time_left],
      ["pulses", `${shown(view.pulses)}${budget}`],
      ["most pulsed electrode", view.fullest ? `${view.fullest[0]}, with ${shown(view.fullest[1])}${each} pulses` : "none was pulsed"],
      ["bursts", `${shown(view.bursts)} (${shown((100 * view.bursts) / Math.max(1, view.n_ticks), 2)} % of the responses)`],
      ["late ticks", shown(view.late)],
      ["unanswered pulses", view.state === "running" ? "known when it has ended" : shown(view.unanswered)],
      ["damage", view.damage || "none"],
      ...(view.strange ? [["not understood", `${shown(view.strange)} records`]] : []),
    ]);
    this.faultWords.textContent = view.n_faults ? `${shown(view.n_faults)} in total, the latest first` : "none were logged";
    table(this.faults, view.n_faults ? ["time", "fault"] : [], [...view.faults].reverse().map(([time, what]) => [time === null ? "not known" : `${shown(time, 6)} s`, what]));
  }
}
