"use strict";
/* Choice of a trajectory, its plots, and play and scrub of its motion. */
(function () {
  const data = window.reportData;
  const $ = (id) => document.getElementById(id);
  const FORCE = 7 + data.joints[0] + data.joints[1];
  const COLUMNS = { pose: 1, q: 7, force: FORCE, width: FORCE + 4 };
  /* Nothing of the page leaves the machine: no upload, no address that one could go to. */
  const OWN = { responsive: true, displaylogo: false, showSendToCloud: false,
    plotlyServerURL: "", showEditInChartStudio: false };
  const CONFIG = { ...OWN,
    modeBarButtonsToRemove: ["sendChartToCloud", "lasso2d", "autoScale2d"] };
  const PLAIN = { ...OWN, displayModeBar: false };
  const STAR = "star", NEAR = 12, OVER_TIME = "force-plot";
  const dark = window.matchMedia("(prefers-color-scheme: dark)");

  function button(parent, text, act) {
    const made = parent.appendChild(document.createElement("button"));
    made.type = "button";
    made.textContent = text;
    made.addEventListener("click", act);
    return made;
  }

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name);
  }

  /* What a layout takes from the page's colours. */
  function themed(layout) {
    const line = colour("--line");
    const axis = { gridcolor: line, linecolor: line, zerolinecolor: line };
    return { ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, DejaVu Sans, sans-serif", size: 12, color: colour("--ink") },
      xaxis: { ...layout.xaxis, ...axis }, yaxis: { ...layout.yaxis, ...axis },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--soft"), activecolor: colour("--ink") } };
  }

  /* A trace of the fronts in the page's colours where its own would not stand out in the dark. */
  function tinted(trace) {
    const own = { "#b00020": "--mark", "#555555": "--soft", "#1d2327": "--ink", "#000": "--ink" };
    const of = (part) => part && own[part.color] ? { ...part, color: colour(own[part.color]) } : part;
    const marker = trace.marker && { ...of(trace.marker), line: of(trace.marker.line) };
    return { ...trace, ...(marker && { marker }), ...(trace.line && { line: of(trace.line) }) };
  }

  const carries = data.trajectories;

  function samplesOf(motion) {
    if (!motion.samples) motion.samples = new Samples(motion.data, COLUMNS.width);
    return motion.samples;
  }

  const state = { selected: -1, motion: 0, kind: "the whole job", view: 0, whole: false, share: 0, playing: false,
    last: 0, marked: 0 };
  let scene = null;
  try {
    scene = new CellScene($("scene"), data);
  } catch (error) {
    const note = document.createElement("p");
    note.className = "missing";
    note.textContent = "The view in three dimensions needs WebGL, which this browser lacks.";
    $("scene").replaceChildren(note);
  }

  function shown() {
    return carries[state.selected].motions[state.motion];
  }

  /* Of a legend below a picture so wide [px], whose columns are as wide as its longest entry. */
  function legendHeight(traces, width) {
    const entries = traces.filter((trace) => trace.showlegend !== false);
    const longest = Math.max(...entries.map((trace) => trace.name.length));
    const columns = Math.max(1, Math.floor(width / (50 + 6 * longest)));
    return 19 * Math.ceil(entries.length / columns);
  }

  function drawFront() {
    const view = data.views[state.view];
    const range = state.whole ? view.whole : view.first;
    const below = 55 + legendHeight(view.data, $("front-plot").clientWidth - 85);
    $("front-plot").style.height = `${Math.max(460, 300 + below)}px`;
    const { margin, xaxis, yaxis } = view.layout;
    const layout = themed({ ...view.layout, margin: { ...margin, b: below },
      xaxis: { ...xaxis, range: range[0].slice() }, yaxis: { ...yaxis, range: range[1].slice() } });
    Plotly.react("front-plot", view.data.map((trace) => ({ ...tinted(trace), selectedpoints: kept(trace) })),
      layout, CONFIG);
    mark();
    [...$("views").querySelectorAll("button[data-view]")].forEach((button) =>
      button.setAttribute("aria-pressed", String(Number(button.dataset.view) === state.view)));
    $("whole").setAttribute("aria-pressed", String(state.whole));
  }

  /* A ring around the point of the chosen trajectory, where the picture has it: its last trace. */
  function mark(number = state.selected) {
    const place = { x: [[]], y: [[]] }, traces = data.views[state.view].data;
    traces.filter((trace) => trace.customdata).forEach((trace) => {
      const at = trace.customdata.indexOf(number);
      if (at >= 0) { place.x = [[trace.x[at]]]; place.y = [[trace.y[at]]]; }
    });
    Plotly.restyle("front-plot", place, [traces.length - 1]);
  }

  /* The trajectory of a clicked point; where the star covers the point, the recommended one. */
  function clicked(event) {
    const point = event.points.find((p) => p.customdata !== undefined);
    const star = data.views[state.view].data.find((trace) => trace.marker?.symbol === STAR);
    if (!point || !star) return point && point.customdata;
    const across = point.xaxis.d2p(point.x) - point.xaxis.d2p(star.x[0]);
    const along = point.yaxis.d2p(point.y) - point.yaxis.d2p(star.y[0]);
    return Math.hypot(across, along) < NEAR ? star.customdata[0] : point.customdata;
  }

  function fillViews() {
    data.views.forEach((view, k) => {
      const made = button($("views"), view.name, () => { state.view = k; state.whole = false; drawFront(); });
      made.dataset.view = String(k);
    });
    button($("views"), "Whole fronts", () => { state.whole = !state.whole; drawFront(); }).id = "whole";
  }

  /* Forces over time, with the samples of a motion; of planned ones nothing else is known. */
  function drawOverTime(motion) {
    const samples = samplesOf(motion);
    const { data: traces, layout } = data.plots[OVER_TIME];
    const known = traces.filter((trace) => motion.isCommanded || trace.meta.planned || "level" in trace.meta);
    const filled = known.map((trace) => "level" in trace.meta
      ? { ...tinted(trace), x: [0, samples.end], y: [trace.meta.level, trace.meta.level] }
      : { ...tinted(trace), name: motion.isCommanded ? trace.name : trace.meta.planned,
        x: samples.times, y: samples.rows.map((row) => row[trace.meta.column]) });
    Plotly.react(OVER_TIME, filled, themed({ ...layout, shapes: marks(motion, 0),
      xaxis: { ...layout.xaxis, range: [0, samples.end] } }), PLAIN);
  }

  /* The cursor, and where phases begin. */
  function marks(motion, time) {
    const mark = (x, name, more) => ({ type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1,
      line: { color: colour(name), width: 1 }, ...more });
    const begins = (motion.phases || []).slice(1).map((phase) =>
      mark(phase.begin, "--line", { layer: "below" }));
    return [...begins, mark(time, "--mark")];
  }

  /* The phase of a time, -1 where a motion has none. */
  function phaseAt(motion, time) {
    const phases = motion.phases || [];
    let found = phases.length - 1;
    while (found > 0 && phases[found].begin > time + 1e-4) found -= 1;
    return found;
  }

  /* The job's phases: a strip below the picture, and a table. */
  function fillPhases() {
    const job = carries[state.selected].motions.find((m) => m.phases);
    const phases = job ? job.phases : [];
    const playing = Boolean(shown().phases);
    $("phases").replaceChildren();
    (playing ? phases : []).forEach((phase) => {
      const made = button($("phases"), phase.name, () => seek(phase.begin / job.duration));
      made.style.flexGrow = String(phase.duration);
      made.title = `${phase.begin.toFixed(2)} s to ${(phase.begin + phase.duration).toFixed(2)} s`;
    });
    $("phase-section").hidden = !phases.length;
    const row = (cells, kind) => {
      const line = document.createElement("tr");
      cells.forEach((text, i) => {
        const made = line.appendChild(document.createElement(kind));
        made.textContent = text;
        if (i === cells.length - 1) made.className = "word";
      });
      return line;
    };
    $("phase-table").tHead.replaceChildren(row(["phase", "begins [s]", "takes [s]",
      ...data.robots.map((robot) => `${robot}, force [N]`), "most used limit"], "th"));
    $("phase-table").tBodies[0].replaceChildren(...phases.map((phase) => row([phase.name,
      phase.begin.toFixed(2), phase.duration.toFixed(2), ...phase.peaks.map((f) => f.toFixed(1)),
      `${phase.most} ${phase.use.toFixed(0)} %`], "td")));
  }

  function drawTorque(motion) {
    const { data: traces, layout } = data.plots["torque-plot"];
    const [first] = data.joints;
    const filled = traces.map((trace) => ({ ...trace,
      y: motion[trace.meta.use].slice(...(trace.meta.arm ? [first] : [0, first])) }));
    Plotly.react("torque-plot", filled, themed(layout), PLAIN);
  }

  function select(index) {
    state.selected = index;
    const carry = carries[index];
    state.motion = Math.max(0, carry.motions.findIndex((m) => m.name === state.kind));
    $("chooser").value = String(index);
    [...$("carry-table").tBodies[0].rows].forEach((line) =>
      line.setAttribute("aria-selected", String(Number(line.dataset.carry) === index)));
    $("motion").replaceChildren(...carry.motions.map((m, k) => new Option(m.name, String(k))));
    $("motion").value = String(state.motion);
    $("motion").disabled = carry.motions.length < 2;
    $("save").disabled = !data.cells[carry.cell];
    if (data.views.some((view) => view.data.some((trace) => trace.customdata))) mark();
    show();
  }

  /* Everything that depends on the timing of the chosen trajectory. */
  function show() {
    const carry = carries[state.selected];
    const motion = shown();
    const peaks = data.robots.map((robot, i) => `${robot} ${motion.peaks[i].toFixed(2)} N`);
    const what = motion.isCommanded ? `commanded at most ${peaks.join(", ")}`
      : `planned at most ${peaks.join(", ")}`;
    const problems = [motion.remark, carry.problem, carry.jobProblem && `no whole job: ${carry.jobProblem}`];
    $("figures-of-choice").textContent = [`${motion.name}: ${motion.duration.toFixed(2)} s, ${what}`,
      ...problems.filter((text) => text)].join("; ");
    drawOverTime(motion);
    fillPhases();
    drawTorque(motion);
    if (scene) scene.showPath(samplesOf(motion).path);
    seek(0);
  }

  /* A trajectory file, as docs/reference/bundles.md describes it. */
  function fileOf(carry) {
    return JSON.stringify({ format: "dual-arm-carry trajectory", version: 1,
      decision: carry.decision, start: carry.start, figures: carry.figures,
      provenance: carry.provenance, cell: data.cells[carry.cell] }, null, 1) + "\n";
  }

  function save() {
    const carry = carries[state.selected];
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([fileOf(carry)], { type: "application/json" }));
    link.download = carry.label.toLowerCase().replace(/[^a-z0-9.]+/g, "-").replace(/^-|-$/g, "")
      .slice(0, 80) + ".json";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  /* The command before a button; where a browser keeps its clipboard to itself it is marked. */
  function copy(made) {
    const text = made.previousElementSibling.querySelector("code");
    getSelection().selectAllChildren(text);
    const say = () => { made.textContent = "Copied"; };
    if (navigator.clipboard) navigator.clipboard.writeText(text.textContent).then(say, () => {});
    else if (document.execCommand("copy")) say();
  }

  function seek(share) {
    const samples = samplesOf(shown());
    state.share = Math.min(1, Math.max(0, share));
    const time = state.share * samples.end;
    if (scene) {
      const { row } = samples.at(time);
      scene.place(row.subarray(COLUMNS.pose, COLUMNS.q), row.subarray(COLUMNS.q, COLUMNS.force),
        shown().peaks.map((_, i) => row[COLUMNS.force + i] / Math.max(...shown().peaks)));
    }
    $("scrub").value = String(Math.round(1000 * state.share));
    const phase = phaseAt(shown(), time);
    $("moment").textContent = time.toFixed(2) + " s" +
      (phase < 0 ? "" : ", " + shown().phases[phase].name);
    [...$("phases").children].forEach((button, i) =>
      button.setAttribute("aria-current", String(i === phase)));
    const now = performance.now();
    if (!state.playing || now - state.marked > 120) {
      state.marked = now;
      Plotly.relayout(OVER_TIME, { shapes: marks(shown(), time) });
    }
  }

  function setPlaying(playing) {
    state.playing = playing;
    $("play").textContent = playing ? "Pause" : "Play";
    if (playing) {
      if (state.share >= 1) seek(0);
      state.last = performance.now();
      requestAnimationFrame(frame);
    }
  }

  function frame(now) {
    if (!state.playing) return;
    const duration = shown().duration;
    const passed = (Math.max(0, now - state.last) / 1000) * Number($("speed").value);
    state.last = now;
    const share = state.share + passed / duration;
    if (share >= 1) setPlaying(false);
    seek(share);
    if (state.playing) requestAnimationFrame(frame);
  }

  function fillChooser() {
    data.lists.forEach((list) => {
      const group = document.createElement("optgroup");
      group.label = list.label;
      list.members.forEach((k) => group.appendChild(new Option(carries[k].label, String(k))));
      $("chooser").appendChild(group);
    });
  }

  /* --- the table of all carries --- */

  const orNone = (value) => value ?? NaN;
  const TOLD = [["carry", (c) => c.label.split(": ")[0]], ["time [s]", (c) => c.duration],
    ["commanded [N]", (c) => orNone(c.commanded)], ["planned [N]", (c) => c.planned],
    ["payload, planned forces [kg]", (c) => c.motions[0].payloadLimit]];
  const listing = { column: 1, sign: 1, brushed: null };
  const recommended = data.lists.find((list) => list.label === "Recommended")?.members[0];

  function passes(k) {
    const [name, time, force] = TOLD.slice(0, 3).map(([, of]) => of(carries[k]));
    const most = (id) => ($(id).value === "" ? Infinity : Number($(id).value));
    return name.toLowerCase().includes($("filter-text").value.toLowerCase()) &&
      time <= most("filter-time") && !(force > most("filter-force")) &&
      (!listing.brushed || listing.brushed.has(k));
  }

  /* The points of a trace that the filter keeps; all where nothing is filtered. */
  function kept(trace) {
    if (!trace.customdata || carries.every((_, k) => passes(k))) return undefined;
    return trace.customdata.flatMap((k, i) => (passes(k) ? [i] : []));
  }

  function fillTable() {
    const value = TOLD[listing.column][1];
    const order = carries.map((_, k) => k).filter(passes).sort((a, b) => {
      const [x, y] = [value(carries[a]), value(carries[b])];
      /* What has no value stands last. */
      if (x !== x || y !== y) return Number(x !== x) - Number(y !== y);
      return listing.sign * (x < y ? -1 : Number(x > y));
    });
    $("carry-table").tBodies[0].replaceChildren(...order.map((k) => {
      const line = document.createElement("tr");
      line.dataset.carry = String(k);
      line.setAttribute("aria-selected", String(k === state.selected));
      TOLD.forEach(([, of], i) => {
        const told = of(carries[k]), cell = line.insertCell();
        const text = i ? (told !== told ? "\u2013" : told.toFixed(2)) : (k === recommended ? "\u2605 " : "") + told;
        if (i === 2 && carries[k].beyond) {
          cell.className = "beyond";
          cell.title = "above the allowed force";
        }
        if (i) { cell.textContent = text; return; }
        button(cell, text, () => select(k)).addEventListener("focus", () => pictures && mark(k));
      });
      line.addEventListener("mouseenter", () => pictures && mark(k));
      return line;
    }));
    [...$("carry-table").tHead.rows[0].cells].forEach((cell, i) => cell.setAttribute("aria-sort",
      i !== listing.column ? "none" : listing.sign > 0 ? "ascending" : "descending"));
    $("filter-count").textContent = `${order.length} of ${carries.length}`;
  }

  function filtered() {
    fillTable();
    if (!pictures) return;
    const traces = data.views[state.view].data;
    Plotly.restyle("front-plot", { selectedpoints: traces.map((trace) => kept(trace) ?? null) },
      traces.map((_, k) => k));
  }

  function listCarries() {
    TOLD.forEach(([heading], i) => {
      const cell = $("carry-table").tHead.rows[0].appendChild(document.createElement("th"));
      cell.scope = "col";
      button(cell, heading, () => {
        listing.sign = listing.column === i ? -listing.sign : 1;
        listing.column = i;
        fillTable();
      });
    });
    const fields = ["filter-text", "filter-time", "filter-force"];
    fields.forEach((id) => $(id).addEventListener("input", filtered));
    $("filter-none").addEventListener("click", () => {
      fields.forEach((id) => { $(id).value = ""; });
      listing.brushed = null;
      filtered();
    });
    $("carry-table").addEventListener("mouseleave", () => pictures && mark());
    fillTable();
  }

  fillChooser();
  const pictures = data.views.some((view) => view.data.some((trace) => trace.customdata));
  if (pictures) {
    fillViews();
    drawFront();
    $("front-plot").on("plotly_click", (event) => {
      const found = clicked(event);
      if (found !== undefined) select(found);
    });
    $("front-plot").on("plotly_selected", (event) => {
      const numbers = (event?.points || []).map((p) => p.customdata).filter((k) => k !== undefined);
      if (!numbers.length) return;
      listing.brushed = new Set(numbers);
      filtered();
    });
  } else {
    $("front-plot").remove();
  }
  $("chooser").addEventListener("change", (event) => select(Number(event.target.value)));
  $("motion").addEventListener("change", (event) => {
    state.motion = Number(event.target.value);
    state.kind = shown().name;
    show();
  });
  $("save").addEventListener("click", save);
  $("play").addEventListener("click", () => setPlaying(!state.playing));
  $("play-job")?.addEventListener("click", () => {
    if (recommended !== undefined) select(recommended);
    seek(0);
    setPlaying(true);
    $("scene").scrollIntoView({ block: "nearest" });
  });
  document.querySelectorAll(".copy").forEach((made) => made.addEventListener("click", () => copy(made)));
  $("scrub").addEventListener("input", (event) => {
    setPlaying(false);
    seek(Number(event.target.value) / 1000);
  });
  $("reset-view").addEventListener("click", () => scene && scene.resetView());
  $("scene").addEventListener("keydown", (event) => {
    if (event.key !== " ") return;
    event.preventDefault();
    setPlaying(!state.playing);
  });
  dark.addEventListener("change", () => {
    if (scene) scene.dim(dark.matches);
    if (pictures) drawFront();
    drawOverTime(shown());
    drawTorque(shown());
  });
  listCarries();
  if (scene) scene.dim(dark.matches);
  select(data.first);
  window.report = { data, state, select, seek, setPlaying, scene, fileOf };
  performance.mark("ready");
  document.documentElement.dataset.ready = "true";
})();
