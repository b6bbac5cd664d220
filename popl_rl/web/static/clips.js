// Film strips, drawn frame by frame: all strips of a page by one clock, so that they stay in step.
"use strict";
(() => {
  const REST = 0.8; // seconds on the last frame before all begin again
  const canvases = [...document.querySelectorAll("canvas[data-strip]")];
  const strips = canvases.map((canvas) => {
    const image = new Image();
    image.src = canvas.dataset.strip;
    return { canvas, image, frames: Number(canvas.dataset.frames), shown: -1 };
  });
  const rate = Math.min(...canvases.map((canvas) => Number(canvas.dataset.rate)));
  const most = Math.max(...strips.map((strip) => strip.frames));
  const toggle = document.getElementById("motion");
  const calm = window.matchMedia("(prefers-reduced-motion: reduce)");
  let playing = !calm.matches;
  let time = 0;
  let before = null;

  function draw(frame) {
    for (const strip of strips) {
      const at = Math.min(frame, strip.frames - 1);
      if (at === strip.shown) continue;
      const width = strip.image.naturalWidth / strip.frames;
      const height = strip.image.naturalHeight;
      if (strip.canvas.width !== width || strip.canvas.height !== height) {
        strip.canvas.width = width;
        strip.canvas.height = height;
      }
      const pen = strip.canvas.getContext("2d");
      pen.drawImage(strip.image, at * width, 0, width, height, 0, 0, width, height);
      strip.shown = at;
      strip.canvas.dataset.frame = String(at);
    }
  }

  function tick(now) {
    if (playing) {
      if (before !== null) time += (now - before) / 1000;
      const length = (most - 1) / rate;
      if (time > length + REST) time = 0;
      draw(Math.min(most - 1, Math.floor(time * rate + 1e-6)));
    }
    before = now;
    window.requestAnimationFrame(tick);
  }

  function label() {
    toggle.textContent = playing ? toggle.dataset.stop : toggle.dataset.play;
    toggle.setAttribute("aria-pressed", String(!playing));
  }

  const loaded = Promise.all(strips.map((strip) => strip.image.decode()));
  window.popl = { ready: loaded };
  if (!strips.length) return;
  loaded.then(() => {
    draw(playing ? 0 : most - 1); // people whom motion disturbs see how it ends, and may start it
    if (toggle) {
      toggle.hidden = false;
      label();
      toggle.addEventListener("click", () => {
        playing = !playing;
        if (playing) time = 0;
        label();
      });
    }
    window.requestAnimationFrame(tick);
  });
})();
