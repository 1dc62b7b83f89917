"use strict";
/* Choice of a trajectory, its plots, and play and scrub of its motion. */
(function () {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const $ = (id) => document.getElementById(id);
  const FORCE = 7 + data.joints[0] + data.joints[1];
  const COLUMNS = { time: 0, pose: 1, q: 7, force: FORCE, shift: FORCE + 2, width: FORCE + 4 };
  const CONFIG = { responsive: true, displaylogo: false,
    modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"] };
  const PLAIN = { responsive: true, displayModeBar: false };
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

  const carries = data.trajectories.map((carry) => ({ ...carry, samples: null }));

  function samplesOf(carry) {
    if (!carry.samples) {
      const flat = decode(carry.data, Float32Array);
      carry.samples = [];
      for (let i = 0; i < flat.length; i += COLUMNS.width) {
        carry.samples.push(flat.subarray(i, i + COLUMNS.width));
      }
    }
    return carry.samples;
  }

  const state = { selected: -1, share: 0, playing: false, last: 0, marked: 0 };
  let scene = null;
  try {
    scene = new CellScene($("scene"), data, decode);
  } catch (error) {
    const note = document.createElement("p");
    note.className = "missing";
    note.textContent = "The view in three dimensions needs WebGL, which this browser lacks.";
    $("scene").replaceChildren(note);
  }

  function drawFront() {
    const traces = [];
    data.clouds.forEach((cloud) => {
      const points = decode(cloud.points, Float32Array);
      traces.push({ type: "scatter", mode: "markers", name: plain(cloud.label), hoverinfo: "skip",
        x: points.filter((_, i) => i % 2 === 0), y: points.filter((_, i) => i % 2 === 1),
        marker: { color: cloud.colour, size: 3, opacity: 0.25, symbol: cloud.symbol } });
    });
    data.groups.forEach((group) => {
      const members = group.members.map((k) => carries[k]);
      traces.push({ type: "scatter", mode: "markers", name: plain(group.label),
        x: members.map((m) => m.objectives[0]), y: members.map((m) => m.objectives[1]),
        customdata: group.members, text: members.map((m) => plain(m.label)),
        hovertemplate: "%{text}<br>%{x:.4f}, %{y:.4f}<extra></extra>",
        marker: { color: group.colour, size: 9, symbol: group.symbol,
          line: { color: "#000", width: 0.7 } } });
    });
    if (data.rest) {
      traces.push({ type: "scatter", mode: "markers", name: "level payload at rest",
        x: [data.rest[0]], y: [data.rest[1]], hoverinfo: "name",
        marker: { color: "#b00020", size: 13, symbol: "star" } });
    }
    traces.push({ type: "scatter", mode: "markers", name: "chosen", x: [], y: [],
      hoverinfo: "skip", showlegend: false,
      marker: { color: "rgba(0,0,0,0)", size: 18, line: { color: "#b00020", width: 2.5 } } });
    const narrow = $("front-plot").clientWidth < 600;
    const layout = { font: FONT, hovermode: "closest",
      margin: { l: 70, r: 15, t: 30, b: narrow ? 190 : 100 },
      xaxis: { title: { text: plain(data.objectiveTitles[0]) + " [-]", standoff: 8 }, range: data.ranges[0] },
      yaxis: { title: { text: plain(data.objectiveTitles[1]) + " [-]" }, range: data.ranges[1] },
      legend: { orientation: "h", yref: "container", y: 0.01, yanchor: "bottom",
        font: { size: 11 } } };
    Plotly.newPlot("front-plot", traces, layout, CONFIG);
    $("front-plot").on("plotly_click", (event) => {
      const point = event.points.find((p) => p.customdata !== undefined);
      if (point) select(point.customdata);
    });
    state.chosenTrace = traces.length - 1;
  }

  function lines(id, carry, column, scale, title, limits) {
    const samples = samplesOf(carry);
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
        font: { size: 10 } }, shapes: [cursor(0)] };
    Plotly.react(id, traces, layout, PLAIN);
  }

  function cursor(time) {
    return { type: "line", x0: time, x1: time, yref: "paper", y0: 0, y1: 1,
      line: { color: "#b00020", width: 1 } };
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

  function drawTorque(carry) {
    const traces = data.robots.map((robot, i) => {
      const use = useOf(carry.torqueUse, i);
      const joints = [...use.keys(), 0].map((j) => "joint " + (j + 1));
      return { type: "scatterpolar", mode: "lines+markers", name: plain(robot),
        r: [...use, use[0]], theta: joints,
        line: { color: ["#3b6ea8", "#a8733b"][i], dash: ["solid", "dash"][i] } };
    });
    const layout = { font: FONT, margin: { l: 50, r: 50, t: 40, b: 30 },
      title: { text: "torque of the contact wrench [% of maximum]", font: { size: 12 } },
      polar: { radialaxis: { rangemode: "tozero", ticksuffix: " %", nticks: 5,
        angle: freeDirection(carry.torqueUse), tickfont: { size: 10 } } },
      legend: { orientation: "h", y: -0.08, font: { size: 10 } } };
    Plotly.react("torque-plot", traces, layout, PLAIN);
  }

  function select(index) {
    const carry = carries[index];
    state.selected = index;
    $("chooser").value = String(index);
    const peaks = carry.peaks.map((v) => v.toFixed(2) + " N").join(" and ");
    $("figures-of-choice").textContent =
      `peak normal forces ${peaks}, ${carry.duration.toFixed(2)} s, payload at the limit ` +
      `${carry.payloadLimit.toFixed(2)} kg`;
    if (carry.objectives.length > 1) {
      Plotly.restyle("front-plot", { x: [[carry.objectives[0]]], y: [[carry.objectives[1]]] },
        [state.chosenTrace]);
    }
    const rest = data.restForce === null ? []
      : [{ label: "level payload at rest", value: data.restForce, colour: "#b00020" }];
    lines("force-plot", carry, COLUMNS.force, 1, "normal force [N]", rest);
    lines("pressure-plot", carry, COLUMNS.shift, 1000, "pressure shift [mm]",
      [{ label: "patch radius", value: 1000 * data.patchRadius, colour: "#000" }]);
    drawTorque(carry);
    if (scene) {
      const samples = samplesOf(carry);
      const points = new Float32Array(3 * samples.length);
      samples.forEach((s, i) => points.set(s.subarray(COLUMNS.pose, COLUMNS.pose + 3), 3 * i));
      scene.showPath(points);
    }
    seek(0);
  }

  function seek(share) {
    const samples = samplesOf(carries[state.selected]);
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
    $("moment").textContent = time.toFixed(2) + " s";
    const now = performance.now();
    if (!state.playing || now - state.marked > 120) {
      state.marked = now;
      ["force-plot", "pressure-plot"].forEach((id) =>
        Plotly.relayout(id, { shapes: [cursor(time)] }));
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
    const duration = carries[state.selected].duration;
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
  if (data.objectiveTitles.length > 1) drawFront();
  else $("front-plot").remove();
  $("chooser").addEventListener("change", (event) => select(Number(event.target.value)));
  $("play").addEventListener("click", () => setPlaying(!state.playing));
  $("scrub").addEventListener("input", (event) => {
    setPlaying(false);
    seek(Number(event.target.value) / 1000);
  });
  $("reset-view").addEventListener("click", () => scene && scene.resetView());
  select(data.first);
  window.report = { data, state, select, seek, setPlaying, scene };
  document.documentElement.dataset.ready = "true";
})();
