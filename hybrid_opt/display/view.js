"use strict";
/* Plays one carry: samples of time, pose (6) and all joints. */
(function () {
  const data = JSON.parse(document.getElementById("carry").textContent);
  const $ = (id) => document.getElementById(id);

  const samples = new Samples(data.samples, data.width);

  let scene = null;
  try {
    scene = new CellScene($("scene"), data);
  } catch (error) {
    $("scene").textContent = "The view in three dimensions needs WebGL, which this browser lacks.";
    document.documentElement.dataset.ready = "without WebGL";
    return;
  }
  scene.showPath(samples.path);

  let moment = data.begin, playing = false, last = 0;

  function show() {
    const { row, nearest } = samples.at(moment);
    scene.place(row.subarray(1, 7), row.subarray(7));
    $("scrub").value = String(Math.round((1000 * moment) / samples.end));
    $("moment").textContent =
      `${moment.toFixed(2)} / ${samples.end.toFixed(2)} s, sample ${data.numbers[nearest]}`;
  }

  function step(now) {
    if (!playing) return;
    moment += (now - last) / 1000;
    last = now;
    if (moment >= samples.end) { moment = samples.end; toggle(); }
    show();
    if (playing) requestAnimationFrame(step);
  }

  function toggle() {
    playing = !playing;
    $("play").textContent = playing ? "Pause" : "Play";
    if (!playing) return;
    if (moment >= samples.end) moment = 0;
    last = performance.now();
    requestAnimationFrame(step);
  }

  $("play").addEventListener("click", toggle);
  $("scrub").addEventListener("input", () => { moment = (samples.end * $("scrub").value) / 1000; show(); });
  $("reset").addEventListener("click", () => scene.resetView());
  show();
  document.documentElement.dataset.ready = "yes";
})();
