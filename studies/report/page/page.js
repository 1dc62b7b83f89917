"use strict";
/* Choice of a trajectory, its plots, and play and scrub of its motion. */
(function () {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const $ = (id) => document.getElementById(id);
  const FORCE = 7 + data.joints[0] + data.joints[1];
  const COLUMNS = { time: 0, pose: 1, q: 7, force: FORCE, shift: FORCE + 2, width: FORCE + 4 };
  /* Nothing of the page leaves the machine: no upload, no address that one could go to. */
  const OWN = { responsive: true, displaylogo: false, showSendToCloud: false,
    plotlyServerURL: "", showEditInChartStudio: false };
  const CONFIG = { ...OWN,
    modeBarButtonsToRemove: ["sendChartToCloud", "lasso2d", "select2d", "autoScale2d"] };
  const PLAIN = { ...OWN, displayModeBar: false };
  const STAR = "star", NEAR = 12;
  const FONT = { family: "system-ui, DejaVu Sans, sans-serif", size: 12 };

  function decode(text, Type) {
    const binary = atob(text);
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
    return new Type(bytes.buffer);
  }

  /* Plotly reads a small markup in its texts; names must not be taken for it. */
  function plain(text) {
    return String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
  }

  const carries = data.trajectories;

  function samplesOf(motion) {
    if (!motion.samples) {
      const flat = decode(motion.data, Float32Array);
      motion.samples = [];
      for (let i = 0; i < flat.length; i += COLUMNS.width) {
        motion.samples.push(flat.subarray(i, i + COLUMNS.width));
      }
    }
    return motion.samples;
  }

  const state = { selected: -1, motion: 0, kind: "the whole job", view: 0, whole: false, share: 0, playing: false,
    last: 0, marked: 0 };
  let scene = null;
  try {
    scene = new CellScene($("scene"), data, decode);
  } catch (error) {
    const note = document.createElement("p");
    note.className = "missing";
    note.textContent = "The view in three dimensions needs WebGL, which this browser lacks.";
    $("scene").replaceChildren(note);
  }

  function shown() {
    return carries[state.selected].motions[state.motion];
  }

  function frontTraces(view) {
    const traces = view.clouds.map((cloud) => {
      const points = decode(cloud.points, Float32Array);
      return { type: "scatter", mode: "markers", name: plain(cloud.label), hoverinfo: "skip",
        x: points.filter((_, i) => i % 2 === 0), y: points.filter((_, i) => i % 2 === 1),
        marker: { color: cloud.colour, size: 3, opacity: 0.25, symbol: cloud.symbol } };
    });
    view.lines.forEach((line) => traces.push({ type: "scatter", mode: "lines",
      name: plain(line.label), x: line.x, y: line.y, hoverinfo: "skip",
      line: { color: line.colour, dash: line.dash, width: 1.6 } }));
    /* What is recommended is drawn last, above all others. */
    const ordered = [...view.groups].sort((a, b) =>
      Number(a.symbol === STAR) - Number(b.symbol === STAR));
    ordered.forEach((group) => traces.push({ type: "scatter", mode: "markers",
      name: plain(group.label), x: group.x, y: group.y, customdata: group.members,
      text: group.members.map((k) => plain(carries[k].label)),
      hovertemplate: "%{text}<extra></extra>",
      showlegend: !view.lines.some((line) => group.label === line.label + ", timed"),
      marker: { color: group.colour, size: group.size, symbol: group.symbol,
        line: { color: "#000", width: 0.7 } } }));
    if (view.star) {
      traces.push({ type: "scatter", mode: "markers", name: view.star[2],
        x: [view.star[0]], y: [view.star[1]], hoverinfo: "name",
        marker: { color: "#1d2327", size: 11, symbol: "x-thin", line: { width: 2.5 } } });
    }
    traces.push({ type: "scatter", mode: "markers", name: "chosen", x: [], y: [],
      hoverinfo: "skip", showlegend: false,
      marker: { color: "rgba(0,0,0,0)", size: 20, line: { color: "#b00020", width: 2.5 } } });
    return traces;
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
    const traces = frontTraces(view);
    const range = state.whole ? view.whole : view.first;
    const below = 60 + legendHeight(traces, $("front-plot").clientWidth - 85);
    $("front-plot").style.height = `${340 + below}px`;
    const layout = { font: FONT, hovermode: "closest",
      margin: { l: 70, r: 15, t: 20, b: below },
      xaxis: { title: { text: plain(view.xTitle), standoff: 8 }, range: range[0].slice() },
      yaxis: { title: { text: plain(view.yTitle) }, range: range[1].slice() },
      legend: { orientation: "h", yref: "container", y: 0.01, yanchor: "bottom",
        font: { size: 11 } } };
    Plotly.react("front-plot", traces, layout, CONFIG);
    state.chosenTrace = traces.length - 1;
    mark();
    [...$("views").querySelectorAll("button[data-view]")].forEach((button) =>
      button.setAttribute("aria-pressed", String(Number(button.dataset.view) === state.view)));
    $("whole").setAttribute("aria-pressed", String(state.whole));
  }

  /* A ring around the point of the chosen trajectory, where the picture has it. */
  function mark() {
    const place = { x: [[]], y: [[]] };
    data.views[state.view].groups.forEach((group) => {
      const at = group.members.indexOf(state.selected);
      if (at >= 0) { place.x = [[group.x[at]]]; place.y = [[group.y[at]]]; }
    });
    Plotly.restyle("front-plot", place, [state.chosenTrace]);
  }

  /* The trajectory of a clicked point; where the star covers the point, the recommended one. */
  function clicked(event) {
    const point = event.points.find((p) => p.customdata !== undefined);
    const star = data.views[state.view].groups.find((group) => group.symbol === STAR);
    if (!point || !star) return point && point.customdata;
    const across = point.xaxis.d2p(point.x) - point.xaxis.d2p(star.x[0]);
    const along = point.yaxis.d2p(point.y) - point.yaxis.d2p(star.y[0]);
    return Math.hypot(across, along) < NEAR ? star.members[0] : point.customdata;
  }

  function fillViews() {
    const button = (text, act) => {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = text;
      made.addEventListener("click", act);
      $("views").appendChild(made);
      return made;
    };
    data.views.forEach((view, k) => {
      const made = button(view.name, () => { state.view = k; state.whole = false; drawFront(); });
      made.dataset.view = String(k);
    });
    button("Whole fronts", () => { state.whole = !state.whole; drawFront(); }).id = "whole";
  }

  function lines(id, motion, column, scale, title, limits) {
    const samples = samplesOf(motion);
    const times = samples.map((s) => s[COLUMNS.time]);
    const end = times[times.length - 1];
    const traces = data.robots.map((robot, i) => ({ type: "scatter", mode: "lines",
      name: plain(robot), x: times, y: samples.map((s) => scale * s[column + i]),
      line: { color: ["#3b6ea8", "#a8733b"][i], dash: ["solid", "dash"][i], width: 2 } }));
    limits.forEach((limit) => traces.push({ type: "scatter", mode: "lines", name: limit.label,
      x: [0, end], y: [limit.value, limit.value], hoverinfo: "name",
      line: { color: limit.colour, dash: "dot", width: 1.5 } }));
    const layout = { font: FONT, margin: { l: 60, r: 15, t: 40, b: 55 }, showlegend: true,
      xaxis: { title: { text: "time [s]", standoff: 6 }, range: [0, end] },
      yaxis: { title: { text: title }, rangemode: "normal" },
      legend: { orientation: "h", yref: "container", y: 0.99, yanchor: "top",
        font: { size: 10 } }, shapes: marks(motion, 0) };
    Plotly.react(id, traces, layout, PLAIN);
  }

  function cursor(time) {
    return { type: "line", x0: time, x1: time, yref: "paper", y0: 0, y1: 1,
      line: { color: "#b00020", width: 1 } };
  }

  /* The cursor, and where phases begin. */
  function marks(motion, time) {
    const begins = (motion.phases || []).slice(1).map((phase) => ({ type: "line",
      x0: phase.begin, x1: phase.begin, yref: "paper", y0: 0, y1: 1, layer: "below",
      line: { color: "#d8dde1", width: 1 } }));
    return [...begins, cursor(time)];
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
    $("phases").replaceChildren(...(playing ? phases : []).map((phase) => {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = phase.name;
      made.style.flexGrow = String(phase.duration);
      made.title = `${phase.begin.toFixed(2)} s to ${(phase.begin + phase.duration).toFixed(2)} s`;
      made.addEventListener("click", () => seek(phase.begin / job.duration));
      return made;
    }));
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
      ...data.robots.map((robot) => `${robot} presses [N]`), "most used limit"], "th"));
    $("phase-table").tBodies[0].replaceChildren(...phases.map((phase) => row([phase.name,
      phase.begin.toFixed(2), phase.duration.toFixed(2), ...phase.peaks.map((f) => f.toFixed(1)),
      `${phase.most} ${phase.use.toFixed(0)} %`], "td")));
  }

  /* One arm's joints of a list of both arms'. */
  function useOf(use, i) {
    return i === 0 ? use.slice(0, data.joints[0]) : use.slice(data.joints[0]);
  }

  /* The direction [degrees] between the two neighbouring joints that leave most room. */
  function freeDirection(use) {
    const count = Math.max(...data.joints), step = 360 / count;
    const most = Array.from({ length: count }, (_, j) => Math.max(0,
      ...data.robots.map((_, i) => (j < data.joints[i] ? useOf(use, i)[j] : 0))));
    const taken = most.map((value, j) => value + most[(j + 1) % count]);
    return step / 2 + step * taken.indexOf(Math.min(...taken));
  }

  function drawTorque(motion) {
    const closed = (use) => [...use, use[0]];
    const traces = data.robots.flatMap((robot, i) => {
      const whole = useOf(motion.torqueUse, i), load = useOf(motion.contactTorqueUse, i);
      const joints = [...whole.keys(), 0].map((j) => "joint " + (j + 1));
      const colour = ["#3b6ea8", "#a8733b"][i];
      return [
        { type: "scatterpolar", mode: "lines+markers", name: plain(robot), r: closed(whole),
          theta: joints, line: { color: colour, dash: ["solid", "dash"][i] } },
        { type: "scatterpolar", mode: "lines", name: plain(robot) + ", load alone",
          r: closed(load), theta: joints, line: { color: colour, dash: "dot", width: 1 } },
      ];
    });
    const layout = { font: FONT, margin: { l: 50, r: 50, t: 40, b: 30 },
      title: { text: "largest joint torque [% of maximum]", font: { size: 12 } },
      polar: { radialaxis: { rangemode: "tozero", ticksuffix: " %", nticks: 5,
        angle: freeDirection(motion.torqueUse), tickfont: { size: 10 } } },
      legend: { orientation: "h", y: -0.08, font: { size: 10 } } };
    Plotly.react("torque-plot", traces, layout, PLAIN);
  }

  function select(index) {
    state.selected = index;
    const carry = carries[index];
    state.motion = Math.max(0, carry.motions.findIndex((m) => m.name === state.kind));
    $("chooser").value = String(index);
    $("motion").replaceChildren(...carry.motions.map((m, k) => new Option(m.name, String(k))));
    $("motion").value = String(state.motion);
    $("motion").disabled = carry.motions.length < 2;
    $("save").disabled = !data.cells[carry.cell];
    if (data.views.some((view) => view.groups.length)) mark();
    show();
  }

  /* Everything that depends on the timing of the chosen trajectory. */
  function show() {
    const carry = carries[state.selected];
    const motion = shown();
    const peaks = data.robots.map((robot, i) => `${robot} ${motion.peaks[i].toFixed(2)} N`);
    const what = motion.phases ? `commanded at most ${peaks.join(", ")} (${motion.remark})`
      : `peak normal forces ${peaks.join(", ")}`;
    const problems = [carry.problem, carry.jobProblem && `no whole job: ${carry.jobProblem}`];
    $("figures-of-choice").textContent = [`${motion.duration.toFixed(2)} s, ${what}, payload at ` +
      `the limit ${motion.payloadLimit.toFixed(2)} kg (${motion.name})`,
      ...problems.filter((text) => text)].join("; ");
    const rest = data.restForce === null ? []
      : [{ label: "level payload at rest", value: data.restForce, colour: "#b00020" }];
    lines("force-plot", motion, COLUMNS.force, 1, "normal force [N]", rest);
    fillPhases();
    lines("pressure-plot", motion, COLUMNS.shift, 1000, "pressure shift [mm]",
      [{ label: "patch radius", value: 1000 * data.patchRadius, colour: "#000" }]);
    drawTorque(motion);
    if (scene) {
      const samples = samplesOf(motion);
      const points = new Float32Array(3 * samples.length);
      samples.forEach((s, i) => points.set(s.subarray(COLUMNS.pose, COLUMNS.pose + 3), 3 * i));
      scene.showPath(points);
    }
    seek(0);
  }

  /* A trajectory file, as docs/export.md describes it. */
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

  function seek(share) {
    const samples = samplesOf(shown());
    const end = samples[samples.length - 1][COLUMNS.time];
    state.share = Math.min(1, Math.max(0, share));
    const time = state.share * end;
    let k = 0;
    while (k < samples.length - 2 && samples[k + 1][COLUMNS.time] < time) k += 1;
    const [a, b] = [samples[k], samples[k + 1]];
    const step = b[COLUMNS.time] - a[COLUMNS.time];
    const w = step > 0 ? (time - a[COLUMNS.time]) / step : 0;
    const mixed = a.map((value, i) => value + w * (b[i] - value));
    if (scene) {
      scene.place(mixed.subarray(COLUMNS.pose, COLUMNS.q), mixed.subarray(COLUMNS.q, COLUMNS.force));
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
      ["force-plot", "pressure-plot"].forEach((id) =>
        Plotly.relayout(id, { shapes: marks(shown(), time) }));
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

  fillChooser();
  const pictures = data.views.some((view) => view.groups.length);
  if (pictures) {
    fillViews();
    drawFront();
    $("front-plot").on("plotly_click", (event) => {
      const found = clicked(event);
      if (found !== undefined) select(found);
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
  $("scrub").addEventListener("input", (event) => {
    setPlaying(false);
    seek(Number(event.target.value) / 1000);
  });
  $("reset-view").addEventListener("click", () => scene && scene.resetView());
  select(data.first);
  window.report = { data, state, select, seek, setPlaying, scene, fileOf };
  document.documentElement.dataset.ready = "true";
})();
