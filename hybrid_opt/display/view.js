"use strict";
/* Plays one carry: samples of time, pose (6) and all joints. */
(function () {
  const data = JSON.parse(document.getElementById("carry").textContent);
  const $ = (id) => document.getElementById(id);

  function decode(text, Type) {
    const binary = atob(text);
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
    return new Type(bytes.buffer);
  }

  const flat = decode(data.samples, Float32Array);
  const samples = [];
  for (let i = 0; i < flat.length; i += data.width) samples.push(flat.subarray(i, i + data.width));
  const end = samples[samples.length - 1][0];

  let scene = null;
  try {
    scene = new CellScene($("scene"), data, decode);
  } catch (error) {
    $("scene").textContent = "The view in three dimensions needs WebGL, which this browser lacks.";
    document.documentElement.dataset.ready = "without WebGL";
    return;
  }
  const points = new Float32Array(3 * samples.length);
  samples.forEach((sample, i) => points.set(sample.subarray(1, 4), 3 * i));
  scene.showPath(points);

  let moment = data.begin, playing = false, last = 0;

  function show() {
    let k = samples.findIndex((sample) => sample[0] >= moment - 1e-6);
    k = Math.max(1, k < 0 ? samples.length - 1 : k);
    const before = samples[k - 1], after = samples[k];
    const share = Math.min(1, (moment - before[0]) / Math.max(1e-9, after[0] - before[0]));
    const at = Array.from(before, (value, i) => value + share * (after[i] - value));
    scene.place(at.slice(1, 7), at.slice(7));
    $("scrub").value = String(Math.round((1000 * moment) / end));
    const number = data.numbers[share < 0.5 ? k - 1 : k];
    $("moment").textContent =
      `${moment.toFixed(2)} / ${end.toFixed(2)} s, sample ${number}`;
  }

  function step(now) {
    if (!playing) return;
    moment += (now - last) / 1000;
    last = now;
    if (moment >= end) { moment = end; toggle(); }
    show();
    if (playing) requestAnimationFrame(step);
  }

  function toggle() {
    playing = !playing;
    $("play").textContent = playing ? "Pause" : "Play";
    if (!playing) return;
    if (moment >= end) moment = 0;
    last = performance.now();
    requestAnimationFrame(step);
  }

  $("play").addEventListener("click", toggle);
  $("scrub").addEventListener("input", () => { moment = (end * $("scrub").value) / 1000; show(); });
  $("reset").addEventListener("click", () => scene.resetView());
  show();
  document.documentElement.dataset.ready = "yes";
})();
